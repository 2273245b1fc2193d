# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Kernels of springs given as a list of pairs (S1 and, at rest length zero, S4 of the model).

Force on the far end b of a spring from a to b, with s = x_b - x_a, L = |s|, d = s / L:
``F = -k_s (L / l0 - 1) d - k_d (Dv . d) d``. The stiffness stored is k = k_s / l0 [N/m], so that the law reads ``-k (L
- l0) d`` and keeps its
meaning at l0 = 0, where it is the linear ``-k s - k_d Dv`` (isotropic damping) and passes through s = 0 unharmed.
"""

from __future__ import annotations

import numba
import numpy as np

_JIT = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": {"contract", "nsz"}}
#: |1 - l0 / L| at a tenth of the rest length.
_MOST_ACROSS = 9.0


@numba.njit(**_JIT)
def add_pair_forces(pairs, rest, stiffness, damping, x, v, f):  # type: ignore[no-untyped-def]
    """Add forces of springs ``pairs`` (m, 2) with rest lengths, stiffnesses k and damping coefficients (m,) to f (3,
    n).
    """
    for e in range(pairs.shape[0]):
        a = pairs[e, 0]
        b = pairs[e, 1]
        sx = x[0, b] - x[0, a]
        sy = x[1, b] - x[1, a]
        sz = x[2, b] - x[2, a]
        ux = v[0, b] - v[0, a]
        uy = v[1, b] - v[1, a]
        uz = v[2, b] - v[2, a]
        l0 = rest[e]
        k = stiffness[e]
        c = damping[e]
        if l0 == 0.0:
            fx = -k * sx - c * ux
            fy = -k * sy - c * uy
            fz = -k * sz - c * uz
        else:
            length = np.sqrt(sx * sx + sy * sy + sz * sz)
            # At coincident ends a spring has no direction, and so no force (its energy has a cusp there).
            inverse = 1.0 / length if length > 0.0 else 0.0
            dx = sx * inverse
            dy = sy * inverse
            dz = sz * inverse
            g = -k * (length - l0) - c * (ux * dx + uy * dy + uz * dz)
            fx = g * dx
            fy = g * dy
            fz = g * dz
        f[0, b] += fx
        f[1, b] += fy
        f[2, b] += fz
        f[0, a] -= fx
        f[1, a] -= fy
        f[2, a] -= fz


@numba.njit(**_JIT)
def pair_energy(pairs, rest, stiffness, x):  # type: ignore[no-untyped-def]
    """Return the elastic energy sum of k (L - l0)^2 / 2 [J]."""
    total = 0.0
    for e in range(pairs.shape[0]):
        a = pairs[e, 0]
        b = pairs[e, 1]
        sx = x[0, b] - x[0, a]
        sy = x[1, b] - x[1, a]
        sz = x[2, b] - x[2, a]
        stretch = np.sqrt(sx * sx + sy * sy + sz * sz) - rest[e]
        total += 0.5 * stiffness[e] * stretch * stretch
    return total


@numba.njit(**_JIT)
def pair_dissipation(pairs, rest, damping, x, v):  # type: ignore[no-untyped-def]
    """Return the power lost to damping [W]: k_d (Dv . d)^2 a spring, k_d |Dv|^2 at rest length zero."""
    total = 0.0
    for e in range(pairs.shape[0]):
        a = pairs[e, 0]
        b = pairs[e, 1]
        ux = v[0, b] - v[0, a]
        uy = v[1, b] - v[1, a]
        uz = v[2, b] - v[2, a]
        if rest[e] == 0.0:
            total += damping[e] * (ux * ux + uy * uy + uz * uz)
            continue
        sx = x[0, b] - x[0, a]
        sy = x[1, b] - x[1, a]
        sz = x[2, b] - x[2, a]
        square = sx * sx + sy * sy + sz * sz
        if square > 0.0:
            rate = ux * sx + uy * sy + uz * sz
            total += damping[e] * rate * rate / square
    return total


@numba.njit(**_JIT)
def add_pair_stiffness(pairs, rest, stiffness, x, blocks):  # type: ignore[no-untyped-def]
    """Add twice each spring's stiffness matrix k dd' + |tension / L| (I - dd') to the blocks of both its ends.

    Compression's transverse part is negative and makes nothing unstable, but a spring that is pushed nearly to a point
    turns as fast as one that is stretched: it counts by its size, up to a tenth of the rest length.
    """
    for e in range(pairs.shape[0]):
        a = pairs[e, 0]
        b = pairs[e, 1]
        l0 = rest[e]
        k = 2.0 * stiffness[e]
        sx = x[0, b] - x[0, a]
        sy = x[1, b] - x[1, a]
        sz = x[2, b] - x[2, a]
        length = np.sqrt(sx * sx + sy * sy + sz * sz)
        if l0 == 0.0:
            across = k
            along = 0.0
        elif length == 0.0:
            across = _MOST_ACROSS * k
            along = 0.0
        else:
            across = k * min(abs(1.0 - l0 / length), _MOST_ACROSS)
            along = (k - across) / (length * length)
        for p in (a, b):
            blocks[0, p] += across + along * sx * sx
            blocks[1, p] += across + along * sy * sy
            blocks[2, p] += across + along * sz * sz
            blocks[3, p] += along * sx * sy
            blocks[4, p] += along * sx * sz
            blocks[5, p] += along * sy * sz


@numba.njit(**_JIT)
def _add_both(entries, a, b, place, across, along, squares):  # type: ignore[no-untyped-def]
    """Add across I + along (six products) to the numbers of two particles, from `place` on."""
    xx, yy, zz, xy, xz, yz = squares
    xx = across + along * xx
    yy = across + along * yy
    zz = across + along * zz
    xy = along * xy
    xz = along * xz
    yz = along * yz
    # Written out: six numbers that lie together are then added as vectors.
    p = 12 * a + place
    entries[p] += xx
    entries[p + 1] += yy
    entries[p + 2] += zz
    entries[p + 3] += xy
    entries[p + 4] += xz
    entries[p + 5] += yz
    p = 12 * b + place
    entries[p] += xx
    entries[p + 1] += yy
    entries[p + 2] += zz
    entries[p + 3] += xy
    entries[p + 4] += xz
    entries[p + 5] += yz


@numba.njit(**_JIT)
def add_pair_bounds(pairs, rest, stiffness, damping, x, entries, stiff, damped):  # type: ignore[no-untyped-def]
    """As `add_pair_stiffness` to ``stiff`` and `add_pair_damping` to ``damped``, in one pass.

    ``entries`` is room for 12 n numbers: a particle's twelve lie together there while they are summed, so that a spring
    goes to two places of memory and not to 24.
    """
    entries[:] = 0.0
    for e in range(pairs.shape[0]):
        a = pairs[e, 0]
        b = pairs[e, 1]
        l0 = rest[e]
        k = 2.0 * stiffness[e]
        c = 2.0 * damping[e]
        sx = x[0, b] - x[0, a]
        sy = x[1, b] - x[1, a]
        sz = x[2, b] - x[2, a]
        square = sx * sx + sy * sy + sz * sz
        if l0 == 0.0:
            k_across = k
            k_along = 0.0
            c_across = c
            c_along = 0.0
        elif square == 0.0:
            k_across = _MOST_ACROSS * k
            k_along = 0.0
            c_across = c
            c_along = 0.0
        else:
            k_across = k * min(abs(1.0 - l0 / np.sqrt(square)), _MOST_ACROSS)
            k_along = (k - k_across) / square
            c_across = 0.0
            c_along = c / square
        xx = sx * sx
        yy = sy * sy
        zz = sz * sz
        xy = sx * sy
        xz = sx * sz
        yz = sy * sz
        _add_both(entries, a, b, 0, k_across, k_along, (xx, yy, zz, xy, xz, yz))
        _add_both(entries, a, b, 6, c_across, c_along, (xx, yy, zz, xy, xz, yz))
    for i in range(stiff.shape[1]):
        for j in range(6):
            stiff[j, i] += entries[12 * i + j]
            damped[j, i] += entries[12 * i + 6 + j]


@numba.njit(**_JIT)
def add_pair_damping(pairs, rest, damping, x, blocks):  # type: ignore[no-untyped-def]
    """Add twice each spring's damping matrix k_d dd' (k_d I at rest length zero) to the blocks of both its ends."""
    for e in range(pairs.shape[0]):
        a = pairs[e, 0]
        b = pairs[e, 1]
        c = 2.0 * damping[e]
        sx = x[0, b] - x[0, a]
        sy = x[1, b] - x[1, a]
        sz = x[2, b] - x[2, a]
        square = sx * sx + sy * sy + sz * sz
        if rest[e] == 0.0 or square == 0.0:
            across = c
            along = 0.0
        else:
            across = 0.0
            along = c / square
        for p in (a, b):
            blocks[0, p] += across + along * sx * sx
            blocks[1, p] += across + along * sy * sy
            blocks[2, p] += across + along * sz * sz
            blocks[3, p] += along * sx * sy
            blocks[4, p] += along * sx * sz
            blocks[5, p] += along * sy * sz


@numba.njit(**_JIT)
def pair_blocks(pairs, rest, stiffness, damping, x, position, velocity, blocks):  # type: ignore[no-untyped-def]
    """Set blocks (m, 6) to position (k dd' + (tension / L) (I - dd')) + velocity k_d dd' a spring.

    Compression's negative transverse part is left out: that keeps the blocks positive semidefinite.
    """
    for e in range(pairs.shape[0]):
        a = pairs[e, 0]
        b = pairs[e, 1]
        l0 = rest[e]
        k = position * stiffness[e]
        c = velocity * damping[e]
        sx = x[0, b] - x[0, a]
        sy = x[1, b] - x[1, a]
        sz = x[2, b] - x[2, a]
        length = np.sqrt(sx * sx + sy * sy + sz * sz)
        if l0 == 0.0:
            across = k + c
            along = 0.0
        elif length == 0.0:
            across = k
            along = 0.0
        else:
            across = k * (1.0 - l0 / length) if length > l0 else 0.0
            along = (k + c - across) / (length * length)
        blocks[e, 0] = across + along * sx * sx
        blocks[e, 1] = across + along * sy * sy
        blocks[e, 2] = across + along * sz * sz
        blocks[e, 3] = along * sx * sy
        blocks[e, 4] = along * sx * sz
        blocks[e, 5] = along * sy * sz


@numba.njit(**_JIT)
def add_pair_jacobian_product(pairs, rest, stiffness, damping, x, v, dx, dv, out):  # type: ignore[no-untyped-def]
    """Add the exact derivative of the pair forces along (dx, dv) to out (3, n)."""
    s = np.empty(3)
    u = np.empty(3)
    p = np.empty(3)
    q = np.empty(3)
    for e in range(pairs.shape[0]):
        a = pairs[e, 0]
        b = pairs[e, 1]
        l0 = rest[e]
        k = stiffness[e]
        c = damping[e]
        square = 0.0
        sp = 0.0
        su = 0.0
        sq = 0.0
        up = 0.0
        for i in range(3):
            s[i] = x[i, b] - x[i, a]
            u[i] = v[i, b] - v[i, a]
            p[i] = dx[i, b] - dx[i, a]
            q[i] = dv[i, b] - dv[i, a]
            square += s[i] * s[i]
            sp += s[i] * p[i]
            su += s[i] * u[i]
            sq += s[i] * q[i]
            up += u[i] * p[i]
        if l0 == 0.0:
            for i in range(3):
                change = -k * p[i] - c * q[i]
                out[i, b] += change
                out[i, a] -= change
        elif square > 0.0:
            length = np.sqrt(square)
            # F = -(k (1 - l0/L) + c su / L^2) s; differentiate factor and vector.
            factor = k * (1.0 - l0 / length) + c * su / square
            slope = k * l0 * sp / (length * square) + c * ((up + sq) / square - 2.0 * su * sp / (square * square))
            for i in range(3):
                change = -factor * p[i] - slope * s[i]
                out[i, b] += change
                out[i, a] -= change
