# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Who owns the engine's side of a plan."""

from __future__ import annotations

import weakref

from cloth_sim_ros.engine.binding import check, library
from cloth_sim_ros.physics.model import Model
from cloth_sim_ros.physics.uncopyable import Uncopyable


class Owner(Uncopyable):
    """The engine's plan of a model's masses; it is given back when the last one that keeps this object is gone.

    Whoever keeps the handle keeps this too: a plan, and what it hands out and may go before, such as `Plan.contact`.

    Raises:
        MemoryError: where memory did not suffice.
    """

    def __init__(self, model: Model) -> None:
        masses = model.masses.ctypes.data, model.inverse_masses.ctypes.data
        #: What calls of the engine name the plan by.
        self.handle: int = library().cloth_plan_new(model.particle_count, *masses)
        if not self.handle:
            check(2)
        # Not at exit: a daemon's thread may still be at work with it.
        weakref.finalize(self, library().cloth_plan_free, self.handle).atexit = False
