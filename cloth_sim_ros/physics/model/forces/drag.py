# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Linear air drag."""

from __future__ import annotations

from collections.abc import Sequence

from cloth_sim_ros.engine.binding import checked_floats
from cloth_sim_ros.physics.model.forces.force import EngineForce
from cloth_sim_ros.physics.model.parts import Part, UniformForces


class Drag(EngineForce):
    """Linear drag of each particle in still air: the acceleration -rate v.

    Args:
        rate: drag rate [1/s], at least 0.

    Raises:
        ValueError: for a rate that is not finite or negative.
    """

    name = "drag"
    damped = True
    damps_waves = False

    def __init__(self, rate: float) -> None:
        self.rate = float(checked_floats("drag rate", rate, (), lower=0.0))

    def parts(self, particle_count: int) -> Sequence[Part]:
        return (UniformForces(drag=self.rate),)
