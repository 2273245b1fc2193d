# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One evaluation of all spring forces of a regular sheet, without index lists."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from cloth_sim_ros.physics.kernels.grid_rows import row_forces
from cloth_sim_ros.physics.kernels.grid_springs import (
    Array,
    GridSprings,
    aligned_zeros,
    grid_tables,
    parameters,
    spring_fields,
)


class GridForces:
    """Spring forces of a sheet: f += F(x, v), one call, no allocation.

    Args:
        springs: the sheet.
        weak: None for all families, True or False for only the weak or only the others.
        dtype: float64, or float32 for arithmetic in single precision on positions relative to the first particle.

    Not safe for two threads at once: the object owns its row buffers.
    """

    def __init__(self, springs: GridSprings, *, weak: bool | None = None, dtype: Any = np.float64) -> None:
        self.springs = springs
        tables = grid_tables(springs, np.zeros(springs.rows * springs.columns), dtype)
        self._pitch, self._table, self._table_rows = tables
        wanted = {True: 1.0, False: 1.0} if weak is None else {weak: 1.0}
        fields = spring_fields(springs, factors=wanted)
        self._damped = any(name.endswith("_d") for name in fields)
        self._params = parameters(fields, dtype)
        self._window = aligned_zeros(3 * 6 * self._pitch, dtype)
        self._ring = aligned_zeros(3 * 3 * self._pitch, dtype)

    def add(self, x: Array, v: Array, f: Array) -> None:
        """f += spring forces [N] at positions x [m] and velocities v [m/s], all (3, rows * columns) float64, C-contiguous.

        Raises:
            ValueError: for another shape.
        """
        expected = (3, self.springs.rows * self.springs.columns)
        for name, array in (("x", x), ("v", v), ("f", f)):
            if array.shape != expected:
                raise ValueError(f"{name} has shape {array.shape}; this sheet needs {expected}")
        velocity = v if self._damped else None
        # Only differences count; near the origin they keep more digits in single precision.
        origin = np.zeros(3) if self._table.dtype == np.float64 else x[:, 0].copy()
        window, ring = self._window, self._ring
        _add_forces(
            x,
            velocity,
            f,
            origin,
            self.springs.columns,
            self._pitch,
            window,
            self._table,
            self._table_rows,
            ring,
            self._params,
        )


def grid_forces(x: Array, v: Array, springs: GridSprings, f: Array) -> None:
    """f += spring forces; see `GridForces.add`. For more than one call keep a `GridForces`."""
    GridForces(springs).add(x, v, f)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _fill_positions(x, origin, first, columns, window, place, pitch):  # type: ignore[no-untyped-def]
    for c in range(3):
        for j in range(columns):
            window[place + c * pitch + j] = x[c, first + j] - origin[c]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _fill_velocities(v, first, columns, window, place, pitch):  # type: ignore[no-untyped-def]
    for c in range(3):
        for j in range(columns):
            window[place + c * pitch + j] = v[c, first + j]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_forces(x, v, f, origin, columns, pitch, window, table, table_rows, ring, params):  # type: ignore[no-untyped-def]
    rows = len(table_rows)
    stride = 6 * pitch
    ring[:] = 0.0
    for row in range(-2, rows):
        ahead = row + 2
        place = ahead % 3 * stride
        if ahead < rows:
            _fill_positions(x, origin, ahead * columns, columns, window, place, pitch)
            if v is not None:
                _fill_velocities(v, ahead * columns, columns, window, place + 3 * pitch, pitch)
        if row < 0:
            continue
        ring0, ring1, ring2 = row % 3 * 3 * pitch, (row + 1) % 3 * 3 * pitch, (row + 2) % 3 * 3 * pitch
        row_forces(
            window,
            row % 3 * stride,
            (row + 1) % 3 * stride,
            place,
            pitch,
            table,
            table_rows[row],
            ring,
            ring0,
            ring1,
            ring2,
            params,
        )
        for c in range(3):
            for j in range(columns):
                f[c, row * columns + j] += ring[ring0 + c * pitch + j]
