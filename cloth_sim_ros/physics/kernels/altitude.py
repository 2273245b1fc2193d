# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Kernels of springs on a tetrahedron's signed length: energy k (h - h0)^2 / 2, damping -k_d (grad h . v) grad h.

`crossed` chooses the length: True the edge-edge length of S8, False the blend of all seven candidates of S9 (see
`tetrahedron`). The force of S8 has a faster kernel in `crossed`; everything else of S8 is here.
"""

from __future__ import annotations

import numba
import numpy as np

from cloth_sim_ros.physics.kernels.tetrahedron import (
    FACES,
    JIT,
    cross,
    dot,
    gather,
    hessian_product,
    length_and_gradient,
)


@numba.njit(**JIT)
def add_tetrahedron_forces(hinges, rest, stiffness, damping, crossed, x, v, f):  # type: ignore[no-untyped-def]
    """Add the forces of hinges (m, 4) with rest lengths, stiffnesses and damping coefficients (m,) to f (3, n)."""
    w = np.empty((8, 3))
    p = np.empty((4, 3))
    g = np.empty((4, 3))
    ga = np.empty((4, 3))
    gv = np.empty((4, 3))
    for e in range(hinges.shape[0]):
        gather(x, hinges, e, p)
        defined, h, _ = length_and_gradient(p, crossed, g, ga, gv, w)
        if not defined:
            continue
        rate = 0.0
        for k in range(4):
            q = hinges[e, k]
            rate += g[k, 0] * v[0, q] + g[k, 1] * v[1, q] + g[k, 2] * v[2, q]
        tension = -stiffness[e] * (h - rest[e]) - damping[e] * rate
        for k in range(4):
            q = hinges[e, k]
            for i in range(3):
                f[i, q] += tension * g[k, i]


@numba.njit(**JIT)
def tetrahedron_lengths(hinges, crossed, x, lengths):  # type: ignore[no-untyped-def]
    """Set lengths (m,) to the signed lengths h [m]; NaN where it is not defined."""
    w = np.empty((8, 3))
    p = np.empty((4, 3))
    g = np.empty((4, 3))
    ga = np.empty((4, 3))
    gv = np.empty((4, 3))
    for e in range(hinges.shape[0]):
        gather(x, hinges, e, p)
        defined, h, _ = length_and_gradient(p, crossed, g, ga, gv, w)
        lengths[e] = h if defined else np.nan


@numba.njit(**JIT)
def tetrahedron_energy(hinges, rest, stiffness, crossed, x):  # type: ignore[no-untyped-def]
    """Return the sum of k (h - h0)^2 / 2 [J]; a hinge without a length has none."""
    w = np.empty((8, 3))
    p = np.empty((4, 3))
    g = np.empty((4, 3))
    ga = np.empty((4, 3))
    gv = np.empty((4, 3))
    total = 0.0
    for e in range(hinges.shape[0]):
        gather(x, hinges, e, p)
        defined, h, _ = length_and_gradient(p, crossed, g, ga, gv, w)
        if defined:
            total += 0.5 * stiffness[e] * (h - rest[e]) ** 2
    return total


@numba.njit(**JIT)
def tetrahedron_dissipation(hinges, damping, crossed, x, v):  # type: ignore[no-untyped-def]
    """Return the power lost to damping, the sum of k_d (grad h . v)^2 [W]."""
    w = np.empty((8, 3))
    p = np.empty((4, 3))
    g = np.empty((4, 3))
    ga = np.empty((4, 3))
    gv = np.empty((4, 3))
    total = 0.0
    for e in range(hinges.shape[0]):
        gather(x, hinges, e, p)
        length_and_gradient(p, crossed, g, ga, gv, w)
        rate = 0.0
        for k in range(4):
            q = hinges[e, k]
            rate += g[k, 0] * v[0, q] + g[k, 1] * v[1, q] + g[k, 2] * v[2, q]
        total += damping[e] * rate * rate
    return total


@numba.njit(**JIT)
def add_gradient_blocks(hinges, weight, crossed, x, blocks):  # type: ignore[no-untyped-def]
    """Add blocks that bound weight (grad h . u)^2, weight (m,): weight (sum of |g_j|) / |g_i| g_i g_i' for particle i.

    By Cauchy and Schwarz, (sum of a_i)^2 <= (sum of |g_j|) (sum of a_i^2 / |g_i|).
    """
    w = np.empty((8, 3))
    p = np.empty((4, 3))
    g = np.empty((4, 3))
    ga = np.empty((4, 3))
    gv = np.empty((4, 3))
    norms = np.empty(4)
    for e in range(hinges.shape[0]):
        gather(x, hinges, e, p)
        length_and_gradient(p, crossed, g, ga, gv, w)
        for k in range(4):
            norms[k] = np.sqrt(dot(g[k], g[k]))
        total = norms[0] + norms[1] + norms[2] + norms[3]
        for k in range(4):
            if norms[k] == 0.0:
                continue
            scale = weight[e] * total / norms[k]
            q = hinges[e, k]
            blocks[0, q] += scale * g[k, 0] * g[k, 0]
            blocks[1, q] += scale * g[k, 1] * g[k, 1]
            blocks[2, q] += scale * g[k, 2] * g[k, 2]
            blocks[3, q] += scale * g[k, 0] * g[k, 1]
            blocks[4, q] += scale * g[k, 0] * g[k, 2]
            blocks[5, q] += scale * g[k, 1] * g[k, 2]


@numba.njit(**JIT)
def add_curvature_blocks(hinges, rest, stiffness, crossed, x, blocks):  # type: ignore[no-untyped-def]
    """Add blocks that bound the part k (h - h0) h'' of the stiffness, h'' the second derivative of h along u.

    S8: with P = [-a, b] of smallest singular value sigma, r = (-n.da, n.db) and u_in the in-plane motion of the two
        feet,
    h'' = -2 r'(P'P)^-1 P'u_in - h r'(P'P)^-1 r, at most (2 sqrt(2) |w| / sigma + 2 |h| / sigma^2) |u|^2.

    S9: h'' = 6V''/M - 2 M'h'/M - h M''/M. |6V''| <= sum of |opposite edge| |u_i||u_j|; |M'h'| <= |G||g|/M |u|^2; and,
        c the
    area vectors of the faces, M M'' <= |c'|^2 + |c.c''| <= sum over faces of (squared sides + 2 |c|) |u|^2.
    """
    w = np.empty((8, 3))
    p = np.empty((4, 3))
    g = np.empty((4, 3))
    ga = np.empty((4, 3))
    gv = np.empty((4, 3))
    bound = np.empty(4)
    for e in range(hinges.shape[0]):
        gather(x, hinges, e, p)
        defined, h, square = length_and_gradient(p, crossed, g, ga, gv, w)
        if not defined:
            continue
        weights = 0.0
        turning = 0.0
        for k in range(4):
            weights += dot(g[k], g[k])
            turning += dot(ga[k], ga[k])
        if crossed:
            aa = 0.0
            bb = 0.0
            for i in range(3):
                aa += (p[1, i] - p[0, i]) ** 2
                bb += (p[3, i] - p[2, i]) ** 2
            # both eigenvalues of P'P from its trace and determinant, the smaller without cancellation
            half = 0.5 * (aa + bb)
            sigma2 = square / (half + np.sqrt(max(half * half - square, 0.0)))
            bound[:] = 2.0 * np.sqrt(2.0 * weights / sigma2) + 2.0 * abs(h) / sigma2
        else:
            root = np.sqrt(square)
            bound[:] = 2.0 * np.sqrt(turning * weights) / square
            for f in range(4):
                o = FACES[f, 0]
                q = FACES[f, 1]
                r = FACES[f, 2]
                one = 0.0
                two = 0.0
                three = 0.0
                for i in range(3):
                    w[0, i] = p[q, i] - p[o, i]
                    w[1, i] = p[r, i] - p[o, i]
                    one += w[0, i] ** 2
                    two += w[1, i] ** 2
                    three += (p[r, i] - p[q, i]) ** 2
                cross(w[0], w[1], w[2])
                turn = abs(h) * (one + two + three + 2.0 * np.sqrt(dot(w[2], w[2]))) / square
                around = (np.sqrt(one) + np.sqrt(two) + np.sqrt(three)) / root
                for k in range(4):
                    bound[k] += turn if k in (o, q, r) else around
        for k in range(4):
            q = hinges[e, k]
            add = bound[k] * stiffness[e] * abs(h - rest[e])
            blocks[0, q] += add
            blocks[1, q] += add
            blocks[2, q] += add


@numba.njit(**JIT)
def add_tetrahedron_jacobian_product(hinges, rest, stiffness, damping, crossed, x, v, dx, dv, out):  # type: ignore[no-untyped-def]
    """Add the exact derivative of the forces along (dx, dv) to out (3, n)."""
    w = np.empty((8, 3))
    p = np.empty((4, 3))
    g = np.empty((4, 3))
    ga = np.empty((4, 3))
    gv = np.empty((4, 3))
    u = np.empty((4, 3))
    hu = np.empty((4, 3))
    work = np.empty((4, 3))
    for e in range(hinges.shape[0]):
        gather(x, hinges, e, p)
        defined, h, square = length_and_gradient(p, crossed, g, ga, gv, w)
        if not defined:
            continue
        gather(dx, hinges, e, u)
        hessian_product(p, u, crossed, h, square, g, ga, gv, hu, work, w)
        along = 0.0
        rate = 0.0
        change = 0.0
        for k in range(4):
            along += dot(g[k], u[k])
            for i in range(3):
                q = hinges[e, k]
                rate += g[k, i] * v[i, q]
                change += hu[k, i] * v[i, q] + g[k, i] * dv[i, q]
        tension = -stiffness[e] * (h - rest[e]) - damping[e] * rate
        slope = -stiffness[e] * along - damping[e] * change
        for k in range(4):
            q = hinges[e, k]
            for i in range(3):
                out[i, q] += slope * g[k, i] + tension * hu[k, i]


@numba.njit(**JIT)
def gradient_squares(hinges, crossed, x, squares):  # type: ignore[no-untyped-def]
    """Set squares (m, 4) to |g_i|^2 of the gradient of h with respect to each of the four particles."""
    w = np.empty((8, 3))
    p = np.empty((4, 3))
    g = np.empty((4, 3))
    ga = np.empty((4, 3))
    gv = np.empty((4, 3))
    for e in range(hinges.shape[0]):
        gather(x, hinges, e, p)
        length_and_gradient(p, crossed, g, ga, gv, w)
        for k in range(4):
            squares[e, k] = dot(g[k], g[k])
