# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Contact force: obstacles and the cloth itself keep cloth at a distance (docs/contact.md)."""

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
    """A surface of the cloth that neither the cloth nor obstacles may pass through.

    Args:
        triangles: its triangles, shape (m, 3).
        positions: particle positions at rest [m], shape (n, 3).
        thickness: contact thickness [m].
        friction: coefficients of static and kinetic friction between its layers.

    Raises:
        ValueError: for a surface without triangles, a thickness above half its shortest edge (neighbours would touch at
            rest), or invalid friction.
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
        #: Shortest and longest edge at rest [m].
        self.shortest, self.longest = math.sqrt(float(square.min())), math.sqrt(float(square.max()))
        if thickness > 0.5 * self.shortest:
            raise ValueError(
                f"contact thickness is {thickness:g} m, more than half the cloth's shortest edge, {self.shortest:.4g} "
                f"m: neighbours would touch at rest; take {0.49 * self.shortest:.2g} m or less, or a coarser cloth"
            )
        #: Coefficients of static and kinetic friction between layers.
        self.friction = (float(friction[0]), float(friction[1]))
        if not 0.0 <= self.friction[1] <= self.friction[0] < math.inf:
            raise ValueError(
                f"the cloth has friction {friction[0]} at rest and {friction[1]} in motion between its layers; both "
                "must be finite and at least 0, the latter no larger"
            )


class Contact(EngineForce):
    """Contact of particles with moving obstacles and, if given, of the cloth's surface with itself.

    Let g be the gap between a particle and an obstacle, d the thickness and s = g / d. A particle of mass m has the
    energy ``m U^2/2 (1 - s)^4/s`` for s < 1, with U = 35 m/s. The energy is proportional to mass; therefore the motion
    of a sheet does not depend on its mesh. Damping multiplies the force by ``Q(u) = u/2 + sqrt(1 + u^2/4)``. Its
    argument is ``u = kappa w / (1 + kappa a/gamma)``. In it w is the closing speed of the gap, a the force over the
    mass, and gamma = U / (2 d).

    Args:
        obstacles: the first obstacles, with different names.
        pads: jaws of the grippers that pinch; they are absent until `set_jaw_commands` places them.
        thickness: d [m], above 0.
        damping: kappa [s/m], at least 0; at speeds above 1 / kappa much of a bounce is lost.
        frequency: angular frequency of the springs between sticking particles and their anchors [1/s], above 0. On a
            slope a particle gives by about mu g / frequency^2.
        surface: surface of self-contact; None if the cloth may pass through itself.
        faces: surface against points and edges of obstacles; None if only particles touch obstacles.

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
        #: Counters of new obstacles, new paths and new jaw commands; a plan uploads what changed.
        self.changes = self.moves = self.commands = 0
        #: Jaws of the grippers that pinch.
        self.pads = tuple(pads)
        #: For each of them: whether it is present, and whether it closes, shape (pinches, 2).
        self.driven = np.zeros((len(self.pads), 2), dtype=bool)
        self.surface, self.faces = surface, faces
        #: Recovery of reduced thickness: its start [s], its duration [s] and the thickness at its end [m], shape
        #: `ContactBinding.thickness_shape`. The thickness is None if none grows.
        self.recovery: tuple[float, float, Array | None] = (0.0, 0.0, None)
        self.surround(obstacles)

    def surround(self, obstacles: Sequence[Obstacle], paths: Array | None = None) -> None:
        """Set the obstacles.

        Args:
            obstacles: all obstacles, without jaws.
            paths: path of each obstacle over the next frame, then the gripper's path for each jaw, shape (m,
                PATH_NUMBERS), see `Grips`; the default is at rest at the origin.
        """
        names = [obstacle.name for obstacle in obstacles]
        for obstacle in obstacles:
            if names.count(obstacle.name) > 1:
                raise ValueError(f"two obstacles are named '{obstacle.name}'; give each its own name")
            if obstacle.shape not in SHAPES:
                raise ValueError(
                    f"obstacle '{obstacle.name}' is a {obstacle.shape}; the engine knows {', '.join(SHAPES)}"
                )
        #: Obstacles and jaws, two for each gripper that pinches.
        self.obstacles = (*obstacles, *(box for pads in self.pads for box in pads.boxes()))
        #: Whether any obstacle has friction.
        self.rough = any(obstacle.friction[0] > 0.0 for obstacle in self.obstacles)
        if paths is None:
            paths = np.zeros((len(self.obstacles), PATH_NUMBERS))
            paths[:, 16] = 1.0
        self.paths = paths
        self.changes += 1

    def move(self, paths: Array) -> None:
        """Set new paths, shape (m, PATH_NUMBERS), for the present obstacles and jaws."""
        self.paths = paths
        self.moves += 1

    def recover(self, t: float, duration: float = 0.0, thickness: Array | None = None) -> None:
        """Start the recovery of a reduced contact thickness.

        Args:
            t: start of the recovery [s].
            duration: its duration [s].
            thickness: thickness at its end [m]; None if none grows.
        """
        self.recovery = (t, duration, thickness)

    def drive(self, driven: NDArray[np.bool_]) -> None:
        """Set for each gripper that pinches whether it is present and whether it closes, shape (pinches, 2)."""
        if not np.array_equal(driven, self.driven):
            self.driven = driven.copy()
            self.commands += 1

    @property
    def solid_count(self) -> int:
        """Number of obstacles without jaws."""
        return len(self.obstacles) - 2 * len(self.pads)

    @property
    def layered(self) -> bool:
        """True if layers of the cloth have friction."""
        return self.surface is not None and self.surface.friction[0] > 0.0

    @property
    def anchored(self) -> bool:
        """True if any friction exists; then states have anchors."""
        return self.rough or self.layered

    @property
    def remembered(self) -> bool:
        """True if states have anchors or jaws."""
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
        """True if there is anything to touch."""
        return bool(self.obstacles) or self.surface is not None

    def steady(self) -> bool:
        """Return true if no obstacle moves or turns over its path, and no thickness recovers."""
        return self.recovery[2] is None and not (self.paths[:, 4:13].any() or self.paths[:, 17:26].any())
