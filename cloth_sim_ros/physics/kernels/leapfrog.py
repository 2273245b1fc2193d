# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Array passes of the leapfrog integrator, on flat views of (3, n) arrays."""

from __future__ import annotations

import numba
import numpy as np

_JIT = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": {"contract", "nsz"}}


@numba.njit(**_JIT)
def drift_and_predict(x, v, a, before, half, predicted):  # type: ignore[no-untyped-def]
    """x += half v; predicted = v + half/2 (a + before)."""
    for c in range(x.shape[0]):
        for i in range(x.shape[1]):
            x[c, i] += half * v[c, i]
            predicted[c, i] = v[c, i] + 0.5 * half * (a[c, i] + before[c, i])


@numba.njit(**_JIT)
def kick_and_drift(x, v, a, half):  # type: ignore[no-untyped-def]
    """v += 2 half a; x += half v."""
    for c in range(x.shape[0]):
        for i in range(x.shape[1]):
            v[c, i] += 2.0 * half * a[c, i]
            x[c, i] += half * v[c, i]


@numba.njit(**_JIT)
def kick_whole(x, v, a, step):  # type: ignore[no-untyped-def]
    """v += step a; x += step v."""
    for c in range(x.shape[0]):
        for i in range(x.shape[1]):
            v[c, i] += step * a[c, i]
            x[c, i] += step * v[c, i]


@numba.njit(**_JIT)
def largest_distance(x, y):  # type: ignore[no-untyped-def]
    """Return the largest distance between particles of two arrays (3, n); infinite if any entry is not finite."""
    largest = 0.0
    for i in range(x.shape[1]):
        square = 0.0
        for c in range(x.shape[0]):
            d = x[c, i] - y[c, i]
            square += d * d
        if not square <= largest:  # catches a NaN too
            largest = square
            if not square < np.inf:
                return np.inf
    return np.sqrt(largest)


@numba.njit(cache=True, nogil=True)
def all_finite(x, v):  # type: ignore[no-untyped-def]
    """Return whether every entry of both arrays is finite."""
    wrong = 0
    for c in range(x.shape[0]):
        # Counted to the end: a loop that may stop early is not vectorised.
        for i in range(x.shape[1]):
            wrong += x[c, i] - x[c, i] != 0.0
        for i in range(x.shape[1]):
            wrong += v[c, i] - v[c, i] != 0.0
    return wrong == 0


@numba.njit(cache=True, nogil=True)
def any_further(v, duration, way):  # type: ignore[no-untyped-def]
    """Return whether some entry of v (3, n) [m/s] is so fast that it goes further than a way [m] in a duration [s]."""
    for i in range(v.shape[1] - 1, -1, -1):
        for c in range(v.shape[0]):
            if abs(v[c, i]) * duration > way:
                return True
    return False


@numba.njit(cache=True, nogil=True)
def add_weighted(out, weight, array):  # type: ignore[no-untyped-def]
    """out += weight array, rounding after the product, as numpy does."""
    for c in range(out.shape[0]):
        for i in range(out.shape[1]):
            out[c, i] += weight * array[c, i]
