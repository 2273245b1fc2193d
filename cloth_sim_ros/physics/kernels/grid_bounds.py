# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bounds of the stiffness and damping of a regular sheet's springs, without index lists."""

from __future__ import annotations

import numba
import numpy as np

from cloth_sim_ros.physics.kernels.grid_copy import add_out, copy_in
from cloth_sim_ros.physics.kernels.grid_row_bounds import BLOCK_PARTS, row_bounds, row_stiffness
from cloth_sim_ros.physics.kernels.grid_springs import (
    Array,
    GridSprings,
    aligned_zeros,
    check_array,
    constants,
    grid_tables,
)


class GridBounds:
    """The blocks of a sheet's springs, equal to the sum of `PairSprings.add_stiffness` and `add_damping` to rounding.

    Args:
        springs: the sheet.

    Not safe for two threads at once: the object owns its row buffers.
    """

    def __init__(self, springs: GridSprings) -> None:
        self.springs = springs
        tables = grid_tables(springs, np.zeros(springs.rows * springs.columns), np.float64)
        self._pitch, self._table, self._table_rows = tables
        self._shape, self._values = constants(springs, {True: 1.0, False: 1.0}, np.float64)
        self._window = aligned_zeros(3 * 3 * self._pitch, np.float64)
        self._ring = aligned_zeros(3 * (2 if springs.damped else 1) * BLOCK_PARTS * self._pitch, np.float64)

    def add(self, x: Array, stiff: Array, damped: Array, *, rows: tuple[int, int] | None = None) -> None:
        """stiff += blocks of the stiffness [N/m], damped += blocks of the damping [N s/m], each (6, rows * columns):
        xx, yy, zz, xy, xz, yz, at positions x [m] (3, rows * columns). With `rows`, the first and the one behind the
        last, blocks are of these alone; they don't depend on the choice.

        Raises:
            ValueError: for another shape.
        """
        columns = self.springs.columns
        first, end = rows or (0, self.springs.rows)
        check_array("x", x, (3, self.springs.rows * columns))
        for name, array in (("stiff", stiff), ("damped", damped)):
            check_array(name, array, (BLOCK_PARTS, (end - first) * columns))
        _add_bounds(
            *(first, end),
            *(x.reshape(-1), stiff.reshape(-1), damped.reshape(-1) if self.springs.damped else None),
            *(self.springs.columns, self._pitch, self._window),
            *(self._table, self._table_rows, self._ring, self._shape, self._values),
        )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_bounds(first, end, x, stiff, damped, columns, pitch, window, table, table_rows, ring, shape, values):  # type: ignore[no-untyped-def]
    """Sweep over rows from `first` to before `end` through a window of three padded ones; `damped` is None where
    nothing is damped. Springs of the two rows above reach into the first ones.
    """
    rows = len(table_rows)
    count, stride, width = rows * columns, 3 * pitch, len(ring) // 3
    ring[:] = 0.0
    start, own = max(first - 2, 0), (end - first) * columns
    for row in range(start - 2, end):
        ahead = row + 2
        place = ahead % 3 * stride
        if ahead < rows:
            for c in range(3):
                copy_in(x, c * count + ahead * columns, 0.0, columns, window, place + c * pitch)
        if row < start:
            continue
        at, below = row % 3 * stride, (row + 1) % 3 * stride
        ring0, ring1, ring2 = row % 3 * width, (row + 1) % 3 * width, ahead % 3 * width
        entry = table_rows[row]
        if damped is not None:
            row_bounds(window, at, below, place, pitch, table, entry, ring, ring0, ring1, ring2, shape, values)
            if row >= first:
                for c in range(BLOCK_PARTS):
                    add_out(ring, ring0 + (BLOCK_PARTS + c) * pitch, columns, damped, c * own + (row - first) * columns)
        else:
            row_stiffness(window, at, below, place, pitch, table, entry, ring, ring0, ring1, ring2, shape, values)
        if row >= first:
            for c in range(BLOCK_PARTS):
                add_out(ring, ring0 + c * pitch, columns, stiff, c * own + (row - first) * columns)
