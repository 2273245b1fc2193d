# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sheets that meet points and edges of obstacles between their particles, and the contact energy in numpy."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from cloth_sim_ros.physics.forces.contact import Contact, OwnSurface
from cloth_sim_ros.physics.model import Model
from cloth_sim_ros.physics.obstacle_features import features
from cloth_sim_ros.physics.obstacles import Obstacle
from cloth_sim_ros.physics.plan import compile
from cloth_sim_ros.physics.sheets.grid import GridSheet
from support import laws, self_scenes
from support.contact_scenes import flat_sheet, moving
from support.self_scenes import U, barrier, on_segment, on_segments, on_triangle

THICKNESS = 4e-3
TIME = 0.3
#: A tetrahedron; seen from outside its triangles run counterclockwise.
TETRAHEDRON = (
    0.03 * np.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]]),
    np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]),
)
#: None is larger than the sheets.
SMALL = {
    "box": Obstacle(name="block", shape="box", size=(0.05, 0.03, 0.02)),
    "sphere": Obstacle(name="marble", shape="sphere", size=(0.006,)),
    "capsule": Obstacle(name="pin", shape="capsule", size=(0.004, 0.05)),
    "cylinder": Obstacle(name="coin", shape="cylinder", size=(0.008, 0.004)),
    "mesh": Obstacle(name="spike", shape="mesh", vertices=TETRAHEDRON[0], triangles=TETRAHEDRON[1]),
}


def world(obstacle, path, t=TIME, thickness=THICKNESS):
    """Return the points of an obstacle at a time, shape (points, 3), its edges and its radius."""
    found = features(obstacle, thickness)
    place, _, rotation, _ = laws.pose(path, t)
    return found.points @ rotation.T + place, found.edges, found.radius


def sides_of(triangles):
    """Return the triangles of each edge."""
    sides = {}
    for number, t in enumerate(triangles):
        for k in range(3):
            sides.setdefault(tuple(sorted((int(t[k]), int(t[(k + 1) % 3])))), []).append(number)
    return sides


def near_pairs(obstacle, path, triangles, x, thickness):
    """Return points with triangles and edges with edges that may be nearer than the thickness, and the radius."""
    points, edges, radius = world(obstacle, path, thickness=thickness)
    sides = list(sides_of(triangles))
    reach = radius + 2.0 * thickness + np.linalg.norm(x[triangles] - x[np.roll(triangles, 1, axis=1)], axis=2).max()
    away = np.linalg.norm(points[:, None] - x[triangles[:, 0]], axis=2)
    faced = [(points[i], triangles[k]) for i, k in np.argwhere(away < reach)]
    a, way = points[edges[:, 0]], points[edges[:, 1]] - points[edges[:, 0]]
    middles = x[np.array(sides)].mean(axis=1)
    share = ((middles - a[:, None]) * way[:, None]).sum(axis=2) / (way * way).sum(axis=1)[:, None]
    away = np.linalg.norm(middles - a[:, None] - np.clip(share, 0.0, 1.0)[..., None] * way[:, None], axis=2)
    crossed = [(points[edges[i]], sides[k]) for i, k in np.argwhere(away < reach)]
    return faced, crossed, radius


def least_gap(obstacle, path, triangles, x):
    """Return the least gap [m] of an obstacle's points and edges to triangles and edges at x (n, 3), if it is small."""
    faced, crossed, radius = near_pairs(obstacle, path, triangles, x, THICKNESS)
    gaps = [on_triangle(p, *x[t]) for p, t in faced] + [on_segments(*e, *x[list(s)]) for e, s in crossed]
    return min(gaps, default=np.inf) - radius


def energy(obstacle, path, triangles, x, masses, thickness=THICKNESS):
    """Energy [J] of an obstacle's points and edges with a surface at x (n, 3): every pair, one by one."""
    points, _, _ = world(obstacle, path, thickness=thickness)
    faced, crossed, radius = near_pairs(obstacle, path, triangles, x, thickness)
    sides, half = sides_of(triangles), 0.5 * thickness
    border = {i for edge, owners in sides.items() if len(owners) != 2 for i in edge}
    inner = {int(i) for i in triangles.ravel()} - border
    b = sum(barrier(on_triangle(p, *x[t]) - radius, half) for p, t in faced)
    for p in points:
        b -= sum(barrier(on_segment(p, *x[list(e)]) - radius, half) for e, owners in sides.items() if len(owners) == 2)
        b += sum(barrier(np.linalg.norm(p - x[i]) - radius, half) for i in inner)
    for (a, c), side in crossed:
        u, v = c - a, x[side[1]] - x[side[0]]
        q = min(np.linalg.norm(np.cross(u, v)) ** 2 / ((u @ u) * (v @ v)) / 1e-3, 1.0)
        b += (2.0 - q) * q * barrier(on_segments(a, c, *x[list(side)]) - radius, half)
    return masses.mean() * 0.5 * U**2 * b


def facing(obstacle, seed=0, *, gap=0.25, damping=10.0, path=None, anchors=()):
    """Return a sheet near an obstacle: the least gap of its points and edges is a fraction of the thickness.

    Returns:
        The plan of this contact alone, triangles, positions (n, 3), masses and the obstacle's path.
    """
    rng = np.random.default_rng(seed)
    triangles, rest, x, masses = self_scenes.sheets(0.0, rows=4, columns=4, seed=seed, rough=1e-3)
    path = moving(seed) if path is None else path
    place = laws.pose(path, TIME)[0]
    # Towards a random side of the obstacle.
    way = rng.normal(size=3)
    way /= np.linalg.norm(way)
    across = np.linalg.qr(np.column_stack([way, rng.normal(size=(3, 2))]))[0]
    across[:, 0] = way
    flat = (x - x.mean(axis=0) + [0.004, -0.003, 0.0]) @ across[:, [1, 2, 0]].T + place
    # Inward, never by more than the gap.
    high = 0.12
    for _ in range(200):
        step = min(least_gap(obstacle, path, triangles, flat + high * way) - gap * THICKNESS, THICKNESS)
        high -= step
        if abs(step) < 1e-9:
            break
    x = flat + high * way
    own = Contact(
        [obstacle], thickness=THICKNESS, damping=damping, faces=OwnSurface(triangles, rest, thickness=THICKNESS)
    )
    own.move(np.array([path]))
    return compile(Model(masses, [own], anchors=anchors)), triangles, x, masses, path


#: Rotation of a box's corner, or a tetrahedron's vertex, at (1, 1, 1) upward.
CORNER_UP = Rotation.align_vectors([[0.0, 0.0, 1.0]], [[1.0, 1.0, 1.0]])[0].as_quat()
#: A corner of it is 0.1732 m from its middle.
BLOCK = Obstacle(name="block", shape="box", size=(0.2, 0.2, 0.2))
CORNER = 0.1 * 3.0**0.5


def coarse(*obstacles, paths, n=5, size=0.5, faces=True, thickness=THICKNESS, damping=10.0, **values):
    """Return the model of a flat sheet of n x n particles, positions (n, 3), and its triangles."""
    sheet = GridSheet(height=size, width=size, rows=n, columns=n, layout="alternating")
    surface = OwnSurface(sheet.triangles(), sheet.positions(), thickness=thickness)
    own = Contact(obstacles, thickness=thickness, damping=damping, faces=surface if faces else None)
    own.move(np.array(paths))
    model, places = flat_sheet(n, n, own, size=size, **values)
    return model, places, sheet.triangles()


def come_through(obstacle, path, t, triangles, x):
    """Return triangles at x (n, 3) that an obstacle's edge intersects, or that lie inside its ball or capsule."""
    points, edges, radius = world(obstacle, path, t)
    found = []
    for number, corners in enumerate(triangles):
        a, b, c = x[corners]
        if radius:
            rays = [points[list(e)] for e in edges] or [points[[0, 0]]]
            near = [min(on_triangle(p + s * (q - p), a, b, c) for s in np.linspace(0.0, 1.0, 21)) for p, q in rays]
            found += [number] if min(near) <= radius else []
            continue
        p, q = points[edges[:, 0]], points[edges[:, 1]]
        n = np.cross(b - a, c - a)
        above, below = (p - a) @ n, (q - a) @ n
        way = q - p
        sides = np.stack([_side(p, way, u, v) for u, v in ((a, b), (b, c), (c, a))])
        if ((above * below < 0.0) & ((sides > 0.0).all(axis=0) | (sides < 0.0).all(axis=0))).any():
            found.append(number)
    return found


def _side(p, way, u, v):
    """Return the signed side on which the edge from u to v passes lines from p along the segments."""
    return (np.cross(u - p, v - p) * way).sum(axis=1)
