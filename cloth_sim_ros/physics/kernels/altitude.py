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
    JIT,
    altitude_areas,
    cross,
    crossed_areas,
    dot,
    hessian_product,
    length_and_gradient,
    load,
    store,
    sub,
)


@numba.njit(**JIT)
def _four(x, hinges, e):  # type: ignore[no-untyped-def]
    """Return the columns of x (3, n) of the four particles of hinge e."""
    return load(x, hinges[e, 0]), load(x, hinges[e, 1]), load(x, hinges[e, 2]), load(x, hinges[e, 3])


@numba.njit(**JIT)
def _dot4(a, b):  # type: ignore[no-untyped-def]
    """Return the sum of four scalar products."""
    return dot(a[0], b[0]) + dot(a[1], b[1]) + dot(a[2], b[2]) + dot(a[3], b[3])


@numba.njit(**JIT)
def _length(x, crossed):  # type: ignore[no-untyped-def]
    """Return (defined, h)."""
    if crossed:
        square, limit, _ = crossed_areas(x)
    else:
        square, limit, _ = altitude_areas(x)
    if not square > limit:
        return False, 0.0
    volume = dot(sub(x[1], x[0]), cross(sub(x[2], x[0]), sub(x[3], x[0])))
    return True, volume / np.sqrt(square)


@numba.njit(**JIT)
def add_tetrahedron_forces(hinges, rest, stiffness, damping, crossed, x, v, f):  # type: ignore[no-untyped-def]
    """Add the forces of hinges (m, 4) with rest lengths, stiffnesses and damping coefficients (m,) to f (3, n)."""
    for e in range(hinges.shape[0]):
        defined, h, _, g, _, _ = length_and_gradient(_four(x, hinges, e), crossed)
        if not defined:
            continue
        rate = _dot4(g, _four(v, hinges, e))
        tension = -stiffness[e] * (h - rest[e]) - damping[e] * rate
        for k in range(4):
            store(f, hinges[e, k], tension, g[k])


@numba.njit(**JIT)
def tetrahedron_lengths(hinges, crossed, x, lengths):  # type: ignore[no-untyped-def]
    """Set lengths (m,) to the signed lengths h [m]; NaN where it is not defined."""
    for e in range(hinges.shape[0]):
        defined, h = _length(_four(x, hinges, e), crossed)
        lengths[e] = h if defined else np.nan


@numba.njit(**JIT)
def tetrahedron_energy(hinges, rest, stiffness, crossed, x):  # type: ignore[no-untyped-def]
    """Return the sum of k (h - h0)^2 / 2 [J]; a hinge without a length has none."""
    total = 0.0
    for e in range(hinges.shape[0]):
        defined, h = _length(_four(x, hinges, e), crossed)
        if defined:
            total += 0.5 * stiffness[e] * (h - rest[e]) ** 2
    return total


@numba.njit(**JIT)
def tetrahedron_dissipation(hinges, damping, crossed, x, v):  # type: ignore[no-untyped-def]
    """Return the power lost to damping, the sum of k_d (grad h . v)^2 [W]."""
    total = 0.0
    for e in range(hinges.shape[0]):
        _, _, _, g, _, _ = length_and_gradient(_four(x, hinges, e), crossed)
        rate = _dot4(g, _four(v, hinges, e))
        total += damping[e] * rate * rate
    return total


@numba.njit(**JIT)
def add_gradient_blocks(hinges, weight, crossed, x, blocks):  # type: ignore[no-untyped-def]
    """Add blocks that bound weight (grad h . u)^2, weight (m,): weight (sum of |g_j|) / |g_i| g_i g_i' for particle i.

    By Cauchy and Schwarz, (sum of a_i)^2 <= (sum of |g_j|) (sum of a_i^2 / |g_i|).
    """
    for e in range(hinges.shape[0]):
        _, _, _, g, _, _ = length_and_gradient(_four(x, hinges, e), crossed)
        norms = (
            np.sqrt(dot(g[0], g[0])),
            np.sqrt(dot(g[1], g[1])),
            np.sqrt(dot(g[2], g[2])),
            np.sqrt(dot(g[3], g[3])),
        )
        total = weight[e] * (norms[0] + norms[1] + norms[2] + norms[3])
        for k in range(4):
            if norms[k] == 0.0:
                continue
            q = hinges[e, k]
            gx, gy, gz = g[k]
            share = total / norms[k]
            blocks[0, q] += share * gx * gx
            blocks[1, q] += share * gy * gy
            blocks[2, q] += share * gz * gz
            blocks[3, q] += share * gx * gy
            blocks[4, q] += share * gx * gz
            blocks[5, q] += share * gy * gz


@numba.njit(**JIT)
def _sides(o, p, q):  # type: ignore[no-untyped-def]
    """Return the sum of the sides of a triangle, and the sum of their squares plus four areas."""
    a = sub(p, o)
    b = sub(q, o)
    c = sub(q, p)
    one, two, three = dot(a, a), dot(b, b), dot(c, c)
    n = cross(a, b)
    return np.sqrt(one) + np.sqrt(two) + np.sqrt(three), one + two + three + 2.0 * np.sqrt(dot(n, n))


@numba.njit(**JIT)
def add_curvature_blocks(hinges, rest, stiffness, crossed, x, blocks):  # type: ignore[no-untyped-def]
    """Add blocks that bound the part k (h - h0) h'' of the stiffness, h'' the second derivative of h along u.

    S8: with P = [-a, b] of smallest singular value sigma, r = (-n.da, n.db) and u_in the in-plane motion of the two
    feet, h'' = -2 r'(P'P)^-1 P'u_in - h r'(P'P)^-1 r, at most (2 sqrt(2) |w| / sigma + 2 |h| / sigma^2) |u|^2.

    S9: h'' = 6V''/M - 2 M'h'/M - h M''/M. |6V''| <= sum of |opposite edge| |u_i||u_j|; |M'h'| <= |G||g|/M |u|^2; and,
    n the area vectors of the faces, M M'' <= |n'|^2 + |n.n''| <= sum over faces of (squared sides + 2 |n|) |u|^2.
    """
    for e in range(hinges.shape[0]):
        p = _four(x, hinges, e)
        defined, h, square, g, area, _ = length_and_gradient(p, crossed)
        if not defined:
            continue
        weights = _dot4(g, g)
        if crossed:
            a = sub(p[1], p[0])
            w = sub(p[3], p[2])
            half = 0.5 * (dot(a, a) + dot(w, w))
            # the smaller eigenvalue of P'P from its trace and determinant, without cancellation
            sigma2 = square / (half + np.sqrt(max(half * half - square, 0.0)))
            every = 2.0 * np.sqrt(2.0 * weights / sigma2) + 2.0 * abs(h) / sigma2
            bounds = (every, every, every, every)
        else:
            every = 2.0 * np.sqrt(_dot4(area, area) * weights) / square
            s0, t0 = _sides(p[1], p[2], p[3])  # face opposite to particle 0, and so on
            s1, t1 = _sides(p[0], p[2], p[3])
            s2, t2 = _sides(p[0], p[1], p[3])
            s3, t3 = _sides(p[0], p[1], p[2])
            inverse = 1.0 / np.sqrt(square)
            turn = abs(h) / square
            bounds = (
                every + s0 * inverse + turn * (t1 + t2 + t3),
                every + s1 * inverse + turn * (t0 + t2 + t3),
                every + s2 * inverse + turn * (t0 + t1 + t3),
                every + s3 * inverse + turn * (t0 + t1 + t2),
            )
        strain = stiffness[e] * abs(h - rest[e])
        for k in range(4):
            q = hinges[e, k]
            bound = strain * bounds[k]
            blocks[0, q] += bound
            blocks[1, q] += bound
            blocks[2, q] += bound


@numba.njit(**JIT)
def add_tetrahedron_jacobian_product(hinges, rest, stiffness, damping, crossed, x, v, dx, dv, out):  # type: ignore[no-untyped-def]
    """Add the exact derivative of the forces along (dx, dv) to out (3, n)."""
    for e in range(hinges.shape[0]):
        p = _four(x, hinges, e)
        defined, h, square, g, area, volume = length_and_gradient(p, crossed)
        if not defined:
            continue
        u = _four(dx, hinges, e)
        w = _four(v, hinges, e)
        hu = hessian_product(p, u, crossed, h, square, g, area, volume)
        tension = -stiffness[e] * (h - rest[e]) - damping[e] * _dot4(g, w)
        change = _dot4(hu, w) + _dot4(g, _four(dv, hinges, e))
        slope = -stiffness[e] * _dot4(g, u) - damping[e] * change
        for k in range(4):
            store(out, hinges[e, k], slope, g[k])
            store(out, hinges[e, k], tension, hu[k])


@numba.njit(**JIT)
def gradient_squares(hinges, crossed, x, squares):  # type: ignore[no-untyped-def]
    """Set squares (m, 4) to |g_i|^2 of the gradient of h with respect to each of the four particles."""
    for e in range(hinges.shape[0]):
        _, _, _, g, _, _ = length_and_gradient(_four(x, hinges, e), crossed)
        for k in range(4):
            squares[e, k] = dot(g[k], g[k])
