# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sheets that meet points and edges of obstacles between their particles, and the contact energy in numpy."""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from cloth_sim_ros.physics.contact.obstacle_features import obstacle_features
from cloth_sim_ros.physics.contact.obstacles import Obstacle
from cloth_sim_ros.physics.model.forces.contact import Contact, ContactSurface
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.model.sheets.grid import GridSheet
from cloth_sim_ros.physics.plan.plan import compile
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


def world_features(obstacle, path, t=TIME, thickness=THICKNESS):
    """Return the points of an obstacle at a time, shape (points, 3), its edges and its radius."""
    feature_set = obstacle_features(obstacle, thickness)
    position, _, rotation, _ = laws.pose(path, t)
    return feature_set.points @ rotation.T + position, feature_set.edges, feature_set.radius


def triangles_of_edges(triangles):
    """Return the triangles of each edge."""
    edge_triangles = {}
    for triangle_index, t in enumerate(triangles):
        for k in range(3):
            edge_triangles.setdefault(tuple(sorted((int(t[k]), int(t[(k + 1) % 3])))), []).append(triangle_index)
    return edge_triangles


def near_pairs(obstacle, path, triangles, x, thickness):
    """Return points with triangles and edges with edges that may be nearer than the thickness, and the radius."""
    points, edges, radius = world_features(obstacle, path, thickness=thickness)
    edge_list = list(triangles_of_edges(triangles))
    reach = radius + 2.0 * thickness + np.linalg.norm(x[triangles] - x[np.roll(triangles, 1, axis=1)], axis=2).max()
    distances = np.linalg.norm(points[:, None] - x[triangles[:, 0]], axis=2)
    faced = [(points[i], triangles[k]) for i, k in np.argwhere(distances < reach)]
    a, edge_vectors = points[edges[:, 0]], points[edges[:, 1]] - points[edges[:, 0]]
    middles = x[np.array(edge_list)].mean(axis=1)
    share = ((middles - a[:, None]) * edge_vectors[:, None]).sum(axis=2) / (edge_vectors * edge_vectors).sum(axis=1)[
        :, None
    ]
    distances = np.linalg.norm(
        middles - a[:, None] - np.clip(share, 0.0, 1.0)[..., None] * edge_vectors[:, None], axis=2
    )
    crossed = [(points[edges[i]], edge_list[k]) for i, k in np.argwhere(distances < reach)]
    return faced, crossed, radius


def min_gap(obstacle, path, triangles, x):
    """Return the least gap [m] of an obstacle's points and edges to triangles and edges at x (n, 3), if it is small."""
    faced, crossed, radius = near_pairs(obstacle, path, triangles, x, THICKNESS)
    gaps = [on_triangle(p, *x[t]) for p, t in faced] + [on_segments(*e, *x[list(s)]) for e, s in crossed]
    return min(gaps, default=np.inf) - radius


def energy(obstacle, path, triangles, x, masses, thickness=THICKNESS):
    """Energy [J] of an obstacle's points and edges with a surface at x (n, 3): every pair, one by one."""
    points, _, _ = world_features(obstacle, path, thickness=thickness)
    faced, crossed, radius = near_pairs(obstacle, path, triangles, x, thickness)
    sides, half = triangles_of_edges(triangles), 0.5 * thickness
    border = {i for edge, owners in sides.items() if len(owners) != 2 for i in edge}
    inner = {int(i) for i in triangles.ravel()} - border
    b = sum(barrier(on_triangle(p, *x[t]) - radius, half) for p, t in faced)
    for p in points:
        b -= sum(barrier(on_segment(p, *x[list(e)]) - radius, half) for e, owners in sides.items() if len(owners) == 2)
        b += sum(barrier(np.linalg.norm(p - x[i]) - radius, half) for i in inner)
    for (a, c), edge_pair in crossed:
        u, v = c - a, x[edge_pair[1]] - x[edge_pair[0]]
        q = min(np.linalg.norm(np.cross(u, v)) ** 2 / ((u @ u) * (v @ v)) / 1e-3, 1.0)
        b += (2.0 - q) * q * barrier(on_segments(a, c, *x[list(edge_pair)]) - radius, half)
    return masses.mean() * 0.5 * U**2 * b


def facing_sheet(seed):
    """Return triangles, positions at rest, positions (n, 3) and masses of a small rough sheet."""
    return self_scenes.sheets(0.0, rows=4, columns=4, seed=seed, rough=1e-3)


@cache
def facing_positions(obstacle, seed, gap, path_bytes):
    """Return positions (n, 3) of `facing_scene`, which the search for the gap makes expensive."""
    path = np.frombuffer(path_bytes)
    rng = np.random.default_rng(seed)
    triangles, _, x, _ = facing_sheet(seed)
    position = laws.pose(path, TIME)[0]
    # Towards a random side of the obstacle.
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    across = np.linalg.qr(np.column_stack([direction, rng.normal(size=(3, 2))]))[0]
    across[:, 0] = direction
    flat = (x - x.mean(axis=0) + [0.004, -0.003, 0.0]) @ across[:, [1, 2, 0]].T + position
    # Inward, never by more than the gap.
    high = 0.12
    for _ in range(200):
        step = min(min_gap(obstacle, path, triangles, flat + high * direction) - gap * THICKNESS, THICKNESS)
        high -= step
        if abs(step) < 1e-9:
            break
    return flat + high * direction


def facing_scene(obstacle, seed=0, *, gap=0.25, damping=10.0, path=None, anchors=()):
    """Return a sheet near an obstacle: the least gap of its points and edges is a fraction of the thickness.

    Returns:
        The plan of this contact alone, triangles, positions (n, 3), masses and the obstacle's path.
    """
    path = moving(seed) if path is None else path
    triangles, rest_positions, _, masses = facing_sheet(seed)
    x = facing_positions(obstacle, seed, gap, path.tobytes()).copy()
    contact_force = Contact(
        [obstacle],
        thickness=THICKNESS,
        damping=damping,
        faces=ContactSurface(triangles, rest_positions, thickness=THICKNESS),
    )
    contact_force.set_paths(np.array([path]))
    return compile(Model(masses, [contact_force], anchors=anchors)), triangles, x, masses, path


#: Rotation of a box's corner, or a tetrahedron's vertex, at (1, 1, 1) upward.
CORNER_UP = Rotation.align_vectors([[0.0, 0.0, 1.0]], [[1.0, 1.0, 1.0]])[0].as_quat()
#: A corner of it is 0.1732 m from its middle.
BLOCK = Obstacle(name="block", shape="box", size=(0.2, 0.2, 0.2))
CORNER = 0.1 * 3.0**0.5


def coarse_scene(*obstacles, paths, n=5, size=0.5, faces=True, thickness=THICKNESS, damping=10.0, **values):
    """Return the model of a flat sheet of n x n particles, positions (n, 3), and its triangles."""
    sheet = GridSheet(height=size, width=size, rows=n, columns=n, layout="alternating")
    surface = ContactSurface(sheet.triangles(), sheet.positions(), thickness=thickness)
    contact_force = Contact(obstacles, thickness=thickness, damping=damping, faces=surface if faces else None)
    contact_force.set_paths(np.array(paths))
    model, places = flat_sheet(n, n, contact_force, size=size, **values)
    return model, places, sheet.triangles()


def intersected_triangles(obstacle, path, t, triangles, x):
    """Return triangles at x (n, 3) that an obstacle's edge intersects, or that lie inside its ball or capsule."""
    points, edges, radius = world_features(obstacle, path, t)
    hits = []
    for triangle_index, corners in enumerate(triangles):
        a, b, c = x[corners]
        if radius:
            rays = [points[list(e)] for e in edges] or [points[[0, 0]]]
            distances = [min(on_triangle(p + s * (q - p), a, b, c) for s in np.linspace(0.0, 1.0, 21)) for p, q in rays]
            hits += [triangle_index] if min(distances) <= radius else []
            continue
        p, q = points[edges[:, 0]], points[edges[:, 1]]
        n = np.cross(b - a, c - a)
        above, below = (p - a) @ n, (q - a) @ n
        segments = q - p
        sides = np.stack([_line_side(p, segments, u, v) for u, v in ((a, b), (b, c), (c, a))])
        if ((above * below < 0.0) & ((sides > 0.0).all(axis=0) | (sides < 0.0).all(axis=0))).any():
            hits.append(triangle_index)
    return hits


def _line_side(p, segments, u, v):
    """Return the signed side on which the edge from u to v passes lines from p along the segments."""
    return (np.cross(u - p, v - p) * segments).sum(axis=1)
