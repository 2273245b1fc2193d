# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Measures of cloth in contact: penetration, self-intersection, creep."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.contact import self_contact_binding
from cloth_sim_ros.physics.contact.initial_penetration import find_self_intersection
from cloth_sim_ros.physics.contact.obstacle_mesh import nearest_points
from cloth_sim_ros.physics.contact.obstacles import Obstacle
from cloth_sim_ros.physics.model.forces.contact import Contact, ContactSurface
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.plan.plan_handle import PlanHandle


def depth_in_ball(frames: Array, triangles: NDArray[np.int64], radius: float) -> float:
    """Return the largest depth of any triangle point in a ball about the origin [m]; 0 without penetration.

    Args:
        frames: positions [m], (frames, n, 3).
        triangles: (t, 3).
        radius: of the ball [m].
    """
    nearest = radius
    for x in frames:
        # A triangle without area has no normal; its edges are used.
        with np.errstate(invalid="ignore", divide="ignore"):
            points = nearest_points(np.zeros((1, 3)), x[triangles])[0]
        nearest = min(nearest, float(np.sqrt(np.nanmin((points * points).sum(axis=1)))))
    return radius - nearest


def depth(frames: Array, solid: Obstacle, places: Array) -> float:
    """Return the largest depth of any particle in an obstacle [m]; 0 without penetration.

    Args:
        frames: positions [m], (frames, n, 3).
        solid: the obstacle, without rotation.
        places: its position in each frame, or in all frames [m], (frames, 3) or (3,).
    """
    away = frames - np.broadcast_to(places, (len(frames), 3))[:, None, :]
    gaps, _ = solid.distance(away.reshape(-1, 3))
    return max(0.0, -float(gaps.min()))


def crossings(frames: Array, triangles: NDArray[np.int64], rest_positions: Array) -> list[int]:
    """Return the indices of frames in which an edge of the cloth intersects one of its triangles.

    Args:
        frames: positions [m], (frames, n, 3).
        triangles: (t, 3).
        rest_positions: positions at rest [m], (n, 3).
    """
    plan = PlanHandle(Model(np.ones(len(rest_positions)), []))
    # The thickness does not matter for intersection.
    surface = ContactSurface(triangles, rest_positions, thickness=1e-9)
    self_contact_binding.upload_surface(plan.pointer, Contact(thickness=1e-9, surface=surface))
    intersections = (find_self_intersection(plan, np.ascontiguousarray(x.T)) for x in frames)
    return [index for index, intersection in enumerate(intersections) if intersection is not None]


def creep_on_ball(frames: Array, seconds: float, radius: float, contact_range: float) -> float:
    """Return the mean speed of the fastest particle on a ball [m/s]; nan if none is on it.

    Args:
        frames: positions over the measured time [m], (frames, n, 3).
        seconds: length of that time [s].
        radius: of the ball about the origin [m].
        contact_range: a particle within this distance of the ball at both ends of the time is on it [m].
    """
    first, last = frames[0], frames[-1]
    in_contact = np.ones(frames.shape[1], dtype=bool)
    for x in (first, last):
        in_contact &= np.linalg.norm(x, axis=1) - radius <= contact_range
    if not in_contact.any():
        return float("nan")
    return float(np.linalg.norm(last - first, axis=1)[in_contact].max()) / seconds


def sinking(frames: Array, seconds: float, between: NDArray[np.bool_]) -> float:
    """Return the mean downward speed of some particles [m/s].

    Args:
        frames: positions over the measured time [m], (frames, n, 3).
        seconds: length of that time [s].
        between: mask of these particles, (n,).
    """
    return float((frames[0] - frames[-1])[between, 2].mean()) / seconds


def between_pads(start: Array, solid: Obstacle, places: Array) -> NDArray[np.bool_]:
    """Return the mask of particles between the pads, (n,).

    Args:
        start: positions [m], (n, 3).
        solid: a pad; y is normal to its faces.
        places: positions of both pads [m], (2, 3).
    """
    x, _, z = (0.5 * length for length in solid.size)
    away = np.abs(start - places.mean(axis=0))
    between: NDArray[np.bool_] = (away[:, 0] <= x) & (away[:, 2] <= z)
    return between


def dropped(frames: Array, solid: Obstacle, pads: Array) -> int | None:
    """Return the index of the first frame with all of the cloth below the pads; None if there is none.

    Args:
        frames: positions [m], (frames, n, 3).
        solid: a pad.
        pads: positions of both [m], (frames, 2, 3).
    """
    below = frames[:, :, 2].max(axis=1) < pads[:, :, 2].min(axis=1) - 0.5 * solid.size[2]
    return int(np.argmax(below)) if below.any() else None
