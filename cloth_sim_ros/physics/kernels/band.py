# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Cholesky factorisation of symmetric band matrices of 3x3 blocks, and the assembly of pair blocks into them.

Block row I keeps its blocks J = I - w ... I in one contiguous row: ``rows[I, r, (J - I + w) * 3 + c]`` is entry
(3 I + r, 3 J + c), w the block half bandwidth; blocks left of the first column are zero. Every inner loop is a dot
product of contiguous numbers. No library of linear algebra is called: the order of all sums is fixed, whatever the
number of threads.
"""

from __future__ import annotations

import numba
import numpy as np

_JIT = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": {"contract", "nsz", "reassoc"}}
_TINY = 1e-120


@numba.njit(**_JIT)
def assemble(rows, places, pairs, blocks, chosen):  # type: ignore[no-untyped-def]
    """Add the pair blocks B (m, 6: xx, yy, zz, xy, xz, yz) that are chosen: B at both diagonals, -B at the coupling.

    ``places`` (n,) maps particles to block rows, -1 for those that do not move. ``chosen`` are indices of pairs.
    """
    w = rows.shape[2] // 3 - 1
    b = np.empty((3, 3))
    for e in chosen:
        i = places[pairs[e, 0]]
        j = places[pairs[e, 1]]
        b[0, 0] = blocks[e, 0]
        b[1, 1] = blocks[e, 1]
        b[2, 2] = blocks[e, 2]
        b[0, 1] = blocks[e, 3]
        b[1, 0] = blocks[e, 3]
        b[0, 2] = blocks[e, 4]
        b[2, 0] = blocks[e, 4]
        b[1, 2] = blocks[e, 5]
        b[2, 1] = blocks[e, 5]
        for p in (i, j):
            if p >= 0:
                for r in range(3):
                    for c in range(3):
                        rows[p, r, 3 * w + c] += b[r, c]
        if i >= 0 and j >= 0:
            upper = max(i, j)
            at = (min(i, j) - upper + w) * 3
            for r in range(3):
                for c in range(3):
                    rows[upper, r, at + c] -= b[r, c]


@numba.njit(**_JIT)
def assemble_diagonal(rows, places, masses, blocks):  # type: ignore[no-untyped-def]
    """Add particle blocks (6, n) and masses (n,) to the diagonal of ``rows``."""
    w = rows.shape[2] // 3 - 1
    for p in range(places.shape[0]):
        i = places[p]
        if i < 0:
            continue
        for r in range(3):
            rows[i, r, 3 * w + r] += masses[p] + blocks[r, p]
        rows[i, 0, 3 * w + 1] += blocks[3, p]
        rows[i, 1, 3 * w + 0] += blocks[3, p]
        rows[i, 0, 3 * w + 2] += blocks[4, p]
        rows[i, 2, 3 * w + 0] += blocks[4, p]
        rows[i, 1, 3 * w + 2] += blocks[5, p]
        rows[i, 2, 3 * w + 1] += blocks[5, p]


@numba.njit(**_JIT)
def factor(rows, inner):  # type: ignore[no-untyped-def]
    """Eliminate the first ``inner`` block rows of a positive definite band matrix; return whether it was one.

    They are replaced by their rows of the Cholesky factor, diagonals inverted; the rest by its columns of the factor
    and, among itself, by the Schur complement. With inner = all rows that is the whole factorisation.
    """
    count = rows.shape[0]
    width = rows.shape[2]
    w = width // 3 - 1
    for i in range(count):
        first = max(0, i - w)
        row0 = rows[i, 0]
        row1 = rows[i, 1]
        row2 = rows[i, 2]
        for j in range(first, i + 1):
            length = 3 * max(0, min(j, inner) - first)
            at_i = (first - i + w) * 3
            at_j = (first - j + w) * 3
            here = (j - i + w) * 3
            other0 = rows[j, 0]
            other1 = rows[j, 1]
            other2 = rows[j, 2]
            s00 = 0.0
            s01 = 0.0
            s02 = 0.0
            s10 = 0.0
            s11 = 0.0
            s12 = 0.0
            s20 = 0.0
            s21 = 0.0
            s22 = 0.0
            for k in range(length):
                p0 = row0[at_i + k]
                p1 = row1[at_i + k]
                p2 = row2[at_i + k]
                q0 = other0[at_j + k]
                q1 = other1[at_j + k]
                q2 = other2[at_j + k]
                s00 += p0 * q0
                s01 += p0 * q1
                s02 += p0 * q2
                s10 += p1 * q0
                s11 += p1 * q1
                s12 += p1 * q2
                s20 += p2 * q0
                s21 += p2 * q1
                s22 += p2 * q2
            a00 = row0[here] - s00
            a10 = row1[here] - s10
            a20 = row2[here] - s20
            a11 = row1[here + 1] - s11
            a21 = row2[here + 1] - s21
            a22 = row2[here + 2] - s22
            if j >= inner:
                row0[here] = a00
                row0[here + 1] -= s01
                row0[here + 2] -= s02
                row1[here] = a10
                row1[here + 1] = a11
                row1[here + 2] -= s12
                row2[here] = a20
                row2[here + 1] = a21
                row2[here + 2] = a22
            elif j < i:
                # X L_jj' = S, row by row; the diagonal of L_jj is stored inverted.
                a01 = row0[here + 1] - s01
                a02 = row0[here + 2] - s02
                a12 = row1[here + 2] - s12
                d0 = other0[3 * w]
                d1 = other1[3 * w + 1]
                d2 = other2[3 * w + 2]
                l10 = other1[3 * w]
                l20 = other2[3 * w]
                l21 = other2[3 * w + 1]
                x0 = a00 * d0
                x1 = (a01 - x0 * l10) * d1
                row0[here] = x0
                row0[here + 1] = x1
                row0[here + 2] = (a02 - x0 * l20 - x1 * l21) * d2
                x0 = a10 * d0
                x1 = (a11 - x0 * l10) * d1
                row1[here] = x0
                row1[here + 1] = x1
                row1[here + 2] = (a12 - x0 * l20 - x1 * l21) * d2
                x0 = a20 * d0
                x1 = (a21 - x0 * l10) * d1
                row2[here] = x0
                row2[here + 1] = x1
                row2[here + 2] = (a22 - x0 * l20 - x1 * l21) * d2
                # Where masses rule, entries decay along a row until they are denormal, which costs a hundred times as
                # much.
                for c in range(3):
                    if abs(row0[here + c]) < _TINY:
                        row0[here + c] = 0.0
                    if abs(row1[here + c]) < _TINY:
                        row1[here + c] = 0.0
                    if abs(row2[here + c]) < _TINY:
                        row2[here + c] = 0.0
            else:
                if not a00 > 0.0:
                    return False
                d0 = 1.0 / np.sqrt(a00)
                l10 = a10 * d0
                l20 = a20 * d0
                a11 -= l10 * l10
                if not a11 > 0.0:
                    return False
                d1 = 1.0 / np.sqrt(a11)
                l21 = (a21 - l20 * l10) * d1
                a22 -= l20 * l20 + l21 * l21
                if not a22 > 0.0:
                    return False
                row0[here] = d0
                row1[here] = l10
                row1[here + 1] = d1
                row2[here] = l20
                row2[here + 1] = l21
                row2[here + 2] = 1.0 / np.sqrt(a22)
    return True


@numba.njit(**_JIT)
def forward(rows, inner, y):  # type: ignore[no-untyped-def]
    """Eliminate the first ``inner`` unknowns from the right-hand side y (block rows, 3)."""
    w = rows.shape[2] // 3 - 1
    flat = y.ravel()
    for i in range(rows.shape[0]):
        first = max(0, i - w)
        at = (first - i + w) * 3
        length = 3 * max(0, min(i, inner) - first)
        start = 3 * first
        for r in range(3):
            row = rows[i, r]
            total = 0.0
            for k in range(length):
                total += row[at + k] * flat[start + k]
            if i < inner:
                for c in range(r):
                    total += row[3 * w + c] * flat[3 * i + c]
                flat[3 * i + r] = (flat[3 * i + r] - total) * row[3 * w + r]
            else:
                flat[3 * i + r] -= total


@numba.njit(**_JIT)
def backward(rows, inner, y):  # type: ignore[no-untyped-def]
    """Find the first ``inner`` unknowns of what `forward` left in y, the others being solved."""
    w = rows.shape[2] // 3 - 1
    flat = y.ravel()
    for i in range(rows.shape[0] - 1, -1, -1):
        first = max(0, i - w)
        at = (first - i + w) * 3
        length = 3 * max(0, min(i, inner) - first)
        start = 3 * first
        for r in range(2, -1, -1):
            row = rows[i, r]
            if i < inner:
                flat[3 * i + r] *= row[3 * w + r]
            value = flat[3 * i + r]
            if i < inner:
                for c in range(r):
                    flat[3 * i + c] -= row[3 * w + c] * value
            for k in range(length):
                flat[start + k] -= row[at + k] * value


@numba.njit(**_JIT)
def join(upper, lower, inner_upper, inner_lower, middle):  # type: ignore[no-untyped-def]
    """Set ``middle`` to the sum of two Schur complements of the same block rows, the lower one's in reverse order."""
    count = middle.shape[0]
    w = upper.shape[2] // 3 - 1
    wide = middle.shape[2] // 3 - 1
    for i in range(count):
        for j in range(i + 1):
            at = (j - i + wide) * 3
            here = (j - i + w) * 3
            # In reverse order the pair (i, j) is stored transposed, as (count - 1 - j, count - 1 - i).
            other = inner_lower + count - 1 - j
            for r in range(3):
                for c in range(3):
                    middle[i, r, at + c] = upper[inner_upper + i, r, here + c] + lower[other, c, here + r]
