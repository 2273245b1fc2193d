# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Drag of the air on triangles: forces, powers, blocks and derivatives.

All of it in the area vector N = A n = (x1 - x0) x (x2 - x0) / 2: with u = v - w the force on a corner is
``-((c_n - c_t) (u.N) N / A + c_t A u) / 3``.
"""

from __future__ import annotations

import numba
import numpy as np

_JIT = {"cache": True, "nogil": True, "error_model": "numpy"}
#: Triangles of less area [m^2] have no normal, and feel nothing.
_LEAST = 1e-30


@numba.njit(**_JIT)
def _area_vector(x, i, j, k):  # type: ignore[no-untyped-def]
    ax = x[0, j] - x[0, i]
    ay = x[1, j] - x[1, i]
    az = x[2, j] - x[2, i]
    bx = x[0, k] - x[0, i]
    by = x[1, k] - x[1, i]
    bz = x[2, k] - x[2, i]
    return 0.5 * (ay * bz - az * by), 0.5 * (az * bx - ax * bz), 0.5 * (ax * by - ay * bx)


@numba.njit(**_JIT)
def add_forces(triangles, normal, tangential, wind, x, v, f):  # type: ignore[no-untyped-def]
    """Add the drag [N] on every corner to f (3, n)."""
    for number in range(triangles.shape[0]):
        nx, ny, nz = _area_vector(x, triangles[number, 0], triangles[number, 1], triangles[number, 2])
        area = np.sqrt(nx * nx + ny * ny + nz * nz)
        if not area > _LEAST:
            continue
        across = (normal - tangential) / (3.0 * area)
        along = tangential * area / 3.0
        for corner in range(3):
            p = triangles[number, corner]
            ux = v[0, p] - wind[0]
            uy = v[1, p] - wind[1]
            uz = v[2, p] - wind[2]
            through = across * (ux * nx + uy * ny + uz * nz)
            f[0, p] -= through * nx + along * ux
            f[1, p] -= through * ny + along * uy
            f[2, p] -= through * nz + along * uz


@numba.njit(**_JIT)
def powers(triangles, normal, tangential, wind, x, v):  # type: ignore[no-untyped-def]
    """Return what the drag takes out of the motion in still air, and what the wind puts into it [W]."""
    lost = 0.0
    given = 0.0
    for number in range(triangles.shape[0]):
        nx, ny, nz = _area_vector(x, triangles[number, 0], triangles[number, 1], triangles[number, 2])
        area = np.sqrt(nx * nx + ny * ny + nz * nz)
        if not area > _LEAST:
            continue
        across = (normal - tangential) / (3.0 * area)
        along = tangential * area / 3.0
        blown = across * (wind[0] * nx + wind[1] * ny + wind[2] * nz)
        for corner in range(3):
            p = triangles[number, corner]
            through = v[0, p] * nx + v[1, p] * ny + v[2, p] * nz
            square = v[0, p] ** 2 + v[1, p] ** 2 + v[2, p] ** 2
            lost += across * through * through + along * square
            given += blown * through + along * (wind[0] * v[0, p] + wind[1] * v[1, p] + wind[2] * v[2, p])
    return lost, given


@numba.njit(**_JIT)
def add_blocks(triangles, normal, tangential, x, blocks):  # type: ignore[no-untyped-def]
    """Add the damping matrix of every corner [N s/m] to blocks (6, n): xx, yy, zz, xy, xz, yz."""
    for number in range(triangles.shape[0]):
        nx, ny, nz = _area_vector(x, triangles[number, 0], triangles[number, 1], triangles[number, 2])
        area = np.sqrt(nx * nx + ny * ny + nz * nz)
        if not area > _LEAST:
            continue
        across = (normal - tangential) / (3.0 * area)
        along = tangential * area / 3.0
        for corner in range(3):
            p = triangles[number, corner]
            blocks[0, p] += across * nx * nx + along
            blocks[1, p] += across * ny * ny + along
            blocks[2, p] += across * nz * nz + along
            blocks[3, p] += across * nx * ny
            blocks[4, p] += across * nx * nz
            blocks[5, p] += across * ny * nz


@numba.njit(**_JIT)
def add_turning(triangles, normal, tangential, speed, x, blocks):  # type: ignore[no-untyped-def]
    """Add what bounds the derivative by the places of corners at rest in a wind of some speed, blocks (6, n) [N/m].

    With L the longest edge, |dN| <= L/2 sum |dx|, and so |dF| on a corner <= (2 |c_n - c_t| + c_t) speed L/6 sum |dx|.
    """
    strength = 0.5 * (2.0 * abs(normal - tangential) + tangential) * speed
    for number in range(triangles.shape[0]):
        longest = 0.0
        for corner in range(3):
            p = triangles[number, corner]
            q = triangles[number, (corner + 1) % 3]
            square = (x[0, q] - x[0, p]) ** 2 + (x[1, q] - x[1, p]) ** 2 + (x[2, q] - x[2, p]) ** 2
            longest = max(longest, square)
        block = strength * np.sqrt(longest)
        for corner in range(3):
            for axis in range(3):
                blocks[axis, triangles[number, corner]] += block


@numba.njit(**_JIT)
def add_jacobian_product(triangles, normal, tangential, wind, x, v, dx, dv, out):  # type: ignore[no-untyped-def]
    """Add the derivative of the forces along (dx, dv) [N] to out (3, n)."""
    for number in range(triangles.shape[0]):
        i = triangles[number, 0]
        j = triangles[number, 1]
        k = triangles[number, 2]
        nx, ny, nz = _area_vector(x, i, j, k)
        area = np.sqrt(nx * nx + ny * ny + nz * nz)
        if not area > _LEAST:
            continue
        # dN = (dx1 - dx0) x (x2 - x0) / 2 + (x1 - x0) x (dx2 - dx0) / 2
        ax, ay, az = x[0, j] - x[0, i], x[1, j] - x[1, i], x[2, j] - x[2, i]
        bx, by, bz = x[0, k] - x[0, i], x[1, k] - x[1, i], x[2, k] - x[2, i]
        px, py, pz = dx[0, j] - dx[0, i], dx[1, j] - dx[1, i], dx[2, j] - dx[2, i]
        qx, qy, qz = dx[0, k] - dx[0, i], dx[1, k] - dx[1, i], dx[2, k] - dx[2, i]
        mx = 0.5 * (py * bz - pz * by + ay * qz - az * qy)
        my = 0.5 * (pz * bx - px * bz + az * qx - ax * qz)
        mz = 0.5 * (px * by - py * bx + ax * qy - ay * qx)
        grown = (nx * mx + ny * my + nz * mz) / area
        across = (normal - tangential) / (3.0 * area)
        along = tangential / 3.0
        for corner in range(3):
            p = triangles[number, corner]
            ux, uy, uz = v[0, p] - wind[0], v[1, p] - wind[1], v[2, p] - wind[2]
            through = ux * nx + uy * ny + uz * nz
            changed = dv[0, p] * nx + dv[1, p] * ny + dv[2, p] * nz + ux * mx + uy * my + uz * mz
            first = across * (changed - through * grown / area)
            second = across * through
            out[0, p] -= first * nx + second * mx + along * (grown * ux + area * dv[0, p])
            out[1, p] -= first * ny + second * my + along * (grown * uy + area * dv[1, p])
            out[2, p] -= first * nz + second * mz + along * (grown * uz + area * dv[2, p])
