# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Springs between pairs of particles: S1, S2, S4 to S7 of the model, on any list of pairs."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cloth_sim_ros.physics.kernels import pairs as kernels
from cloth_sim_ros.physics.terms.base import Array, Term


class PairSprings(Term):
    """Damped springs by the lecture's law (S1), joints where the rest length is zero (S4).

    Args:
        pairs: particle indices of the near and far ends, shape (m, 2).
        rest_length: rest lengths l0 [m], shape (m,) or one number; zero makes a joint.
        stiffness: k_s / l0 [N/m], shape (m,) or one number: the lecture's k_s [N] divided by the rest length.
        damping: k_d [N s/m], shape (m,) or one number.
        name: the term's name in a model.
        weak: whether it may be evaluated less often than every step.

    Raises:
        ValueError: for a shape that does not fit, a spring from a particle to itself, or a negative or non-finite
        value.
    """

    def __init__(
        self,
        pairs: ArrayLike,
        rest_length: ArrayLike,
        stiffness: ArrayLike,
        damping: ArrayLike = 0.0,
        *,
        name: str = "springs",
        weak: bool = False,
    ) -> None:
        self.pairs = np.ascontiguousarray(pairs, dtype=np.int64).reshape(-1, 2)
        count = len(self.pairs)
        self.rest_length = _per_spring("rest_length", rest_length, count)
        self.stiffness = _per_spring("stiffness", stiffness, count)
        self.damping = _per_spring("damping", damping, count)
        loops = np.flatnonzero(self.pairs[:, 0] == self.pairs[:, 1])
        if loops.size:
            particle = self.pairs[loops[0], 0]
            raise ValueError(f"spring {loops[0]} of '{name}' joins particle {particle} to itself; give two particles")
        if count and self.pairs.min() < 0:
            raise ValueError(f"'{name}' has a negative particle index {self.pairs.min()}; indices count from 0")
        self.name = name
        self.weak = weak
        self.damped = bool(np.any(self.damping))

    def add_force(self, t: float, x: Array, v: Array, f: Array) -> None:
        kernels.add_pair_forces(self.pairs, self.rest_length, self.stiffness, self.damping, x, v, f)

    def energy(self, t: float, x: Array) -> float:
        return float(kernels.pair_energy(self.pairs, self.rest_length, self.stiffness, x))

    def dissipation(self, t: float, x: Array, v: Array) -> float:
        return float(kernels.pair_dissipation(self.pairs, self.rest_length, self.damping, x, v))

    def add_stiffness(self, x: Array, blocks: Array) -> None:
        kernels.add_pair_stiffness(self.pairs, self.rest_length, self.stiffness, x, blocks)

    def add_damping(self, x: Array, blocks: Array) -> None:
        kernels.add_pair_damping(self.pairs, self.rest_length, self.damping, x, blocks)

    def add_jacobian_product(self, t: float, x: Array, v: Array, dx: Array, dv: Array, out: Array) -> None:
        kernels.add_pair_jacobian_product(self.pairs, self.rest_length, self.stiffness, self.damping, x, v, dx, dv, out)

    def coupled_pairs(self) -> NDArray[np.int64] | None:
        return self.pairs

    def pair_blocks(self, x: Array, stiffness_weight: float, damping_weight: float) -> Array:
        blocks = np.empty((len(self.pairs), 6))
        kernels.pair_blocks(
            self.pairs,
            self.rest_length,
            self.stiffness,
            self.damping,
            x,
            stiffness_weight,
            damping_weight,
            blocks,
        )
        return blocks


def lecture_damping(k_d0: ArrayLike, stiffness: ArrayLike, mass: ArrayLike) -> Array:
    """Return k_d = k_d0 sqrt(m k) [N s/m] for the dimensionless k_d0, k = k_s / l0 [N/m] and mass [kg] (S1; S4 at l0 =
    0).
    """
    return np.asarray(k_d0) * np.sqrt(np.asarray(mass, dtype=float) * np.asarray(stiffness, dtype=float))


def _per_spring(what: str, value: ArrayLike, count: int) -> Array:
    array = np.asarray(value, dtype=np.float64)
    if array.ndim and array.shape != (count,):
        raise ValueError(f"{what} has shape {array.shape} for {count} springs; give one number or one a spring")
    array = np.array(np.broadcast_to(array, (count,)))
    wrong = np.flatnonzero(~(np.isfinite(array) & (array >= 0.0)))
    if wrong.size:
        raise ValueError(f"{what} of spring {wrong[0]} is {array[wrong[0]]}; it must be finite and at least 0")
    return array
