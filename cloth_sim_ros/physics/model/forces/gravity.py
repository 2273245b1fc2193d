# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Uniform gravity."""

from __future__ import annotations

from collections.abc import Sequence

from numpy.typing import ArrayLike

from cloth_sim_ros.engine.binding import checked_floats
from cloth_sim_ros.physics.model.forces.force import Array, EngineForce
from cloth_sim_ros.physics.model.parts import Part, UniformForces


class Gravity(EngineForce):
    """Uniform gravity: weight m g of every particle; energy -m g·x.

    Args:
        acceleration: gravitational acceleration g [m/s^2], shape (3,).

    Raises:
        ValueError: for an acceleration that is not three finite numbers.
    """

    name = "gravity"

    def __init__(self, acceleration: ArrayLike = (0.0, 0.0, -9.81)) -> None:
        self.acceleration: Array = checked_floats("acceleration", acceleration, (3,), one_for_all=False)

    def parts(self, particle_count: int) -> Sequence[Part]:
        x, y, z = self.acceleration.tolist()
        return (UniformForces(gravity=(x, y, z)),)
