# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Initial penetration check: refuses starts inside obstacles or through the cloth."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from cloth_sim_ros.engine.binding import address, check, float64_address, library
from cloth_sim_ros.physics.arithmetic.deterministic_math import row_sum
from cloth_sim_ros.physics.contact.obstacle_mesh import nearest_points
from cloth_sim_ros.physics.contact.obstacles import Obstacle
from cloth_sim_ros.physics.contact.thickness import MIN_GAP
from cloth_sim_ros.physics.model.forces.contact import ContactSurface
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.plan_handle import PlanHandle

#: Least gap of a starting cloth to itself, as a fraction of the thickness.
MIN_START_GAP = MIN_GAP
#: Number of particles with the stiffest contact that are searched for the nearest one.
_MAX_CANDIDATES = 16
_REMEDY = "start from another state, or set contact.self to false"


def check_outside(t: float, obstacles: Sequence[Obstacle], gaps: Iterable[float]) -> None:
    """Raise ValueError if the cloth is inside an obstacle at time t [s]: if its gap to one is not positive.

    Args:
        t: time [s].
        obstacles: the obstacles.
        gaps: least gap to each obstacle [m]; negative inside.

    Raises:
        ValueError: for a gap that is not positive, naming the obstacle.
    """
    for obstacle, gap in zip(obstacles, gaps, strict=True):
        if gap <= 0.0:
            raise ValueError(
                f"the cloth is {-gap:.4g} m deep inside obstacle '{obstacle.name}' at {t:.6g} s, and contact "
                "has no force there; move the cloth or the obstacle"
            )


def find_self_intersection(engine_plan: PlanHandle, x: Array) -> list[int] | None:
    """Return five particles: the first edge and triangle of the cloth that intersect; None if there are none.

    An edge that shares a corner with the triangle does not count.

    Args:
        engine_plan: handle of the engine's plan, which has the surface.
        x: particle positions [m], shape (3, n).

    Returns:
        The edge's two particles, then the triangle's three.
    """
    out = np.empty(5, dtype=np.int64)
    check(library().cloth_self_intersection(engine_plan.pointer, float64_address("x", x, x.shape), address(out)))
    corners: list[int] = out.tolist()
    return None if corners[0] < 0 else corners


def check_initial_penetration(engine_plan: PlanHandle, surface: ContactSurface, thickness: float, x: Array) -> None:
    """Raise ValueError if the cloth intersects itself, or is closer to itself than the least gap of a start.

    Args:
        engine_plan: handle of the engine's plan, which has the surface.
        surface: surface of the cloth.
        thickness: contact thickness [m].
        x: particle positions [m], shape (3, n).

    Raises:
        ValueError: naming the first intersecting edge and triangle, or the nearest particle and triangle, with the
            position.
    """
    intersection = find_self_intersection(engine_plan, x)
    if intersection is not None:
        a, b, *triangle = intersection
        position = _rounded(0.5 * (x[:, a] + x[:, b]))
        raise ValueError(
            f"the cloth passes through itself at {position}: the edge from particle {a} to {b} goes through the "
            f"triangle of particles {', '.join(map(str, triangle))}; {_REMEDY}"
        )
    gaps = np.empty(2)
    check(library().cloth_self_gaps(engine_plan.pointer, float64_address("x", x, x.shape), address(gaps)))
    min_gap = float(gaps[1])
    if min_gap < MIN_START_GAP * thickness:
        raise ValueError(
            f"the cloth is {min_gap:.3g} m from itself {_describe_nearest(engine_plan, surface, x)}; at the start it "
            f"must be {MIN_START_GAP * thickness:.3g} m at least, {MIN_START_GAP:g} of contact.thickness: move its "
            f"layers {thickness - min_gap:.3g} m apart, {_REMEDY}"
        )


def _describe_nearest(engine_plan: PlanHandle, surface: ContactSurface, x: Array) -> str:
    """Describe the position of the least gap of the cloth to itself, for an error text."""
    stiff, damped = np.zeros((6, x.shape[1])), np.zeros((6, x.shape[1]))
    addresses = float64_address("x", x, x.shape), address(stiff), address(damped)
    check(library().cloth_self_bounds(engine_plan.pointer, 0.0, *addresses))
    # Contact is stiffest at the least gap. Its stiffness is NaN without a gap.
    order = np.argsort(-np.nan_to_num(stiff[0] + stiff[1] + stiff[2], nan=np.inf), kind="stable")
    triangles, points = surface.triangles, np.ascontiguousarray(x.T)
    best = (math.inf, int(order[0]), 0)
    for particle in order[:_MAX_CANDIDATES].tolist():
        with np.errstate(invalid="ignore"):  # of a triangle without area
            offset = points[particle] - nearest_points(points[particle][None], points[triangles])[0]
        square = np.nan_to_num(row_sum((offset * offset).T), nan=np.inf)
        square[(triangles == particle).any(axis=1)] = np.inf
        nearest = int(np.argmin(square))
        best = min(best, (float(square[nearest]), particle, nearest))
    _, particle, nearest = best
    corners = ", ".join(map(str, triangles[nearest].tolist()))
    return f"near particle {particle} at {_rounded(points[particle])} and the triangle of particles {corners}"


def _rounded(position: Array) -> list[float]:
    return [round(coordinate, 6) for coordinate in position.tolist()]
