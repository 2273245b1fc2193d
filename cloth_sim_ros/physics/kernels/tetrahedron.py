# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The signed length h = 6V / M of a tetrahedron, its gradient and the gradient's derivative (S8 and S9).

Particles 0, 1 are the shared edge, 2, 3 the wings; 6V = (x1 - x0) . ((x2 - x0) x (x3 - x0)), positive where the wings
rise to the side that the normal points to. M^2 is the squared |a x b| of the edge and the line of the wings
(`crossed`, S8), or the sum of the squared |a x b| of the four faces (`altitude`, S9). Both are smooth, so with
G = grad(M^2) / 2

    grad h = grad(6V) / M - h G / M^2.

Vectors are tuples of three numbers: a compiler keeps them in registers, where small arrays would go through memory.
"""

from __future__ import annotations

import numba
import numpy as np

JIT = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": {"contract", "nsz"}}

#: Below this sine of the angle between edge and wings S8 has no normal; its weights exceed the inverse.
CROSSED_SINE = 1e-6
#: Below this thinness, largest |a x b| to squared size, the four points count as collinear.
ALTITUDE_SINE = 1e-12


@numba.njit(**JIT)
def cross(a, b):  # type: ignore[no-untyped-def]
    """Return a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@numba.njit(**JIT)
def dot(a, b):  # type: ignore[no-untyped-def]
    """Return a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@numba.njit(**JIT)
def add(a, b):  # type: ignore[no-untyped-def]
    """Return a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@numba.njit(**JIT)
def sub(a, b):  # type: ignore[no-untyped-def]
    """Return a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@numba.njit(**JIT)
def scale(s, a):  # type: ignore[no-untyped-def]
    """Return s a."""
    return s * a[0], s * a[1], s * a[2]


@numba.njit(**JIT)
def load(x, p):  # type: ignore[no-untyped-def]
    """Return column p of x (3, n)."""
    return x[0, p], x[1, p], x[2, p]


@numba.njit(**JIT)
def store(f, p, s, a):  # type: ignore[no-untyped-def]
    """Add s a to column p of f (3, n)."""
    f[0, p] += s * a[0]
    f[1, p] += s * a[1]
    f[2, p] += s * a[2]


@numba.njit(**JIT)
def minus_sum(a, b, c):  # type: ignore[no-untyped-def]
    """Return -(a + b + c)."""
    return -(a[0] + b[0] + c[0]), -(a[1] + b[1] + c[1]), -(a[2] + b[2] + c[2])


@numba.njit(**JIT)
def crossed_areas(x):  # type: ignore[no-untyped-def]
    """Return (M^2, limit below which h is not defined, the four columns of G) of S8."""
    a = sub(x[1], x[0])
    w = sub(x[3], x[2])
    n = cross(a, w)
    g1 = cross(w, n)
    g3 = cross(n, a)
    limit = CROSSED_SINE * CROSSED_SINE * dot(a, a) * dot(w, w)
    return dot(n, n), limit, (scale(-1.0, g1), g1, scale(-1.0, g3), g3)


@numba.njit(**JIT)
def altitude_areas(x):  # type: ignore[no-untyped-def]
    """Return (M^2, limit below which h is not defined, the four columns of G) of S9."""
    a = sub(x[1], x[0])
    b = sub(x[2], x[0])
    c = sub(x[3], x[0])
    d = sub(x[2], x[1])
    e = sub(x[3], x[1])
    n0 = cross(e, d)  # face opposite to particle 0, and so on
    n1 = cross(b, c)
    n2 = cross(c, a)
    n3 = cross(a, b)
    # |p x q|^2 / 2 has the gradients q x n and n x p
    g1 = sub(add(cross(b, n3), cross(n2, c)), add(cross(d, n0), cross(n0, e)))
    g2 = add(add(cross(n3, a), cross(c, n1)), cross(n0, e))
    g3 = add(add(cross(a, n2), cross(n1, b)), cross(d, n0))
    limit = (ALTITUDE_SINE * (dot(a, a) + dot(b, b) + dot(c, c))) ** 2
    return dot(n0, n0) + dot(n1, n1) + dot(n2, n2) + dot(n3, n3), limit, (minus_sum(g1, g2, g3), g1, g2, g3)


@numba.njit(**JIT)
def length_and_gradient(x, crossed):  # type: ignore[no-untyped-def]
    """Return (defined, h, M^2, gradient of h, G, gradient of 6V), gradients as four vectors, for four positions x.

    Where h is not defined (collinear, for S8 parallel lines) h and all gradients are zero.
    """
    if crossed:
        square, limit, area = crossed_areas(x)
    else:
        square, limit, area = altitude_areas(x)
    if not square > limit:
        z = (0.0, 0.0, 0.0)
        zero = (z, z, z, z)
        return False, 0.0, 0.0, zero, zero, zero
    a = sub(x[1], x[0])
    b = sub(x[2], x[0])
    c = sub(x[3], x[0])
    v1 = cross(b, c)
    v2 = cross(c, a)
    v3 = cross(a, b)
    volume = (minus_sum(v1, v2, v3), v1, v2, v3)
    inverse = 1.0 / np.sqrt(square)
    h = dot(a, v1) * inverse
    turn = -h / square
    gradient = (
        add(scale(inverse, volume[0]), scale(turn, area[0])),
        add(scale(inverse, volume[1]), scale(turn, area[1])),
        add(scale(inverse, volume[2]), scale(turn, area[2])),
        add(scale(inverse, volume[3]), scale(turn, area[3])),
    )
    return True, h, square, gradient, area, volume


@numba.njit(**JIT)
def crossed_areas_along(x, u):  # type: ignore[no-untyped-def]
    """Return the derivative of S8's G along u."""
    a = sub(x[1], x[0])
    w = sub(x[3], x[2])
    da = sub(u[1], u[0])
    dw = sub(u[3], u[2])
    n = cross(a, w)
    dn = add(cross(da, w), cross(a, dw))
    g1 = add(cross(dw, n), cross(w, dn))
    g3 = add(cross(dn, a), cross(n, da))
    return scale(-1.0, g1), g1, scale(-1.0, g3), g3


@numba.njit(**JIT)
def altitude_areas_along(x, u):  # type: ignore[no-untyped-def]
    """Return the derivative of S9's G along u: every product of `altitude_areas` by its two factors."""
    a = sub(x[1], x[0])
    b = sub(x[2], x[0])
    c = sub(x[3], x[0])
    d = sub(x[2], x[1])
    e = sub(x[3], x[1])
    da = sub(u[1], u[0])
    db = sub(u[2], u[0])
    dc = sub(u[3], u[0])
    dd = sub(u[2], u[1])
    de = sub(u[3], u[1])
    n0 = cross(e, d)
    n1 = cross(b, c)
    n2 = cross(c, a)
    n3 = cross(a, b)
    dn0 = add(cross(de, d), cross(e, dd))
    dn1 = add(cross(db, c), cross(b, dc))
    dn2 = add(cross(dc, a), cross(c, da))
    dn3 = add(cross(da, b), cross(a, db))
    d_n0 = add(cross(dd, n0), cross(d, dn0))
    n0_e = add(cross(dn0, e), cross(n0, de))
    g1 = add(add(cross(db, n3), cross(b, dn3)), add(cross(dn2, c), cross(n2, dc)))
    g1 = sub(g1, add(d_n0, n0_e))
    g2 = add(add(cross(dn3, a), cross(n3, da)), add(cross(dc, n1), cross(c, dn1)))
    g2 = add(g2, n0_e)
    g3 = add(add(cross(da, n2), cross(a, dn2)), add(cross(dn1, b), cross(n1, db)))
    g3 = add(g3, d_n0)
    return minus_sum(g1, g2, g3), g1, g2, g3


@numba.njit(**JIT)
def hessian_product(x, u, crossed, h, square, gradient, area, volume):  # type: ignore[no-untyped-def]
    """Return the derivative of grad h along the four vectors u, from what `length_and_gradient` gave at x."""
    turning = crossed_areas_along(x, u) if crossed else altitude_areas_along(x, u)
    a = sub(x[1], x[0])
    b = sub(x[2], x[0])
    c = sub(x[3], x[0])
    da = sub(u[1], u[0])
    db = sub(u[2], u[0])
    dc = sub(u[3], u[0])
    v1 = add(cross(db, c), cross(b, dc))
    v2 = add(cross(dc, a), cross(c, da))
    v3 = add(cross(da, b), cross(a, db))
    v0 = minus_sum(v1, v2, v3)
    dh = dot(gradient[0], u[0]) + dot(gradient[1], u[1]) + dot(gradient[2], u[2]) + dot(gradient[3], u[3])
    half = dot(area[0], u[0]) + dot(area[1], u[1]) + dot(area[2], u[2]) + dot(area[3], u[3])
    inverse = 1.0 / np.sqrt(square)
    along_volume = -half * inverse / square
    along_area = -(dh - 2.0 * h * half / square) / square
    turn = -h / square
    return (
        _sum4(inverse, v0, along_volume, volume[0], along_area, area[0], turn, turning[0]),
        _sum4(inverse, v1, along_volume, volume[1], along_area, area[1], turn, turning[1]),
        _sum4(inverse, v2, along_volume, volume[2], along_area, area[2], turn, turning[2]),
        _sum4(inverse, v3, along_volume, volume[3], along_area, area[3], turn, turning[3]),
    )


@numba.njit(**JIT)
def _sum4(p, a, q, b, r, c, s, d):  # type: ignore[no-untyped-def]
    """Return p a + q b + r c + s d."""
    return (
        p * a[0] + q * b[0] + r * c[0] + s * d[0],
        p * a[1] + q * b[1] + r * c[1] + s * d[1],
        p * a[2] + q * b[2] + r * c[2] + s * d[2],
    )
