# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Handle that owns the engine's plan."""

from __future__ import annotations

import weakref

from cloth_sim_ros.engine.binding import check, library
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.plan.uncopyable import Uncopyable


class PlanHandle(Uncopyable):
    """Owner of a model's plan in the engine's memory: frees it with the last reference.

    Every object that uses `pointer` keeps a reference to this object: the plan, and parts that may outlive it, such as
    `Plan.contact`.

    Raises:
        MemoryError: if memory does not suffice.
    """

    def __init__(self, model: Model) -> None:
        masses = model.masses.ctypes.data, model.inverse_masses.ctypes.data
        #: Address of the plan, for calls of the engine.
        self.pointer: int = library().cloth_plan_new(model.particle_count, *masses)
        if not self.pointer:
            check(2)
        # Not at exit: a daemon's thread may still use the plan.
        weakref.finalize(self, library().cloth_plan_free, self.pointer).atexit = False
