# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Array passes of the leapfrog integrator, on flat views of (3, n) arrays."""

from __future__ import annotations

import numba
import numpy as np

_JIT = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": {"contract", "nsz"}}


@numba.njit(**_JIT)
def drift_and_predict(x, v, a, half, predicted):  # type: ignore[no-untyped-def]
    """x += half v; predicted = v + half a."""
    for c in range(x.shape[0]):
        for i in range(x.shape[1]):
            x[c, i] += half * v[c, i]
            predicted[c, i] = v[c, i] + half * a[c, i]


@numba.njit(**_JIT)
def kick_and_drift(x, v, a, half):  # type: ignore[no-untyped-def]
    """v += 2 half a; x += half v."""
    for c in range(x.shape[0]):
        for i in range(x.shape[1]):
            v[c, i] += 2.0 * half * a[c, i]
            x[c, i] += half * v[c, i]


@numba.njit(cache=True, nogil=True)
def all_finite(x, v):  # type: ignore[no-untyped-def]
    """Return whether every entry of both arrays is finite."""
    for c in range(x.shape[0]):
        for i in range(x.shape[1]):
            if not (np.isfinite(x[c, i]) and np.isfinite(v[c, i])):
                return False
    return True
