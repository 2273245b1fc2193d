# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Linear air drag."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from cloth_sim_ros.physics.terms.base import Array, Term


class Drag(Term):
    """Air at rest slows each particle by the acceleration -rate v.

    Args:
        masses: particle masses [kg], shape (particle_count,).
        rate: drag rate [1/s], at least 0.
    """

    name = "drag"
    damped = True

    def __init__(self, masses: ArrayLike, rate: float) -> None:
        if not (np.isfinite(rate) and rate >= 0.0):
            raise ValueError(f"drag rate is {rate} 1/s; it must be finite and at least 0")
        self.rate = float(rate)
        self._coefficient = self.rate * np.asarray(masses, dtype=np.float64)

    def add_force(self, t: float, x: Array, v: Array, f: Array) -> None:
        f -= self._coefficient * v

    def dissipation(self, t: float, x: Array, v: Array) -> float:
        return float(np.sum(self._coefficient * v * v))

    def add_damping(self, x: Array, blocks: Array) -> None:
        blocks[:3] += self._coefficient

    def multiples(self) -> tuple[None, float, Array]:
        return None, 0.0, self._coefficient

    def add_jacobian_product(self, t: float, x: Array, v: Array, dx: Array, dv: Array, out: Array) -> None:
        out -= self._coefficient * dv
