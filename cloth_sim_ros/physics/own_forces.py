# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Forces in numpy, as the engine calls for them amid a run."""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from typing import Any

import numpy as np

from cloth_sim_ros.engine.binding import CALLBACK, CALLED_WELL
from cloth_sim_ros.physics.forces.force import Force


class OwnForces:
    """Forces whose formulas are Python's.

    Args:
        forces: of the model.
        shape: of positions and velocities, (3, particle_count).
    """

    def __init__(self, forces: Sequence[Force], shape: tuple[int, int]) -> None:
        self._forces, self._shape = forces, shape
        self._trouble: BaseException | None = None
        #: What the engine calls; kept here, because ctypes does not.
        self.callback = CALLBACK(_caller(weakref.ref(self)))

    def raise_trouble(self) -> None:
        """Raise what ended a run.

        Raises:
            Exception: what a force raised.
            KeyboardInterrupt: where a signal's exception came before the first line that could have caught it; ctypes
                prints that one, and forgets it.
        """
        trouble, self._trouble = self._trouble, None
        raise trouble or KeyboardInterrupt("a signal came between the engine and a force in numpy")

    def call(self, t: float, x: Any, v: Any, f: Any, powers: Any) -> int:
        """Evaluate the forces; `CALLED_WELL` if all went well."""
        try:
            places, speeds, forces = (np.ctypeslib.as_array(array, self._shape) for array in (x, v, f))
            for force in self._forces:
                force.add_force(t, places, speeds, forces)
                if powers:
                    powers[0] += force.dissipation(t, places, speeds)
                    powers[1] += force.supply(t, places, speeds)
        except BaseException as trouble:
            self._trouble = trouble
            return 0
        return CALLED_WELL


def _caller(own: weakref.ref[OwnForces]) -> Any:
    def call(t: float, x: Any, v: Any, f: Any, powers: Any) -> int:
        alive = own()
        return 0 if alive is None else alive.call(t, x, v, f, powers)

    return call
