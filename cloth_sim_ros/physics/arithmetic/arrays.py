# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Reproducible reductions of particle arrays, calculated by the engine.

Decisions depend on their results. Therefore the engine adds in one fixed order, which gives the same bits everywhere.
"""

from __future__ import annotations

import ctypes
import struct
from collections.abc import Sequence

import numpy as np

from cloth_sim_ros.engine.binding import address, check, float64_address, library
from cloth_sim_ros.physics.model.forces.force import Array


def largest_distance(x: Array, y: Array) -> float:
    """Return the largest distance [m] of a particle between two arrays (3, n); infinite if an entry is not finite."""
    out, count = ctypes.c_double(), x.shape[-1]
    addresses = float64_address("x", x, (3, count)), float64_address("y", y, (3, count))
    check(library().cloth_distance(*addresses, count, ctypes.addressof(out)))
    return float(out.value)


def lengths(vectors: Array) -> Array:
    """Return the lengths of vectors, shape (3, n), as an array (n,)."""
    x, y, z = vectors
    return np.sqrt(x * x + y * y + z * z)


def combine(arrays: Sequence[Array], weights: Sequence[float]) -> Array:
    """Return the weighted sum of arrays of one shape, as a new array.

    Args:
        arrays: the summands, at least one, all of one shape.
        weights: one dimensionless factor for each array.

    Raises:
        ValueError: if there are no arrays, or more or fewer weights than arrays.
    """
    if not arrays or len(arrays) != len(weights):
        raise ValueError(
            f"{len(weights)} weights for {len(arrays)} arrays; give each array one weight, and at least one array"
        )
    out, count = np.empty_like(arrays[0]), len(arrays)
    addresses = struct.pack(f"{count}P", *[float64_address("array", array, out.shape) for array in arrays])
    factors = struct.pack(f"{count}d", *weights)
    check(library().cloth_combine(count, addresses, factors, out.size, address(out)))
    return out


def weighted_dot(masses: Array, a: Array, b: Array) -> float:
    """Return the mass-weighted scalar product: the sum over particles of m a . b, in the order of the particles.

    Args:
        masses: m [kg], shape (n,).
        a: vectors, shape (3, n).
        b: vectors, shape (3, n).
    """
    out, shape = ctypes.c_double(), (3, len(masses))
    addresses = (
        float64_address("masses", masses, (len(masses),)),
        float64_address("a", a, shape),
        float64_address("b", b, shape),
    )
    check(library().cloth_weighted_dot(*addresses, len(masses), ctypes.addressof(out)))
    return float(out.value)


def largest_component(vectors: Array) -> float:
    """Return the largest absolute component of vectors, shape (3, n); NaN if one is NaN."""
    return float(np.maximum.reduce(np.abs(vectors), axis=None))  # faster than the method `max`
