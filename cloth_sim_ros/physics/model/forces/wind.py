# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Uniform wind: the difference between linear drag in moving and in still air."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from cloth_sim_ros.engine.binding import checked_floats
from cloth_sim_ros.physics.model.forces.force import Array, EngineForce
from cloth_sim_ros.physics.model.parts import Part, UniformForces


class Wind(EngineForce):
    """Uniform wind of velocity w: the constant acceleration rate * w of every particle.

    Drag relative to the air is the acceleration -rate (v - w). `Drag` has the part -rate v, this force the part rate w.
    The force is constant but counts as work of the wind, not as potential energy.

    Args:
        velocity: velocity w of the air [m/s], shape (3,).
        rate: drag rate [1/s], at least 0.

    Raises:
        ValueError: for numbers that are not finite, or a negative rate.
    """

    name = "wind"

    def __init__(self, velocity: ArrayLike, rate: float) -> None:
        self.velocity: Array = checked_floats("wind", velocity, (3,), one_for_all=False)
        drag_rate = float(checked_floats("drag rate", rate, (), lower=0.0))
        with np.errstate(over="ignore"):
            #: Acceleration of every particle [m/s^2], shape (3,).
            self.acceleration: Array = checked_floats("push of the wind", drag_rate * self.velocity, (3,))

    def parts(self, particle_count: int) -> Sequence[Part]:
        x, y, z = self.acceleration.tolist()
        return (UniformForces(wind=(x, y, z)),)
