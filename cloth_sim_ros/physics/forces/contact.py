# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Contact: obstacles, and the cloth itself, keep cloth at a distance (docs/contact.md)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cloth_sim_ros.engine.binding import PATH_NUMBERS, SHAPES, finite, indices
from cloth_sim_ros.physics.forces.force import Array, EngineForce
from cloth_sim_ros.physics.obstacles import Obstacle
from cloth_sim_ros.physics.parts import Part, Surrounded
from cloth_sim_ros.physics.pinch import Pads


class OwnSurface:
    """The surface of a cloth that nothing is to pass through, itself or obstacles.

    Args:
        triangles: its triangles, shape (m, 3).
        positions: of its particles at rest [m], shape (n, 3).
        thickness: distance that it keeps from itself [m].
        friction: coefficients of static and kinetic friction between its layers.

    Raises:
        ValueError: for a surface without triangles, a thickness above half its shortest edge (neighbours would touch at
            rest), or friction that is none.
    """

    def __init__(
        self,
        triangles: ArrayLike,
        positions: ArrayLike,
        *,
        thickness: float,
        friction: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        places = finite("positions of the surface", positions, np.shape(positions))
        self.triangles = indices("triangles of the surface", triangles, 3, len(places))
        if not len(self.triangles):
            raise ValueError("a surface without triangles can't touch itself; give its triangles")
        ends = places[self.triangles[:, [1, 2, 0]]] - places[self.triangles]
        square = ends[..., 0] * ends[..., 0] + ends[..., 1] * ends[..., 1] + ends[..., 2] * ends[..., 2]
        self.particle_count = len(places)
        #: Its shortest and its longest edge at rest [m].
        self.shortest, self.longest = math.sqrt(float(square.min())), math.sqrt(float(square.max()))
        if thickness > 0.5 * self.shortest:
            raise ValueError(
                f"contact thickness is {thickness:g} m, more than half the cloth's shortest edge, {self.shortest:.4g} "
                f"m: neighbours would touch at rest; take {0.49 * self.shortest:.2g} m or less, or a coarser cloth"
            )
        #: Coefficients of friction between layers, at rest and in motion.
        self.friction = (float(friction[0]), float(friction[1]))
        if not 0.0 <= self.friction[1] <= self.friction[0] < math.inf:
            raise ValueError(
                f"the cloth has friction {friction[0]} at rest and {friction[1]} in motion between its layers; both "
                "must be finite and at least 0, the latter no larger"
            )


class Contact(EngineForce):
    """Obstacles that move as commanded, and push particles off that come nearer than a thickness; so does the cloth's
    own surface where it is given.

    With g the gap between a particle and an obstacle, d the thickness and s = g / d, the energy of a particle of mass m
    is ``m U^2 / 2 (1 - s)^4 / s`` for s < 1, U = 35 m/s. It is in proportion to mass, so that a sheet's motion does not
    depend on its mesh. Damping multiplies the push by Q(u) = u / 2 + sqrt(1 + u^2 / 4), u = kappa w / (1 + kappa a /
    gamma), where w is the speed with which the gap closes, a the push over the mass, and gamma = U / (2 d).

    Args:
        obstacles: what there is at first; names must differ.
        pads: of the grippers that pinch; they are nowhere until `drive` says so.
        thickness: d [m], above 0.
        damping: kappa [s/m], at least 0: at speeds from 1 / kappa on much of a bounce is lost.
        frequency: of the springs that hold sticking particles to their anchors [1/s], above 0. On a slope a particle
            gives by about mu g / frequency^2.
        surface: what is not to pass through itself; None where the cloth may.
        faces: what points and edges of obstacles are kept out of; None where particles alone are kept out.

    Raises:
        ValueError: for a thickness or damping out of range, a shape that the engine has no distance for, or two
            obstacles of one name.
    """

    name = "contact"
    damped = True
    damps_waves = False

    def __init__(
        self,
        obstacles: Sequence[Obstacle] = (),
        *,
        thickness: float,
        damping: float = 10.0,
        frequency: float = 2000.0,
        pads: Sequence[Pads] = (),
        surface: OwnSurface | None = None,
        faces: OwnSurface | None = None,
    ) -> None:
        self.thickness = float(finite("contact thickness", thickness, ()))
        if self.thickness <= 0.0:
            raise ValueError(f"contact thickness is {thickness} m; it must be above 0")
        self.damping = float(finite("contact damping", damping, (), least=0.0))
        self.frequency = float(finite("contact frequency", frequency, ()))
        if self.frequency <= 0.0:
            raise ValueError(f"contact frequency is {frequency} 1/s; it must be above 0")
        #: Count obstacles laid anew, new paths and new commands to drives, so that a plan knows when to look.
        self.changes = self.moves = self.commands = 0
        #: Of the grippers that pinch.
        self.pads = tuple(pads)
        #: Whether each of those is anywhere, and whether it closes, shape (pinches, 2).
        self.driven = np.zeros((len(self.pads), 2), dtype=bool)
        self.surface, self.faces = surface, faces
        #: When contacts with a reduced thickness begin to regain it, for how long [s], and their thickness then [m], of
        #: shape `Touching.thickness_shape`; None where none does.
        self.recovery: tuple[float, float, Array | None] = (0.0, 0.0, None)
        self.surround(obstacles)

    def surround(self, obstacles: Sequence[Obstacle], paths: Array | None = None) -> None:
        """Set what obstacles there are.

        Args:
            obstacles: all of them, pads aside.
            paths: of each over the next frame, shape (m, PATH_NUMBERS), see `Grips`, and behind them of the gripper of
                each pad; at rest at the origin where left out.
        """
        names = [obstacle.name for obstacle in obstacles]
        for obstacle in obstacles:
            if names.count(obstacle.name) > 1:
                raise ValueError(f"two obstacles are named '{obstacle.name}'; give each its own name")
            if obstacle.shape not in SHAPES:
                raise ValueError(
                    f"obstacle '{obstacle.name}' is a {obstacle.shape}; the engine knows {', '.join(SHAPES)}"
                )
        #: Pads included, two for each gripper that pinches.
        self.obstacles = (*obstacles, *(box for pads in self.pads for box in pads.boxes()))
        #: Whether any obstacle has friction.
        self.rough = any(obstacle.friction[0] > 0.0 for obstacle in self.obstacles)
        if paths is None:
            paths = np.zeros((len(self.obstacles), PATH_NUMBERS))
            paths[:, 16] = 1.0
        self.paths = paths
        self.changes += 1

    def move(self, paths: Array) -> None:
        """Set new paths, shape (m, PATH_NUMBERS), for the obstacles and pads that there are."""
        self.paths = paths
        self.moves += 1

    def recover(self, t: float, duration: float = 0.0, thickness: Array | None = None) -> None:
        """Let contacts with a reduced thickness, that of time t [s], grow to another one [m] in a duration [s]; none
        grows if that is left out.
        """
        self.recovery = (t, duration, thickness)

    def drive(self, driven: NDArray[np.bool_]) -> None:
        """Set whether each gripper that pinches is anywhere, and whether it closes, shape (pinches, 2)."""
        if not np.array_equal(driven, self.driven):
            self.driven = driven.copy()
            self.commands += 1

    @property
    def solid_count(self) -> int:
        """Number of obstacles that are no pads."""
        return len(self.obstacles) - 2 * len(self.pads)

    @property
    def layered(self) -> bool:
        """Whether layers of the cloth have friction."""
        return self.surface is not None and self.surface.friction[0] > 0.0

    @property
    def anchored(self) -> bool:
        """Whether there is friction anywhere, and so anchors."""
        return self.rough or self.layered

    @property
    def remembered(self) -> bool:
        """Whether states have anchors or pads."""
        return bool(self.pads) or self.anchored

    def parts(self, particle_count: int) -> Sequence[Part]:
        for surface in (self.surface, self.faces):
            if surface is not None and surface.particle_count != particle_count:
                raise ValueError(
                    f"the cloth's surface in contact has {surface.particle_count} particles, the model "
                    f"{particle_count}; give the model's own"
                )
        return (Surrounded(contact=self),)

    @property
    def acts(self) -> bool:
        """Whether there is anything to touch."""
        return bool(self.obstacles) or self.surface is not None

    def steady(self) -> bool:
        """Whether no obstacle moves or turns over its path, and no contact regains its thickness."""
        return self.recovery[2] is None and not (self.paths[:, 4:13].any() or self.paths[:, 17:26].any())
