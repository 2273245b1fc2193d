# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Python forces that the engine calls back during a run."""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from typing import Any

import numpy as np

from cloth_sim_ros.engine.binding import CALLBACK, CALLED_WELL
from cloth_sim_ros.physics.model.forces.force import Force


class PythonForces:
    """Callback by which the engine evaluates a model's Python forces.

    Args:
        forces: the Python forces of the model.
        shape: shape of positions and velocities, (3, particle_count).
    """

    def __init__(self, forces: Sequence[Force], shape: tuple[int, int]) -> None:
        self._forces, self._shape = forces, shape
        self._exception: BaseException | None = None
        #: The engine's callback; kept here because ctypes does not keep it.
        self.callback = CALLBACK(_make_callback(weakref.ref(self)))

    def raise_pending(self) -> None:
        """Raise and forget the exception of a Python force that ended a run; without one, KeyboardInterrupt.

        Raises:
            Exception: the exception of a force.
            KeyboardInterrupt: if a signal's exception came before the first line that could catch it. ctypes prints
                that exception and loses it.
        """
        exception, self._exception = self._exception, None
        raise exception or KeyboardInterrupt("a signal came between the engine and a force in numpy")

    def evaluate(self, t: float, x: Any, v: Any, f: Any, powers: Any) -> int:
        """Add all forces [N] to f, and their powers [W] if requested; return `CALLED_WELL`, or 0 after an exception."""
        try:
            positions, velocities, forces = (np.ctypeslib.as_array(array, self._shape) for array in (x, v, f))
            for force in self._forces:
                force.add_force(t, positions, velocities, forces)
                if powers:
                    powers[0] += force.dissipation(t, positions, velocities)
                    powers[1] += force.external_power(t, positions, velocities)
        except BaseException as exception:
            self._exception = exception
            return 0
        return CALLED_WELL


def _make_callback(reference: weakref.ref[PythonForces]) -> Any:
    def call(t: float, x: Any, v: Any, f: Any, powers: Any) -> int:
        python_forces = reference()
        return 0 if python_forces is None else python_forces.evaluate(t, x, v, f, powers)

    return call
