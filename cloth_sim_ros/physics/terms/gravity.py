# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Uniform gravity."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from cloth_sim_ros.physics.terms.base import Array, Term


class Gravity(Term):
    """Weight m g of every particle.

    Args:
        masses: particle masses [kg], shape (particle_count,).
        acceleration: gravitational acceleration [m/s^2], shape (3,).
    """

    name = "gravity"

    def __init__(self, masses: ArrayLike, acceleration: ArrayLike) -> None:
        self.acceleration = np.asarray(acceleration, dtype=np.float64).reshape(3)
        self.masses = np.asarray(masses, dtype=np.float64)

    @cached_property
    def _weight(self) -> Array:
        """Weights [N], shape (3, particle_count); a fused plan needs none."""
        return self.acceleration[:, None] * self.masses

    def add_force(self, t: float, x: Array, v: Array, f: Array) -> None:
        f += self._weight

    def energy(self, t: float, x: Array) -> float:
        # Not a BLAS product: its result may depend on the number of threads.
        return -float(np.sum(self._weight * x))
