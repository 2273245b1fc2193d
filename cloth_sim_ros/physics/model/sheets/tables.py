# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Checks of named tables of numbers, and rows of pairs of particles."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.model.forces.force import Array


def checked_table(name: str, value: Any, dtype: type, columns: int) -> Any:
    """Return a table as a new array (rows, columns) of finite numbers of a type; refuse other contents.

    Raises:
        ValueError: naming the table and the fault.
    """
    array = _real_array(name, value)
    if array.size == 0:
        array = array.reshape(0, columns)
    if array.ndim != 2 or array.shape[1] != columns:
        raise ValueError(f"table '{name}' has shape {array.shape}; it must have {columns} columns")
    wrong = np.flatnonzero(~np.isfinite(array).all(axis=1) | (array != array.astype(dtype)).any(axis=1))
    if wrong.size:
        raise ValueError(
            f"row {wrong[0]} of table '{name}' is {array[wrong[0]].tolist()}; it must be finite"
            + (" whole numbers" if dtype is np.int64 else "")
        )
    return array.astype(dtype)


def _real_array(name: str, value: Any) -> Array:
    try:
        if np.asarray(value).dtype.kind == "c":
            # Conversion would drop the imaginary parts.
            raise ValueError("they are complex; give real ones")
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"table '{name}' is no table of numbers: {error}") from error


def checked_column(name: str, value: Any, count: int) -> Array:
    """Return a table of one number a row as a new array (count,); a single number stands for all rows.

    Raises:
        ValueError: naming the table and the fault.
    """
    array = _real_array(name, value)
    if array.ndim and array.shape != (count,):
        raise ValueError(f"table '{name}' has {array.size} numbers; give one, or {count}")
    return np.array(np.broadcast_to(array, (count,)))


def pair_rows(pairs: NDArray[np.int64], queries: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the last row of `pairs` (m, 2) that holds each query (q, 2) in either order, or -1, shape (q,)."""
    if not len(pairs):
        return np.full(len(queries), -1)
    # Ranks instead of particle numbers, because a file may hold any number.
    numbers, rank = np.unique(np.concatenate((pairs, queries)), return_inverse=True)
    low, high = np.sort(rank.reshape(-1, 2), axis=1).T
    key = low * len(numbers) + high
    pair_keys, query_keys = key[: len(pairs)], key[len(pairs) :]
    order = np.argsort(pair_keys, kind="stable")
    last = order[np.maximum(np.searchsorted(pair_keys, query_keys, side="right", sorter=order) - 1, 0)]
    return np.where(pair_keys[last] == query_keys, last, -1)
