# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a step of many cloths led to: what users' functions of reward and termination are given."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.state import State


@attrs.frozen(kw_only=True, eq=False)
class Outcome:
    """One step of N cloths. Nothing of it may be written into."""

    #: What is observed, shape (N, m, 3), or (N, m, 6) with velocities, float32.
    observations: NDArray[np.float32]
    #: What was commanded, shape (N, grippers, 4 or 8), float32.
    actions: NDArray[np.float32]
    #: Force [N] and torque [N m] of the cloth on each gripper, mean over the last frame, shape (N, grippers, 6).
    wrenches: Array
    #: Steps of each episode so far, this one included, shape (N,).
    elapsed: NDArray[np.int64]
    #: Each cloth's state in double precision, all particles.
    states: Sequence[State]

    @property
    def positions(self) -> NDArray[np.float32]:
        """Positions of the observed particles [m], shape (N, m, 3)."""
        return self.observations[..., :3]

    @property
    def velocities(self) -> NDArray[np.float32]:
        """Velocities of the observed particles [m/s], shape (N, m, 3); none where they are not observed."""
        return self.observations[..., 3:]


#: A user's function: takes a step of all cloths and returns a number, or a truth value, for each, shape (N,).
Judge: TypeAlias = Callable[[Outcome], Any]


def judged(what: str, judge: Judge | None, outcome: Outcome, dtype: type) -> NDArray[Any]:
    """Return what a user's function says of each cloth; zeros, or false, without one.

    Raises:
        ValueError: for another shape, or a number that is not finite.
    """
    count = len(outcome.states)
    if judge is None:
        return np.zeros(count, dtype=dtype)
    found = np.asarray(judge(outcome))
    if found.shape != (count,) or found.dtype.kind not in ("b" if dtype is bool else "biuf"):
        kind = "truth value" if dtype is bool else "number"
        raise ValueError(
            f"{what} gave an array of shape {found.shape} and type {found.dtype}; it must give one {kind} for each "
            f"cloth, shape ({count},)"
        )
    if dtype is not bool and not np.isfinite(found).all():
        k = int(np.flatnonzero(~np.isfinite(found))[0])
        raise ValueError(f"{what} gave {found[k]} for cloth {k}; it must be finite")
    return found.astype(dtype)
