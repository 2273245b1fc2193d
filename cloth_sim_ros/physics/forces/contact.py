# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Contact: obstacles keep particles at a distance (docs/contact.md)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cloth_sim_ros.engine.binding import PATH_NUMBERS, SHAPES, finite
from cloth_sim_ros.physics.forces.force import Array, EngineForce
from cloth_sim_ros.physics.obstacles import Obstacle
from cloth_sim_ros.physics.parts import Part, Surrounded


class Contact(EngineForce):
    """Obstacles that move as commanded, and push particles off that come nearer than a thickness.

    With g the gap between a particle and an obstacle, d the thickness and s = g / d, the energy of a particle of mass m
    is ``m U^2 / 2 (1 - s)^4 / s`` for s < 1, U = 35 m/s. It is in proportion to mass, so that a sheet's motion does not
    depend on its mesh. Damping multiplies the push by Q(u) = u / 2 + sqrt(1 + u^2 / 4), u = kappa w / (1 + kappa a /
    gamma), where w is the speed with which the gap closes, a the push over the mass, and gamma = U / (2 d).

    Args:
        obstacles: what there is at first; names must differ.
        thickness: d [m], above 0.
        damping: kappa [s/m], at least 0: at speeds from 1 / kappa on much of a bounce is lost.
        frequency: of the springs that hold sticking particles to their anchors [1/s], above 0. On a slope a particle
            gives by about mu g / frequency^2.

    Raises:
        ValueError: for a thickness or damping out of range, a shape that the engine has no distance for, or two
            obstacles of one name.
    """

    name = "contact"
    damped = True
    damps_waves = False

    def __init__(
        self, obstacles: Sequence[Obstacle] = (), *, thickness: float, damping: float = 10.0, frequency: float = 2000.0
    ) -> None:
        self.thickness = float(finite("contact thickness", thickness, ()))
        if self.thickness <= 0.0:
            raise ValueError(f"contact thickness is {thickness} m; it must be above 0")
        self.damping = float(finite("contact damping", damping, (), least=0.0))
        self.frequency = float(finite("contact frequency", frequency, ()))
        if self.frequency <= 0.0:
            raise ValueError(f"contact frequency is {frequency} 1/s; it must be above 0")
        #: Count obstacles laid anew, and new paths, so that a plan knows when to look.
        self.changes = self.moves = 0
        self.surround(obstacles)

    def surround(self, obstacles: Sequence[Obstacle], paths: Array | None = None) -> None:
        """Set what obstacles there are.

        Args:
            obstacles: all of them.
            paths: of each over the next frame, shape (m, PATH_NUMBERS), see `Grips`; at rest at the origin where left
                out.
        """
        names = [obstacle.name for obstacle in obstacles]
        for obstacle in obstacles:
            if names.count(obstacle.name) > 1:
                raise ValueError(f"two obstacles are named '{obstacle.name}'; give each its own name")
            if obstacle.shape not in SHAPES:
                raise ValueError(
                    f"obstacle '{obstacle.name}' is a {obstacle.shape}; the engine knows {', '.join(SHAPES)}"
                )
        self.obstacles = tuple(obstacles)
        if paths is None:
            paths = np.zeros((len(obstacles), PATH_NUMBERS))
            paths[:, 16] = 1.0
        self.paths = paths
        self.changes += 1

    def move(self, paths: Array) -> None:
        """Set new paths, shape (m, PATH_NUMBERS), for the obstacles that there are."""
        self.paths = paths
        self.moves += 1

    @property
    def rough(self) -> bool:
        """Whether any obstacle has friction."""
        return any(obstacle.friction[0] > 0.0 for obstacle in self.obstacles)

    def parts(self, particle_count: int) -> Sequence[Part]:
        return (Surrounded(contact=self),)

    def steady(self) -> bool:
        """Whether no obstacle moves or turns over its path."""
        return not (self.paths[:, 4:13].any() or self.paths[:, 17:26].any())
