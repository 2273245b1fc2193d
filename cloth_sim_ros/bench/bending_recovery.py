# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Does a pair of triangles find its rest shape again? The experiment behind the map of docs/bending.md.

Many tetrahedra that do not touch each other: the two triangles' edges (S1), the bending spring (S7) and the second
spring (S8 or S9), from a start, with damping, until they rest. Recovered is what has the six lengths and the signed
length of the rest shape; its mirror image has not.
"""

from __future__ import annotations

import math
from typing import Literal

import attrs
import numba
import numpy as np

from cloth_sim_ros.physics.bending_calibration import spring_constants
from cloth_sim_ros.physics.hinge_shape import HingeShape
from cloth_sim_ros.physics.kernels.pairs import add_pair_forces, pair_energy
from cloth_sim_ros.physics.kernels.tetrahedron import JIT, dot, length_and_gradient, load
from cloth_sim_ros.physics.forces.force import Array

#: The five edges of the triangles, then the bending spring.
EDGES = np.array([[0, 1], [0, 2], [1, 2], [0, 3], [1, 3], [2, 3]])

#: Rest triangles: edge, heights and feet of the two wings [m].
RESTS: dict[str, tuple[float, float, float, float, float]] = {
    "equilateral": (1.0, math.sqrt(0.75), math.sqrt(0.75), 0.5, 0.5),
    "grid diagonal": (math.sqrt(2.0), math.sqrt(0.5), math.sqrt(0.5), math.sqrt(0.5), math.sqrt(0.5)),
    "grid edge": (1.0, 1.0, 1.0, 0.0, 1.0),
    "checkerboard edge": (1.0, 1.0, 1.0, 0.0, 0.0),
    "scalene": (1.0, 0.6, 1.1, 0.3, 0.8),
    "obtuse": (1.0, 0.5, 0.7, -0.1, 0.6),
}

Start = Literal["random", "inverted", "flat", "folded", "collinear"]
STARTS: tuple[Start, ...] = ("random", "inverted", "flat", "folded", "collinear")


@attrs.frozen(kw_only=True)
class Recovery:
    """What came of a batch of starts."""

    starts: int
    missed: int
    """Starts that came to rest elsewhere, or not at all."""
    longest: int
    """Steps that the slowest of them took."""
    latest_energy_rise: float
    """Largest rise of the total energy in a step within the last tenth of any motion, over the energy scale k7 L²."""


def starts(kind: Start, rest: Array, count: int, rng: np.random.Generator) -> Array:
    """Return start positions (count, 4, 3) [m], none of them planar, for a rest shape (4, 3)."""
    size = float(np.linalg.norm(rest - rest.mean(axis=0), axis=1).max())
    noise = rng.standard_normal((count, 4, 3))
    if kind == "random":
        return size * noise
    if kind == "inverted":  # the mirror image, nearly
        return rest * np.array([1.0, 1.0, -1.0]) + 0.1 * size * noise
    if kind == "flat":  # planar but for a thousandth
        x = rest + 0.3 * size * noise
        x[:, :, 2] = 1e-3 * size * noise[:, :, 2]
        return x
    if kind == "folded":  # shut by nine tenths or more, either way
        turn = math.pi * rng.choice([-1.0, 1.0], count) * (1.0 - rng.uniform(0.0, 0.1, count))
        edge, foot = np.linalg.norm(rest[1] - rest[0]), rest[2:, 1] - rest[0, 1]
        height = np.linalg.norm(rest[2:] - rest[0], axis=1) ** 2 - foot**2
        h0, h1 = np.sqrt(height)
        c, s = np.cos(0.5 * turn), np.sin(0.5 * turn)
        x = np.zeros((count, 4, 3))
        x[:, 1, 1] = edge
        x[:, 2] = np.stack((-h0 * c, np.full(count, foot[0]), h0 * s), axis=1)
        x[:, 3] = np.stack((h1 * c, np.full(count, foot[1]), h1 * s), axis=1)
        return x + 0.02 * size * noise
    x = 1e-3 * size * noise  # nearly collinear
    x[:, :, 0] = size * rng.standard_normal((count, 4))
    return x


def rest_shape(name: str, angle: float) -> Array:
    """Return the rest positions (4, 3) [m] of one of `RESTS`, folded by `angle` [rad], its edge along y."""
    edge, h0, h1, f0, f1 = RESTS[name]
    c, s = math.cos(0.5 * angle), math.sin(0.5 * angle)
    return np.array([(0.0, 0.0, 0.0), (0.0, edge, 0.0), (-h0 * c, f0, h0 * s), (h1 * c, f1, h1 * s)])


def recover(
    x: Array,
    rest: Array,
    *,
    model: Literal["crossed", "altitude"] = "altitude",
    ratio: float | None = None,
    edge_stiffness: float = 10.0,
    damping: float = 0.7,
    limit: int = 60_000,
) -> Recovery:
    """Let starts x (count, 4, 3) come to rest and count those that miss the shape `rest` (4, 3); x is changed in place.

    Args:
        x: start positions [m].
        rest: rest positions [m].
        model: `altitude` for S9, `crossed` for S8, each with S7.
        ratio: stiffness ratio ρ; None is the recommended one.
        edge_stiffness: stiffness of the triangles' edges, in units of S7's.
        damping: dimensionless k_d0 of every spring.
        limit: number of steps after which a motion counts as missed.
    """
    shape = HingeShape.of([[0, 1, 2, 3]], rest)
    second, opposite = (float(k[0]) for k in spring_constants(model, shape, [1.0], ratio=ratio))
    ratio_second = second / opposite
    lengths = np.linalg.norm(rest[EDGES[:, 1]] - rest[EDGES[:, 0]], axis=1)
    stiffness = np.array([edge_stiffness] * 5 + [1.0])  # unit masses; S7 has 1 N/m
    k_d = damping * np.sqrt(stiffness)
    h0 = float(shape.length(model)[0])
    # an explicit step of a quarter of the shortest period's stable one: particles hang on up to four stiff springs
    step = 0.25 / math.sqrt(edge_stiffness + ratio_second + 1.0)
    steps, final, rise = _run(
        x, lengths, stiffness, k_d, h0, ratio_second, damping * math.sqrt(ratio_second), model == "crossed", step, limit
    )
    found = np.linalg.norm(x[:, EDGES[:, 1]] - x[:, EDGES[:, 0]], axis=2)
    near = 1e-3 * float(lengths.max())
    right = (np.abs(found - lengths).max(axis=1) < near) & (np.abs(final - h0) < near)
    return Recovery(
        starts=len(x),
        missed=int(np.count_nonzero(~right)),
        longest=int(steps.max(initial=0)),
        latest_energy_rise=float(rise.max(initial=0.0) / lengths.max() ** 2),
    )


@numba.njit(**JIT)
def _run(x, lengths, stiffness, damping, h0, second, second_damping, crossed, step, limit):  # type: ignore[no-untyped-def]
    """Semi-implicit Euler, one tetrahedron at a time; returns steps taken, final h, latest energy rise."""
    count = x.shape[0]
    steps = np.zeros(count, np.int64)
    final = np.zeros(count)
    rise = np.zeros(count)
    p = np.empty((3, 4))
    v = np.empty((3, 4))
    f = np.empty((3, 4))
    energies = np.empty(limit)
    for n in range(count):
        v[:] = 0.0
        quiet = 0
        taken = limit
        for i in range(limit):
            for k in range(4):
                for j in range(3):
                    p[j, k] = x[n, k, j]
            f[:] = 0.0
            add_pair_forces(EDGES, lengths, stiffness, damping, p, v, f)
            defined, h, _, g, _, _ = length_and_gradient((load(p, 0), load(p, 1), load(p, 2), load(p, 3)), crossed)
            final[n] = h
            rate = 0.0
            for k in range(4):
                rate += dot(g[k], load(v, k))
            tension = -second * (h - h0) - second_damping * rate
            kinetic = 0.0
            force = 0.0
            for k in range(4):
                for j in range(3):
                    total = f[j, k] + tension * g[k][j]
                    kinetic += 0.5 * v[j, k] * (v[j, k] + step * total)
                    v[j, k] += step * total
                    x[n, k, j] += step * v[j, k]
                    force += total * total
            energies[i] = kinetic + pair_energy(EDGES, lengths, stiffness, p)
            if defined:
                energies[i] += 0.5 * second * (h - h0) ** 2
            quiet = quiet + 1 if force < 1e-14 and kinetic < 1e-14 else 0
            if quiet > 200:
                taken = i + 1
                break
        steps[n] = taken
        for i in range(taken - taken // 10, taken):
            rise[n] = max(rise[n], energies[i] - energies[i - 1])
    return steps, final, rise
