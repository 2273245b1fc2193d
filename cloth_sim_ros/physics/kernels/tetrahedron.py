# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The signed length h = 6V / M of a tetrahedron, its gradient and the gradient's derivative (S8 and S9).

Particles 0, 1 are the shared edge, 2, 3 the wings; 6V = (x1 - x0) . ((x2 - x0) x (x3 - x0)), positive where the wings
rise to the side that the normal points to. M^2 is the squared |a x b| of the edge and the line of the wings
(`crossed`, S8), or the sum of the squared |a x b| of the four faces (`altitude`, S9). Both are smooth, so with G =
grad(M^2) / 2

    grad h = grad(6V) / M - h G / M^2.

Work arrays are passed in, because allocating in the loop over tetrahedra costs more than the arithmetic.
"""

from __future__ import annotations

import numba
import numpy as np

JIT = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": {"contract", "nsz"}}

#: Corners (origin, end, end) of the four faces.
FACES = np.array([[0, 1, 2], [1, 0, 3], [0, 2, 3], [1, 3, 2]])
#: Below this sine of the angle between edge and wings S8 has no normal; its weights exceed the inverse.
CROSSED_SINE = 1e-6
#: Below this thinness, largest |a x b| to squared size, the four points count as collinear.
ALTITUDE_SINE = 1e-12


@numba.njit(**JIT)
def cross(a, b, out):  # type: ignore[no-untyped-def]
    """Set out to a x b."""
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@numba.njit(**JIT)
def add_cross(a, b, factor, out):  # type: ignore[no-untyped-def]
    """Add factor (a x b) to out."""
    out[0] += factor * (a[1] * b[2] - a[2] * b[1])
    out[1] += factor * (a[2] * b[0] - a[0] * b[2])
    out[2] += factor * (a[0] * b[1] - a[1] * b[0])


@numba.njit(**JIT)
def dot(a, b):  # type: ignore[no-untyped-def]
    """Return a . b of two 3-vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@numba.njit(**JIT)
def gather(x, hinges, e, out):  # type: ignore[no-untyped-def]
    """Copy the four particles of hinge e from x (3, n) to out (4, 3)."""
    for k in range(4):
        for i in range(3):
            out[k, i] = x[i, hinges[e, k]]


@numba.njit(**JIT)
def _lines(x, face, a, b):  # type: ignore[no-untyped-def]
    """Set a, b to the two sides of a face (0 to 3), or to the edge and the line of the wings (4)."""
    for i in range(3):
        if face == 4:
            a[i] = x[1, i] - x[0, i]
            b[i] = x[3, i] - x[2, i]
        else:
            origin = x[FACES[face, 0], i]
            a[i] = x[FACES[face, 1], i] - origin
            b[i] = x[FACES[face, 2], i] - origin


@numba.njit(**JIT)
def _scatter(t, s, face, out):  # type: ignore[no-untyped-def]
    """Add t to the far end of line a, s to that of line b, and the opposite to the near ends."""
    for i in range(3):
        if face == 4:
            out[1, i] += t[i]
            out[0, i] -= t[i]
            out[3, i] += s[i]
            out[2, i] -= s[i]
        else:
            out[FACES[face, 1], i] += t[i]
            out[FACES[face, 2], i] += s[i]
            out[FACES[face, 0], i] -= t[i] + s[i]


@numba.njit(**JIT)
def length_and_gradient(x, crossed, gradient, area_gradient, volume_gradient, w):  # type: ignore[no-untyped-def]
    """Return (defined, h, M^2); set gradient, area_gradient (G), volume_gradient (of 6V), each (4, 3); w (8, 3): work.

    Where h is not defined (collinear, for S8 parallel lines) all gradients are zero.
    """
    a, b, c, t, s = w[0], w[1], w[2], w[3], w[4]
    gradient[:] = 0.0
    area_gradient[:] = 0.0
    volume_gradient[:] = 0.0
    square = 0.0
    first = 4 if crossed else 0
    for face in range(first, 5 if crossed else 4):
        _lines(x, face, a, b)
        cross(a, b, c)
        square += dot(c, c)
        cross(b, c, t)
        cross(c, a, s)
        _scatter(t, s, face, area_gradient)
    if crossed:
        limit = CROSSED_SINE * CROSSED_SINE * dot(a, a) * dot(b, b)
    else:
        size = 0.0
        for k in range(1, 4):
            for i in range(3):
                size += (x[k, i] - x[0, i]) ** 2
        limit = (ALTITUDE_SINE * size) ** 2
    if not square > limit:
        area_gradient[:] = 0.0
        return False, 0.0, square
    for i in range(3):
        a[i] = x[1, i] - x[0, i]
        b[i] = x[2, i] - x[0, i]
        c[i] = x[3, i] - x[0, i]
    cross(b, c, volume_gradient[1])
    cross(c, a, volume_gradient[2])
    cross(a, b, volume_gradient[3])
    root = np.sqrt(square)
    h = dot(a, volume_gradient[1]) / root
    for i in range(3):
        volume_gradient[0, i] = -(volume_gradient[1, i] + volume_gradient[2, i] + volume_gradient[3, i])
    for k in range(4):
        for i in range(3):
            gradient[k, i] = volume_gradient[k, i] / root - h * area_gradient[k, i] / square
    return True, h, square


@numba.njit(**JIT)
def hessian_product(x, u, crossed, h, square, gradient, area_gradient, volume_gradient, out, work, w):  # type: ignore[no-untyped-def]
    """Set out (4, 3) to the derivative of grad h along u (4, 3); work (4, 3) and w (8, 3) are scratch."""
    a, b, c, t, s, da, db, dc = w[0], w[1], w[2], w[3], w[4], w[5], w[6], w[7]
    work[:] = 0.0
    first = 4 if crossed else 0
    for face in range(first, 5 if crossed else 4):
        _lines(x, face, a, b)
        _lines(u, face, da, db)
        cross(a, b, c)
        cross(da, b, dc)
        add_cross(a, db, 1.0, dc)
        cross(db, c, t)
        add_cross(b, dc, 1.0, t)
        cross(dc, a, s)
        add_cross(c, da, 1.0, s)
        _scatter(t, s, face, work)
    dh = 0.0
    dsquare = 0.0
    for k in range(4):
        dh += dot(gradient[k], u[k])
        dsquare += 2.0 * dot(area_gradient[k], u[k])
    for i in range(3):
        a[i] = x[1, i] - x[0, i]
        b[i] = x[2, i] - x[0, i]
        c[i] = x[3, i] - x[0, i]
        da[i] = u[1, i] - u[0, i]
        db[i] = u[2, i] - u[0, i]
        dc[i] = u[3, i] - u[0, i]
    cross(db, c, out[1])
    add_cross(b, dc, 1.0, out[1])
    cross(dc, a, out[2])
    add_cross(c, da, 1.0, out[2])
    cross(da, b, out[3])
    add_cross(a, db, 1.0, out[3])
    for i in range(3):
        out[0, i] = -(out[1, i] + out[2, i] + out[3, i])
    root = np.sqrt(square)
    for k in range(4):
        for i in range(3):
            out[k, i] = (
                out[k, i] / root
                - volume_gradient[k, i] * dsquare / (2.0 * square * root)
                - (dh - h * dsquare / square) * area_gradient[k, i] / square
                - h * work[k, i] / square
            )
