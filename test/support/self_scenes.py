# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sheets that touch themselves, and an independent numpy version of the contact energy."""

from __future__ import annotations

import itertools
from fractions import Fraction

import numpy as np

from cloth_sim_ros.physics.model.forces.contact import Contact, ContactSurface
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.model.sheets.grid import GridSheet, grid_triangles
from support.contact_scenes import flat_sheet

U = 35.0


def sheets(*heights, rows=5, columns=5, spacing=0.02, seed=0, rough=0.0, shift=(0.0, 0.0)):
    """Return separate flat layers: triangles, positions at rest and at present (n, 3), and masses.

    The layers are at given heights [m]. Each is shifted against the one before and roughened by some noise [m].
    """
    rng = np.random.default_rng(seed)
    plane = np.stack(np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"), axis=-1).reshape(-1, 2) * spacing
    layer_triangles, rest_positions, positions = grid_triangles(rows, columns, "alternating"), [], []
    for k, height in enumerate(heights):
        rest_positions.append(np.column_stack([plane, np.full(len(plane), 10.0 * k)]))
        positions.append(np.column_stack([plane + k * np.array(shift), np.full(len(plane), height)]))
    x = np.concatenate(positions)
    x += rough * rng.normal(size=x.shape)
    triangles = np.concatenate([layer_triangles + k * len(plane) for k in range(len(heights))])
    return triangles, np.concatenate(rest_positions), x, rng.uniform(1.0, 2.0, len(x)) * 1e-3


def self_contact(triangles, rest_positions, thickness, *, damping=10.0, **options):
    """Return the self-contact force of a surface."""
    surface = ContactSurface(triangles, rest_positions, thickness=thickness)
    return Contact(thickness=thickness, damping=damping, surface=surface, **options)


def folded(n, *, size=0.3, thickness=4e-3, radius=0.024, speed=2.0, listed=False, obstacles=(), paths=None, **values):
    """Return the model of a square sheet of n x n particles, folded over half a cylinder; positions and velocities (n,
    3).

    Its upper half comes down at a speed [m/s].
    """
    sheet = GridSheet(height=size, width=size, rows=n, columns=n, layout="alternating")
    contact_force = self_contact(sheet.triangles(), sheet.positions(), thickness, obstacles=obstacles)
    if paths is not None:
        contact_force.set_paths(np.array(paths))
    model, places = flat_sheet(n, n, contact_force, size=size, listed=listed, **values)
    along, half = places[:, 0] + 0.5 * size, 0.5 * np.pi * radius
    first, last = 0.5 * size - half, 0.5 * size + half
    angle = np.clip((along - first) / radius, 0.0, np.pi)
    places[:, 0] = np.minimum(along, first) + radius * np.sin(angle) - np.maximum(along - last, 0.0)
    places[:, 2] = radius * (1.0 - np.cos(angle))
    v = np.zeros_like(places)
    v[angle == np.pi, 2] = -speed
    return model, places, v


def on_triangle(p, a, b, c):
    """Distance of a point from a triangle, region by region (Ericson, Real-Time Collision Detection, 5.1.5)."""
    ab, ac, ap = b - a, c - a, p - a
    d1, d2 = ab @ ap, ac @ ap
    d3, d4 = ab @ (p - b), ac @ (p - b)
    d5, d6 = ab @ (p - c), ac @ (p - c)
    if d1 <= 0 and d2 <= 0:
        q = a
    elif d3 >= 0 and d4 <= d3:
        q = b
    elif d6 >= 0 and d5 <= d6:
        q = c
    elif d1 * d4 - d3 * d2 <= 0 <= d1 and d3 <= 0:
        q = a + d1 / (d1 - d3) * ab
    elif d5 * d2 - d1 * d6 <= 0 <= d2 and d6 <= 0:
        q = a + d2 / (d2 - d6) * ac
    elif d3 * d6 - d5 * d4 <= 0 and d4 >= d3 and d5 >= d6:
        q = b + (d4 - d3) / ((d4 - d3) + (d5 - d6)) * (c - b)
    else:
        va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
        q = a + (vb * ab + vc * ac) / (va + vb + vc)
    return np.linalg.norm(p - q)


def on_segment(p, a, b):
    """Distance of a point from a segment."""
    t = np.clip((p - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
    return np.linalg.norm(p - a - t * (b - a))


def on_segments(a, b, c, e):
    """Distance of two segments: the least of their ends' and, where both nearest points lie within, of their lines'."""
    least = min(on_segment(a, c, e), on_segment(b, c, e), on_segment(c, a, b), on_segment(e, a, b))
    matrix = np.array([[(b - a) @ (b - a), -(b - a) @ (e - c)], [-(b - a) @ (e - c), (e - c) @ (e - c)]])
    if np.linalg.det(matrix) > 1e-14 * matrix[0, 0] * matrix[1, 1]:
        s, t = np.linalg.solve(matrix, [(b - a) @ (c - a), -(e - c) @ (c - a)])
        if 0.0 < s < 1.0 and 0.0 < t < 1.0:
            least = min(least, np.linalg.norm(a + s * (b - a) - c - t * (e - c)))
    return least


def barrier(gap, thickness):
    """b of a gap."""
    s = min(gap / thickness, 1.0)
    return (1.0 - s) ** 4 / s


def energy(triangles, x, masses, thickness):
    """Energy [J] of a surface's contact with itself at positions x (n, 3): every pair of it, one by one."""
    sides = {}
    for triangle_index, t in enumerate(triangles):
        for i in range(3):
            sides.setdefault(tuple(sorted((t[i], t[(i + 1) % 3]))), []).append(triangle_index)
    border = {i for edge, owners in sides.items() if len(owners) != 2 for i in edge}
    total = 0.0
    for i in range(len(x)):
        b = 0.0
        b += sum(barrier(on_triangle(x[i], *x[t]), thickness) for t in triangles if i not in t)
        b -= sum(
            barrier(on_segment(x[i], *x[list(edge)]), thickness)
            for edge, owners in sides.items()
            if len(owners) == 2 and i not in edge
        )
        inner = {int(j) for j in triangles.ravel()} - border - {i}
        b += sum(barrier(np.linalg.norm(x[i] - x[j]), thickness) for j in inner)
        total += 0.5 * masses[i] * 0.5 * U**2 * b
    for first, second in itertools.combinations(sides, 2):
        if set(first) & set(second):
            continue
        u, v = x[first[1]] - x[first[0]], x[second[1]] - x[second[0]]
        q = min((np.linalg.norm(np.cross(u, v)) ** 2 / ((u @ u) * (v @ v))) / 1e-3, 1.0)
        mass = np.mean(masses[list(first + second)])
        gap = on_segments(*x[list(first)], *x[list(second)])
        total += mass * 0.5 * U**2 * (2.0 - q) * q * barrier(gap, 0.5 * thickness)
    return total


def alone(triangles, rest_positions, masses, thickness, **options):
    """Return the model of a surface's self-contact alone."""
    return Model(
        masses, [self_contact(triangles, rest_positions, thickness, damping=options.pop("damping", 10.0))], **options
    )


def intersections(triangles, x):
    """Return pairs of an edge and a triangle without a common corner that intersect at x (n, 3).

    The arithmetic is exact, with fractions.
    """
    exact = [tuple(Fraction(float(c)) for c in row) for row in x]
    edges = {tuple(sorted((int(t[k]), int(t[(k + 1) % 3])))) for t in triangles for k in range(3)}
    low, high = x[triangles].min(axis=1), x[triangles].max(axis=1)
    pairs = []
    for a, b in sorted(edges):
        ends = x[[a, b]]
        candidates = np.flatnonzero((ends.min(axis=0) <= high).all(axis=1) & (ends.max(axis=0) >= low).all(axis=1))
        for k in candidates.tolist():
            corners = [int(c) for c in triangles[k]]
            if a in corners or b in corners:
                continue
            p, q, (c, e, f) = exact[a], exact[b], (exact[i] for i in corners)
            above, below = _volume(c, e, f, p), _volume(c, e, f, q)
            sides = [_volume(p, q, c, e), _volume(p, q, e, f), _volume(p, q, f, c)]
            if above * below < 0 and (min(sides) > 0 or max(sides) < 0):
                pairs.append((a, b, k))
    return pairs


def _volume(a, b, c, e):
    """Six times the volume of a tetrahedron."""
    u, v, w = ([q - p for p, q in zip(a, origin, strict=True)] for origin in (b, c, e))
    return u[0] * (v[1] * w[2] - v[2] * w[1]) - u[1] * (v[0] * w[2] - v[2] * w[0]) + u[2] * (v[0] * w[1] - v[1] * w[0])
