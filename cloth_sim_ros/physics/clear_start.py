# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Initial penetration check: refuses starts inside obstacles or through the cloth."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from cloth_sim_ros.engine.binding import address, check, doubles, library
from cloth_sim_ros.physics.contact_thickness import MIN_GAP
from cloth_sim_ros.physics.forces.contact import OwnSurface
from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.obstacle_mesh import nearest_points
from cloth_sim_ros.physics.obstacles import Obstacle
from cloth_sim_ros.physics.owner import Owner
from cloth_sim_ros.physics.powers import in_rows

#: Least gap of a starting cloth to itself, as a fraction of the thickness.
NEAREST = MIN_GAP
#: Number of particles with the stiffest contact that are searched for the nearest one.
_LOOKED_AT = 16
_REMEDY = "start from another state, or set contact.self to false"


def check_outside(t: float, obstacles: Sequence[Obstacle], gaps: Iterable[float]) -> None:
    """Refuse a cloth that is inside an obstacle at time t [s].

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


def pierced(owner: Owner, x: Array) -> list[int] | None:
    """Return the first edge of the cloth that intersects one of its triangles; None if there is none.

    An edge that shares a corner with the triangle does not count.

    Args:
        owner: handle of the engine's plan, which has the surface.
        x: particle positions [m], shape (3, n).

    Returns:
        The edge's two particles, then the triangle's three.
    """
    out = np.empty(5, dtype=np.int64)
    check(library().cloth_self_intersection(owner.handle, doubles("x", x, x.shape), address(out)))
    found: list[int] = out.tolist()
    return None if found[0] < 0 else found


def check_clear(owner: Owner, surface: OwnSurface, thickness: float, x: Array) -> None:
    """Refuse a cloth that intersects itself, or is closer to itself than the least gap.

    Args:
        owner: handle of the engine's plan, which has the surface.
        surface: surface of the cloth.
        thickness: contact thickness [m].
        x: particle positions [m], shape (3, n).

    Raises:
        ValueError: naming the first intersecting edge and triangle, or the nearest particle and triangle, with the
            position.
    """
    through = pierced(owner, x)
    if through is not None:
        a, b, *triangle = through
        where = _rounded(0.5 * (x[:, a] + x[:, b]))
        raise ValueError(
            f"the cloth passes through itself at {where}: the edge from particle {a} to {b} goes through the triangle "
            f"of particles {', '.join(map(str, triangle))}; {_REMEDY}"
        )
    found = np.empty(2)
    check(library().cloth_self_gaps(owner.handle, doubles("x", x, x.shape), address(found)))
    least = float(found[1])
    if least < NEAREST * thickness:
        raise ValueError(
            f"the cloth is {least:.3g} m from itself {_nearest(owner, surface, x)}; at the start it must be "
            f"{NEAREST * thickness:.3g} m at least, {NEAREST:g} of contact.thickness: move its "
            f"layers {thickness - least:.3g} m apart, {_REMEDY}"
        )


def _nearest(owner: Owner, surface: OwnSurface, x: Array) -> str:
    """Describe the position of the least gap of the cloth to itself, as part of a sentence."""
    stiff, damped = np.zeros((6, x.shape[1])), np.zeros((6, x.shape[1]))
    addresses = doubles("x", x, x.shape), address(stiff), address(damped)
    check(library().cloth_self_bounds(owner.handle, 0.0, *addresses))
    # Contact is stiffest at the least gap. Its stiffness is NaN without a gap.
    order = np.argsort(-np.nan_to_num(stiff[0] + stiff[1] + stiff[2], nan=np.inf), kind="stable")
    triangles, points = surface.triangles, np.ascontiguousarray(x.T)
    best = (math.inf, int(order[0]), 0)
    for particle in order[:_LOOKED_AT].tolist():
        with np.errstate(invalid="ignore"):  # of a triangle without area
            away = points[particle] - nearest_points(points[particle][None], points[triangles])[0]
        square = np.nan_to_num(in_rows((away * away).T), nan=np.inf)
        square[(triangles == particle).any(axis=1)] = np.inf
        nearest = int(np.argmin(square))
        best = min(best, (float(square[nearest]), particle, nearest))
    _, particle, nearest = best
    corners = ", ".join(map(str, triangles[nearest].tolist()))
    return f"near particle {particle} at {_rounded(points[particle])} and the triangle of particles {corners}"


def _rounded(place: Array) -> list[float]:
    return [round(number, 6) for number in place.tolist()]
