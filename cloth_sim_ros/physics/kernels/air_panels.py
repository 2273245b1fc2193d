# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Drag of the air on panels of three or four corners: forces, powers, blocks and derivatives.

All of it in the area vector N = A n, half the cross product of two lines of a panel's corners: two edges of a triangle,
the diagonals of a quadrilateral, whose N is that of either pair of panels that it is cut into, bent or not. With
u = v - w the force on one of k corners is ``-((c_n - c_t) (u.N) N / A + c_t A u) / k``.
"""

from __future__ import annotations

import numba
import numpy as np

_JIT = {"cache": True, "nogil": True, "error_model": "numpy"}
#: Panels of less area [m^2] have no normal, and feel nothing.
_LEAST = 1e-30


@numba.njit(**_JIT)
def _lines(x, panels, number):  # type: ignore[no-untyped-def]
    """Return the two lines that span a panel: x1 - x0 and x2 - x0, or x2 - x0 and x3 - x1."""
    i = panels[number, 0]
    if panels.shape[1] == 3:
        j, h, k = panels[number, 1], i, panels[number, 2]
    else:
        j, h, k = panels[number, 2], panels[number, 1], panels[number, 3]
    return (
        (x[0, j] - x[0, i], x[1, j] - x[1, i], x[2, j] - x[2, i]),
        (x[0, k] - x[0, h], x[1, k] - x[1, h], x[2, k] - x[2, h]),
    )


@numba.njit(**_JIT)
def _area_vector(x, panels, number):  # type: ignore[no-untyped-def]
    a, b = _lines(x, panels, number)
    return 0.5 * (a[1] * b[2] - a[2] * b[1]), 0.5 * (a[2] * b[0] - a[0] * b[2]), 0.5 * (a[0] * b[1] - a[1] * b[0])


@numba.njit(**_JIT)
def add_forces(panels, normal, tangential, wind, x, v, f):  # type: ignore[no-untyped-def]
    """Add the drag [N] on every corner to f (3, n)."""
    for number in range(panels.shape[0]):
        nx, ny, nz = _area_vector(x, panels, number)
        area = np.sqrt(nx * nx + ny * ny + nz * nz)
        if not area > _LEAST:
            continue
        across = (normal - tangential) / (panels.shape[1] * area)
        along = tangential * area / panels.shape[1]
        for corner in range(panels.shape[1]):
            p = panels[number, corner]
            ux = v[0, p] - wind[0]
            uy = v[1, p] - wind[1]
            uz = v[2, p] - wind[2]
            through = across * (ux * nx + uy * ny + uz * nz)
            f[0, p] -= through * nx + along * ux
            f[1, p] -= through * ny + along * uy
            f[2, p] -= through * nz + along * uz


@numba.njit(**_JIT)
def powers(panels, normal, tangential, wind, x, v):  # type: ignore[no-untyped-def]
    """Return what the drag takes out of the motion in still air, and what the wind puts into it [W]."""
    lost = 0.0
    given = 0.0
    for number in range(panels.shape[0]):
        nx, ny, nz = _area_vector(x, panels, number)
        area = np.sqrt(nx * nx + ny * ny + nz * nz)
        if not area > _LEAST:
            continue
        across = (normal - tangential) / (panels.shape[1] * area)
        along = tangential * area / panels.shape[1]
        blown = across * (wind[0] * nx + wind[1] * ny + wind[2] * nz)
        for corner in range(panels.shape[1]):
            p = panels[number, corner]
            through = v[0, p] * nx + v[1, p] * ny + v[2, p] * nz
            square = v[0, p] ** 2 + v[1, p] ** 2 + v[2, p] ** 2
            lost += across * through * through + along * square
            given += blown * through + along * (wind[0] * v[0, p] + wind[1] * v[1, p] + wind[2] * v[2, p])
    return lost, given


@numba.njit(**_JIT)
def add_blocks(panels, normal, tangential, x, blocks):  # type: ignore[no-untyped-def]
    """Add the damping matrix of every corner [N s/m] to blocks (6, n): xx, yy, zz, xy, xz, yz."""
    for number in range(panels.shape[0]):
        nx, ny, nz = _area_vector(x, panels, number)
        area = np.sqrt(nx * nx + ny * ny + nz * nz)
        if not area > _LEAST:
            continue
        across = (normal - tangential) / (panels.shape[1] * area)
        along = tangential * area / panels.shape[1]
        for corner in range(panels.shape[1]):
            p = panels[number, corner]
            blocks[0, p] += across * nx * nx + along
            blocks[1, p] += across * ny * ny + along
            blocks[2, p] += across * nz * nz + along
            blocks[3, p] += across * nx * ny
            blocks[4, p] += across * nx * nz
            blocks[5, p] += across * ny * nz


@numba.njit(**_JIT)
def add_turning(panels, normal, tangential, speed, x, blocks):  # type: ignore[no-untyped-def]
    """Add what bounds the derivative by the places of corners at rest in a wind of some speed, blocks (6, n) [N/m].

    With L the longest way between two corners |dN| <= L/2 sum |dx|, and so |dF| on one of k corners is at most
    (2 |c_n - c_t| + c_t) speed L / (2 k) sum |dx|.
    """
    strength = 0.5 * (2.0 * abs(normal - tangential) + tangential) * speed
    for number in range(panels.shape[0]):
        longest = 0.0
        for corner in range(panels.shape[1]):
            p = panels[number, corner]
            for other in range(corner):
                q = panels[number, other]
                square = (x[0, q] - x[0, p]) ** 2 + (x[1, q] - x[1, p]) ** 2 + (x[2, q] - x[2, p]) ** 2
                longest = max(longest, square)
        block = strength * np.sqrt(longest)
        for corner in range(panels.shape[1]):
            for axis in range(3):
                blocks[axis, panels[number, corner]] += block


@numba.njit(**_JIT)
def add_jacobian_product(panels, normal, tangential, wind, x, v, dx, dv, out):  # type: ignore[no-untyped-def]
    """Add the derivative of the forces along (dx, dv) [N] to out (3, n)."""
    for number in range(panels.shape[0]):
        nx, ny, nz = _area_vector(x, panels, number)
        area = np.sqrt(nx * nx + ny * ny + nz * nz)
        if not area > _LEAST:
            continue
        # dN = (da x b + a x db) / 2
        a, b = _lines(x, panels, number)
        p, q = _lines(dx, panels, number)
        mx = 0.5 * (p[1] * b[2] - p[2] * b[1] + a[1] * q[2] - a[2] * q[1])
        my = 0.5 * (p[2] * b[0] - p[0] * b[2] + a[2] * q[0] - a[0] * q[2])
        mz = 0.5 * (p[0] * b[1] - p[1] * b[0] + a[0] * q[1] - a[1] * q[0])
        grown = (nx * mx + ny * my + nz * mz) / area
        across = (normal - tangential) / (panels.shape[1] * area)
        along = tangential / panels.shape[1]
        for corner in range(panels.shape[1]):
            c = panels[number, corner]
            ux, uy, uz = v[0, c] - wind[0], v[1, c] - wind[1], v[2, c] - wind[2]
            through = ux * nx + uy * ny + uz * nz
            changed = dv[0, c] * nx + dv[1, c] * ny + dv[2, c] * nz + ux * mx + uy * my + uz * mz
            first = across * (changed - through * grown / area)
            second = across * through
            out[0, c] -= first * nx + second * mx + along * (grown * ux + area * dv[0, c])
            out[1, c] -= first * ny + second * my + along * (grown * uy + area * dv[1, c])
            out[2, c] -= first * nz + second * mz + along * (grown * uz + area * dv[2, c])
