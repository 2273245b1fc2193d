# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The force of the second bending spring (S8), between the shared edge and the line of the wings.

With a = x1 - x0 along the edge, b = x3 - x2 along the wings, r = x2 - x0, n = (b x a) / |b x a|: h = n . r, and the
feet of the common normal lie at x0 + s a and x2 + t b, s = (r x b) . (a x b) / |a x b|^2, t = (r x a) . (a x b) / |a
x b|^2, unclamped. Because the feet minimise the distance, moving them does not change h to first order, and grad h is
n times the weights -(1 - s), -s, (1 - t), t.
"""

from __future__ import annotations

import numba
import numpy as np

from cloth_sim_ros.physics.kernels.tetrahedron import CROSSED_SINE, JIT


@numba.njit(**JIT)
def add_crossed_forces(hinges, rest, stiffness, damping, x, v, f):  # type: ignore[no-untyped-def]
    """Add the forces of hinges (m, 4) with rest lengths, stiffnesses and damping coefficients (m,) to f (3, n)."""
    for e in range(hinges.shape[0]):
        p0 = hinges[e, 0]
        p1 = hinges[e, 1]
        p2 = hinges[e, 2]
        p3 = hinges[e, 3]
        ax = x[0, p1] - x[0, p0]
        ay = x[1, p1] - x[1, p0]
        az = x[2, p1] - x[2, p0]
        bx = x[0, p3] - x[0, p2]
        by = x[1, p3] - x[1, p2]
        bz = x[2, p3] - x[2, p2]
        rx = x[0, p2] - x[0, p0]
        ry = x[1, p2] - x[1, p0]
        rz = x[2, p2] - x[2, p0]
        cx = ay * bz - az * by
        cy = az * bx - ax * bz
        cz = ax * by - ay * bx
        square = cx * cx + cy * cy + cz * cz
        aa = ax * ax + ay * ay + az * az
        bb = bx * bx + by * by + bz * bz
        if not square > CROSSED_SINE * CROSSED_SINE * aa * bb:
            continue  # parallel lines have no common normal
        inverse = -1.0 / np.sqrt(square)
        nx = cx * inverse
        ny = cy * inverse
        nz = cz * inverse
        h = nx * rx + ny * ry + nz * rz
        s = ((ry * bz - rz * by) * cx + (rz * bx - rx * bz) * cy + (rx * by - ry * bx) * cz) / square
        t = ((ry * az - rz * ay) * cx + (rz * ax - rx * az) * cy + (rx * ay - ry * ax) * cz) / square
        w0 = s - 1.0
        w1 = -s
        w2 = 1.0 - t
        w3 = t
        rate = (
            nx * (w0 * v[0, p0] + w1 * v[0, p1] + w2 * v[0, p2] + w3 * v[0, p3])
            + ny * (w0 * v[1, p0] + w1 * v[1, p1] + w2 * v[1, p2] + w3 * v[1, p3])
            + nz * (w0 * v[2, p0] + w1 * v[2, p1] + w2 * v[2, p2] + w3 * v[2, p3])
        )
        tension = -stiffness[e] * (h - rest[e]) - damping[e] * rate
        fx = tension * nx
        fy = tension * ny
        fz = tension * nz
        f[0, p0] += w0 * fx
        f[1, p0] += w0 * fy
        f[2, p0] += w0 * fz
        f[0, p1] += w1 * fx
        f[1, p1] += w1 * fy
        f[2, p1] += w1 * fz
        f[0, p2] += w2 * fx
        f[1, p2] += w2 * fy
        f[2, p2] += w2 * fz
        f[0, p3] += w3 * fx
        f[1, p3] += w3 * fy
        f[2, p3] += w3 * fz
