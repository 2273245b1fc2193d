# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Outcomes of a run: built-in numbers and functions of the user."""

from __future__ import annotations

import math
import numbers
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from cloth_sim_ros.simulation.simulation import Frame, Simulation
from cloth_sim_ros.studies.user_code import USER_ERRORS, Finished, format_error

if TYPE_CHECKING:
    from cloth_sim_ros.simulation.ensemble import EnsembleFrame


class OutcomeError(RuntimeError):
    """Error: a user's outcome function failed; the message gives the cause."""


#: Built-in outcomes of every run, with descriptions.
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
#: Further outcomes of a run whose scene names a distribution of uncertain parameters (`ensemble.file`).
OF_ENSEMBLE = {
    "deviation": "largest deviation of a particle in the ensemble at the end [m]",
    "deviation_rms": "root mean square of the particles' deviations at the end [m]",
}


class OutcomeRecorder:
    """Recorder of a run, which computes outcomes from recorded forces and the simulation's present state.

    Args:
        simulation: the simulation, at its start.
    """

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self._initial = simulation.positions
        self._times: list[float] = []
        self._wrenches: list[Any] = []
        #: Number of frames that may have missed the tolerance.
        self.n_flagged = 0
        #: Sum of the frames' estimated position errors [m]; None if no tolerance is set.
        self.error_estimate: float | None = None
        self._ensemble: EnsembleFrame | None = None

    @property
    def n_frames(self) -> int:
        """Number of recorded frames."""
        return len(self._times)

    def add(self, frame: Frame, ensemble: EnsembleFrame | None = None) -> None:
        """Record a frame of the run, and of its ensemble if it has one."""
        self._ensemble = ensemble
        self._times.append(frame.time)
        self._wrenches.append(frame.wrenches.copy())
        if frame.advance is not None:
            self.n_flagged += bool(frame.advance.flagged)
            if frame.advance.error is not None:
                self.error_estimate = (self.error_estimate or 0.0) + float(frame.advance.error)

    def outcomes(self) -> dict[str, float]:
        """Return the built-in outcomes by name: of present cloth, grips and ensemble, and of all recorded forces."""
        x, v = self._simulation.state.x, self._simulation.state.v
        wrenches = np.array(self._wrenches).reshape(-1, 6)
        forces, torques = wrenches[:, :3], wrenches[:, 3:]
        extent = x.max(axis=1) - x.min(axis=1)
        names, ensemble = self._simulation.grippers.names, self._ensemble
        deviations = {} if ensemble is None else _deviations(ensemble)
        return {
            "mean_height": float(x[2].mean()),
            "lowest_height": float(x[2].min()),
            **{f"extent_{axis}": float(value) for axis, value in zip("xyz", extent, strict=True)},
            "largest_speed": _largest(v.T),
            "largest_force": _largest(forces),
            "largest_torque": _largest(torques),
            "held": float(sum(self._simulation.grasped_count(k) for k in range(len(names)))),
            **deviations,
        }

    def user_outcomes(self, functions: Mapping[str, Callable[..., Any]], values: dict[str, Any]) -> dict[str, Any]:
        """Call the user's outcome functions; return their numbers by name. Raises OutcomeError.

        Args:
            functions: functions by reference; each returns a number, or several numbers by name.
            values: values of the factors of this run.

        Raises:
            OutcomeError: if a function fails; the text names it.
        """
        results: dict[str, Any] = {}
        for reference, function in functions.items():
            try:
                # Each function has its own arrays, in which it may write.
                answer = function(self._finished(values))
            except USER_ERRORS as error:
                raise OutcomeError(f"outcome '{reference}' raised {format_error(error)}") from error
            answers = answer if isinstance(answer, Mapping) else {reference.rpartition(":")[2]: answer}
            for name, value in answers.items():
                if name in BUILT_IN or name in OF_ENSEMBLE:
                    raise OutcomeError(f"outcome '{reference}' gives '{name}', which every run has; rename it")
                if str(name) in results:
                    raise OutcomeError(f"outcome '{reference}' gives '{name}', which another outcome gives; rename one")
                results[str(name)] = _to_float(reference, str(name), value)
        return results

    def _finished(self, values: dict[str, Any]) -> Finished:
        """Return the finished run for one outcome function, in arrays of its own."""
        simulation = self._simulation
        return Finished(
            times=np.array(self._times),
            wrenches=np.array(self._wrenches).reshape(len(self._times), -1, 6),
            initial=self._initial.copy(),
            positions=simulation.positions,
            velocities=simulation.velocities,
            values=dict(values),
        )


def _deviations(ensemble: EnsembleFrame) -> dict[str, float]:
    return {"deviation": ensemble.largest, "deviation_rms": ensemble.root_mean_square}


def _largest(vectors: Any) -> float:
    return float(np.sqrt((vectors * vectors).sum(axis=1).max())) if len(vectors) else 0.0


def _to_float(reference: str, name: str, value: Any) -> Any:
    if isinstance(value, bool | np.bool_):
        return float(value)
    try:
        converted = float(value) if isinstance(value, numbers.Real) else math.nan
    except OverflowError:
        converted = math.inf
    if math.isfinite(converted):
        return converted
    raise OutcomeError(f"outcome '{reference}' gives {value!r} for '{name}'; it must be a finite number")
