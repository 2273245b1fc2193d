# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Couplings: a convex energy that is quadratic in positions, by pairs of particles."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cloth_sim_ros.engine.binding import checked_floats, checked_indices
from cloth_sim_ros.physics.model.forces.force import EngineForce
from cloth_sim_ros.physics.model.parts import ElementList, Part


class Couplings(EngineForce):
    """Linear zero-length springs between pairs of particles: energy Σ k |x_j - x_i|²/2, with k [N/m] of either sign.

    The force on the far end is -k (s + τ ds/dt), s its position relative to the near end. Elastic forces have neither
    resultant nor torque. The caller has to choose constants whose energy is at least 0 for all positions, such as those
    of `shape_operator.ShapeOperator`.

    Args:
        pairs: particle indices of the near and far ends, shape (m, 2).
        constants: k [N/m], shape (m,) or one number.
        damping_time: τ [s], at least 0.
        name: the force's name in a model.

    Raises:
        ValueError: for a shape that does not fit, a pair of a particle and itself, or an entry that is not finite.
    """

    def __init__(
        self, pairs: ArrayLike, constants: ArrayLike, damping_time: float = 0.0, *, name: str = "couplings"
    ) -> None:
        self.name = name
        self.pairs: NDArray[np.int64] = checked_indices(f"pairs of '{name}'", pairs, 2, np.iinfo(np.int64).max)
        loops = np.flatnonzero(self.pairs[:, 0] == self.pairs[:, 1])
        if loops.size:
            particle = self.pairs[loops[0], 0]
            raise ValueError(f"pair {loops[0]} of '{name}' joins particle {particle} to itself; give two particles")
        self.constants = checked_floats(f"constants of '{name}'", constants, (len(self.pairs),))
        if not (math.isfinite(damping_time) and damping_time >= 0.0):
            raise ValueError(f"damping_time of '{name}' is {damping_time} s; it must be finite and at least 0")
        self.damping_time = float(damping_time)
        self.damped = damping_time > 0.0

    def parts(self, particle_count: int) -> Sequence[Part]:
        pairs = checked_indices(f"pairs of '{self.name}'", self.pairs, 2, particle_count)
        if not len(pairs):
            return ()
        elements = ElementList(
            kind="coupling",
            particles=pairs,
            coefficients=self.constants[:, None],
            shared_coefficients=np.array([self.damping_time]),
        )
        return (elements,)
