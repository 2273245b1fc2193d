# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Uniform wind: what linear drag relative to moving air adds to that in still air."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from cloth_sim_ros.physics.terms.base import Array, Term


class Wind(Term):
    """Drag relative to the air is the acceleration -rate (v - w): that of `Drag`, and the constant push rate w of this.

    A constant force, and yet no potential energy: what it does on the cloth is the wind's work (`supply`).

    Args:
        masses: particle masses [kg], shape (particle_count,).
        velocity: of the air [m/s], shape (3,).
        rate: drag rate [1/s], at least 0.
    """

    name = "wind"

    def __init__(self, masses: ArrayLike, velocity: ArrayLike, rate: float) -> None:
        self.velocity = np.asarray(velocity, dtype=np.float64).reshape(3)
        #: Push on every particle [m/s^2], shape (3,).
        self.acceleration: Array = float(rate) * self.velocity
        if not np.isfinite(self.acceleration).all() or rate < 0.0:
            raise ValueError(
                f"wind of {self.velocity.tolist()} m/s at drag rate {rate} 1/s; both must be finite, the rate not "
                "negative"
            )
        self._push = self.acceleration[:, None] * np.asarray(masses, dtype=np.float64)

    def add_force(self, t: float, x: Array, v: Array, f: Array) -> None:
        f += self._push

    def supply(self, t: float, x: Array, v: Array) -> float:
        return float(np.sum(self._push * v))
