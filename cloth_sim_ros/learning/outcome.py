# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Outcome of an environment step, for reward and termination functions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.state.state import State


@attrs.frozen(kw_only=True, eq=False)
class Outcome:
    """Outcome of one environment step of N cloths, the read-only argument of reward functions."""

    #: Observed positions [m], shape (N, m, 3), or positions and velocities [m/s], shape (N, m, 6); float32.
    observations: NDArray[np.float32]
    #: Actions of the step, shape (N, grippers, 4 or 8), float32.
    actions: NDArray[np.float32]
    #: Force [N] and torque [N m] of the cloth on each gripper, mean over the last frame, shape (N, grippers, 6).
    wrenches: Array
    #: Number of steps of each episode, including this one, shape (N,).
    elapsed: NDArray[np.int64]
    #: State of each cloth, with all particles in double precision.
    states: Sequence[State]

    @property
    def positions(self) -> NDArray[np.float32]:
        """Positions of the observed particles [m], shape (N, m, 3)."""
        return self.observations[..., :3]

    @property
    def velocities(self) -> NDArray[np.float32]:
        """Velocities of the observed particles [m/s], shape (N, m, 3); shape (N, m, 0) if they are not observed."""
        return self.observations[..., 3:]


#: Function of the user: takes the outcome of a step and returns a number or bool for each cloth, shape (N,).
OutcomeFunction: TypeAlias = Callable[[Outcome], Any]


def evaluate_outcome(name: str, function: OutcomeFunction | None, outcome: Outcome, dtype: type) -> NDArray[Any]:
    """Call a user's reward or termination function; return values (N,), zeros without one. Raises ValueError.

    Args:
        name: name of the function, for the error text.
        function: the function.
        outcome: its argument.
        dtype: type of the values: bool or a float type.

    Raises:
        ValueError: if the result has another shape or is not finite.
    """
    count = len(outcome.states)
    if function is None:
        return np.zeros(count, dtype=dtype)
    values = np.asarray(function(outcome))
    if values.shape != (count,) or values.dtype.kind not in ("b" if dtype is bool else "biuf"):
        kind = "bool" if dtype is bool else "number"
        cause = f"{name} gave an array of shape {values.shape} and type {values.dtype}"
        raise ValueError(f"{cause}; it must give one {kind} for each cloth, shape ({count},)")
    if dtype is not bool and not np.isfinite(values).all():
        k = int(np.flatnonzero(~np.isfinite(values))[0])
        raise ValueError(f"{name} gave {values[k]} for cloth {k}; it must be finite")
    return values.astype(dtype)
