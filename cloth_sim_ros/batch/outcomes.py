# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a run came to, in a few numbers: those that every run has, and functions of the user's."""

from __future__ import annotations

import numbers
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from cloth_sim_ros.batch.user_code import USER_ERRORS, Finished, in_words
from cloth_sim_ros.simulation.simulation import Frame, Simulation


class OutcomeError(RuntimeError):
    """An outcome of the user's own that can't be taken; the message says why."""


#: The outcomes of every run, and what each is.
BUILT_IN = {
    "mean_height": "mean height of the particles at the end [m]",
    "lowest_height": "lowest height of a particle at the end [m]",
    "extent_x": "extent along x at the end [m]",
    "extent_y": "extent along y at the end [m]",
    "extent_z": "extent along z at the end [m]",
    "largest_speed": "largest speed of a particle at the end [m/s]",
    "largest_force": "largest force of the cloth on a gripper, mean over a frame [N]",
    "largest_torque": "largest torque of the cloth on a gripper, mean over a frame [N m]",
    "held": "particles that grippers hold at the end",
}


class OutcomeWatch:
    """Looks on while a simulation runs."""

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self._initial = simulation.positions
        self._times: list[float] = []
        self._wrenches: list[Any] = []
        #: Frames that missed their share of the tolerance.
        self.flagged = 0
        #: Sum of the frames' estimated position errors [m]; None where no tolerance is set.
        self.error: float | None = None

    @property
    def frames(self) -> int:
        """Frames that were seen."""
        return len(self._times)

    def add(self, frame: Frame) -> None:
        """Take a frame."""
        self._times.append(frame.time)
        self._wrenches.append(frame.wrenches.copy())
        if frame.advance is not None:
            self.flagged += bool(frame.advance.flagged)
            if frame.advance.error is not None:
                self.error = (self.error or 0.0) + float(frame.advance.error)

    def outcomes(self) -> dict[str, float]:
        """The built-in outcomes."""
        x, v = self._simulation.state.x, self._simulation.state.v
        wrenches = np.array(self._wrenches).reshape(-1, 6)
        forces, torques = wrenches[:, :3], wrenches[:, 3:]
        extent = x.max(axis=1) - x.min(axis=1)
        names = self._simulation.grippers.names
        return {
            "mean_height": float(x[2].mean()),
            "lowest_height": float(x[2].min()),
            **{f"extent_{axis}": float(value) for axis, value in zip("xyz", extent, strict=True)},
            "largest_speed": _largest(v.T),
            "largest_force": _largest(forces),
            "largest_torque": _largest(torques),
            "held": float(sum(self._simulation.held(k) for k in range(len(names)))),
        }

    def own(self, functions: Mapping[str, Callable[..., Any]], values: dict[str, Any]) -> dict[str, Any]:
        """Outcomes of the user's functions, by reference; one may return a number or several by name.

        Raises:
            OutcomeError: naming the function.
        """
        simulation = self._simulation
        finished = Finished(
            times=np.array(self._times),
            wrenches=np.array(self._wrenches).reshape(len(self._times), -1, 6),
            initial=self._initial,
            positions=simulation.positions,
            velocities=simulation.velocities,
            values=dict(values),
        )
        found: dict[str, Any] = {}
        for reference, function in functions.items():
            try:
                answer = function(finished)
            except USER_ERRORS as error:
                raise OutcomeError(f"outcome '{reference}' raised {in_words(error)}") from error
            answers = answer if isinstance(answer, Mapping) else {reference.rpartition(":")[2]: answer}
            for name, value in answers.items():
                if name in BUILT_IN:
                    raise OutcomeError(f"outcome '{reference}' gives '{name}', which every run has; name it otherwise")
                found[str(name)] = _plain(reference, str(name), value)
        return found


def _largest(vectors: Any) -> float:
    return float(np.sqrt((vectors * vectors).sum(axis=1).max())) if len(vectors) else 0.0


def _plain(reference: str, name: str, value: Any) -> Any:
    if isinstance(value, bool | np.bool_):
        return float(value)
    if isinstance(value, numbers.Real) and np.isfinite(float(value)):
        return float(value)
    raise OutcomeError(f"outcome '{reference}' gives {value!r} for '{name}'; it must be a finite number")
