# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Contact force: obstacles and the cloth itself keep cloth at a distance (docs/contact.md)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from operator import attrgetter

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cloth_sim_ros.engine.binding import PATH_NUMBERS, SHAPES, checked_floats, checked_indices
from cloth_sim_ros.physics.contact.obstacles import Obstacle
from cloth_sim_ros.physics.contact.parallel_jaw import ParallelJaw
from cloth_sim_ros.physics.model.controls import ContactControls, ThicknessRecovery
from cloth_sim_ros.physics.model.forces.force import Array, EngineForce
from cloth_sim_ros.physics.model.parts import ContactPart, Part
from cloth_sim_ros.physics.model.sheets.merging import component_labels


class ContactSurface:
    """Surface of the cloth that neither the cloth nor obstacles may pass through.

    Args:
        triangles: its triangles, shape (m, 3).
        positions: particle positions at rest [m], shape (n, 3).
        thickness: contact thickness [m].
        friction: coefficients of static and kinetic friction between its layers.
        edge_lengths: rest lengths of each triangle's edges [m], shape (m, 3); None takes them from `positions`.
        joints: pairs of joined particles, shape (j, 2). Particles that joints connect do not touch each other.

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
        friction: Sequence[float] = (0.0, 0.0),
        edge_lengths: Array | None = None,
        joints: ArrayLike = (),
    ) -> None:
        points = checked_floats("positions of the surface", positions, np.shape(positions))
        self.triangles = checked_indices("triangles of the surface", triangles, 3, len(points))
        if not len(self.triangles):
            raise ValueError("a surface without triangles can't touch itself; give its triangles")
        edges = points[self.triangles[:, [1, 2, 0]]] - points[self.triangles]
        square = edges[..., 0] * edges[..., 0] + edges[..., 1] * edges[..., 1] + edges[..., 2] * edges[..., 2]
        self.particle_count = len(points)
        #: Shortest and longest edge at rest [m].
        self.min_edge, self.max_edge = math.sqrt(float(square.min())), math.sqrt(float(square.max()))
        #: Scale of searches for pairs [m]: in a compressed net, rest lengths would find all pairs.
        self.search_length = self.min_edge
        if edge_lengths is not None:
            self.min_edge, self.max_edge = float(edge_lengths.min()), float(edge_lengths.max())
            self.search_length = min(self.search_length, self.min_edge)
        if thickness > 0.5 * self.min_edge:
            raise ValueError(
                f"contact thickness is {thickness:g} m, more than half the cloth's shortest edge, {self.min_edge:.4g} "
                f"m: neighbours would touch at rest; take {0.49 * self.min_edge:.2g} m or less, or a coarser cloth"
            )
        pairs = checked_indices("joints of the surface", joints, 2, len(points))
        #: For each particle the lowest one that joints connect with it, shape (n,); None without joints.
        self.joined: NDArray[np.int64] | None = None
        if len(pairs):
            label = component_labels(pairs, len(points))
            self.joined = np.ascontiguousarray(np.unique(label, return_index=True)[1][label], dtype=np.int64)
        #: Coefficients of static and kinetic friction between layers.
        self.friction = (float(friction[0]), float(friction[1]))
        if not 0.0 <= self.friction[1] <= self.friction[0] < math.inf:
            raise ValueError(
                f"the cloth has friction {friction[0]} at rest and {friction[1]} in motion between its layers; both "
                "must be finite and at least 0, the latter no larger"
            )


class Contact(EngineForce):
    """Contact force between particles and moving obstacles and, if given, between layers of the cloth's surface.

    Let g be the gap between a particle and an obstacle, d the thickness and s = g / d. A particle of mass m has the
    energy ``m U^2/2 (1 - s)^4/s`` for s < 1, with U = 35 m/s. The energy is proportional to mass; therefore the motion
    of a sheet does not depend on its mesh. Damping multiplies the force by ``Q(u) = u/2 + sqrt(1 + u^2/4)``. Its
    argument is ``u = kappa w / (1 + kappa a/gamma)``. In it w is the closing speed of the gap, a the force over the
    mass, and gamma = U / (2 d).

    Args:
        obstacles: the first obstacles, with different names.
        jaws: jaws of the grippers that pinch; they are absent until `set_jaw_commands` places them.
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

    paths = property(attrgetter("controls.paths"))
    jaw_commands = property(attrgetter("controls.jaw_commands"))

    def __init__(
        self,
        obstacles: Sequence[Obstacle] = (),
        *,
        thickness: float,
        damping: float = 10.0,
        frequency: float = 2000.0,
        jaws: Sequence[ParallelJaw] = (),
        surface: ContactSurface | None = None,
        faces: ContactSurface | None = None,
    ) -> None:
        self.thickness = float(checked_floats("contact thickness", thickness, ()))
        if self.thickness <= 0.0:
            raise ValueError(f"contact thickness is {thickness} m; it must be above 0")
        self.damping = float(checked_floats("contact damping", damping, (), lower=0.0))
        self.frequency = float(checked_floats("contact frequency", frequency, ()))
        if self.frequency <= 0.0:
            raise ValueError(f"contact frequency is {frequency} 1/s; it must be above 0")
        #: Jaws of the grippers that pinch.
        self.jaws = tuple(jaws)
        self.surface, self.faces = surface, faces
        names = [obstacle.name for obstacle in obstacles]
        for obstacle in obstacles:
            if names.count(obstacle.name) > 1:
                raise ValueError(f"two obstacles are named '{obstacle.name}'; give each its own name")
            if obstacle.shape not in SHAPES:
                raise ValueError(
                    f"obstacle '{obstacle.name}' is a {obstacle.shape}; the engine knows {', '.join(SHAPES)}"
                )
        #: Obstacles and jaws, two for each gripper that pinches.
        self.obstacles = (*obstacles, *(box for jaw in self.jaws for box in jaw.boxes()))
        #: Number of obstacles without jaws.
        self.n_solids = len(obstacles)
        #: Whether any obstacle has friction; layers of the cloth; either of them, so that states have anchors.
        self.has_friction = any(obstacle.friction[0] > 0.0 for obstacle in self.obstacles)
        self.has_self_friction = surface is not None and surface.friction[0] > 0.0
        self.has_anchors = self.has_friction or self.has_self_friction
        #: Whether states have anchors or jaws.
        self.has_memory = bool(self.jaws) or self.has_anchors
        #: Whether there is anything to touch.
        self.is_active = bool(self.obstacles) or surface is not None
        paths = np.zeros((len(self.obstacles), PATH_NUMBERS))
        paths[:, 16] = 1.0
        #: Paths of obstacles and jaws, jaw commands and recovery of thickness.
        self.controls = ContactControls(paths, np.zeros((len(self.jaws), 2), dtype=bool))

    def set_paths(self, paths: Array) -> None:
        """Set the paths of obstacles and jaws from the next frame on, shape (m, PATH_NUMBERS)."""
        self.controls = self.controls._replace(paths=np.array(paths, dtype=np.float64))

    def set_jaw_commands(self, commands: NDArray[np.bool_]) -> None:
        """Set for each gripper that pinches whether it has a pose and whether it closes, shape (pinches, 2)."""
        self.controls = self.controls._replace(jaw_commands=commands.copy())

    def start_recovery(
        self, t: float, duration: float = 0.0, thickness: Array | None = None, start: Array | None = None
    ) -> None:
        """Start growth of the contact thickness from `start` to `thickness` [m] in a duration [s]; None stops it.

        Args:
            t: start of the recovery [s].
            duration: its duration [s].
            thickness: thickness at its end [m]; None if none grows.
            start: thickness at its start [m].
        """
        self.controls = self.controls._replace(recovery=ThicknessRecovery(t, duration, thickness, start))

    def parts(self, particle_count: int) -> Sequence[Part]:
        for surface in (self.surface, self.faces):
            if surface is not None and surface.particle_count != particle_count:
                raise ValueError(
                    f"the cloth's surface in contact has {surface.particle_count} particles, the model "
                    f"{particle_count}; give the model's own"
                )
        return (ContactPart(contact=self),)

    def steady(self) -> bool:
        """Return true if no obstacle near the cloth moves in this frame, and no thickness recovers."""
        paths, recovery, is_away = self.controls.paths, self.controls.recovery, self.controls.is_away
        if is_away is not None and is_away.any():
            paths = np.concatenate([paths[: len(is_away)][~is_away], paths[len(is_away) :]])
        moves = bool(self.obstacles) and (paths[:, 4:13].any() or paths[:, 17:26].any())
        return recovery.target is None and not moves
