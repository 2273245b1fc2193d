# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One evaluation of all spring forces of a regular sheet, without index lists."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from cloth_sim_ros.physics.kernels.grid_copy import add_out, copy_in
from cloth_sim_ros.physics.kernels.grid_rows import row_forces
from cloth_sim_ros.physics.kernels.grid_springs import (
    Array,
    GridSprings,
    aligned_zeros,
    check_array,
    constants,
    grid_tables,
)
from cloth_sim_ros.physics.kernels.prepared import Prepared


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
        count = springs.rows * springs.columns
        pitch, table, table_rows = grid_tables(springs, np.zeros(count), dtype)
        wanted = {True: 1.0, False: 1.0} if weak is None else {weak: 1.0}
        self._shape, values = constants(springs, wanted, dtype)
        self._damped, self._narrow = springs.damped, np.dtype(dtype) == np.float32
        self._expected, self._number = (3, count), -1
        window, ring = aligned_zeros(3 * 6 * pitch, dtype), aligned_zeros(3 * 3 * pitch, dtype)
        self._still = (
            1 if self._narrow else None,
            springs.columns,
            pitch,
            window,
            table,
            table_rows,
            ring,
            self._shape,
            values,
        )

    def add(self, x: Array, v: Array, f: Array) -> None:
        """f += spring forces [N] at positions x [m] and velocities v [m/s], all (3, rows * columns) float64,
        C-contiguous.

        Raises:
            ValueError: for another shape.
        """
        expected = self._expected
        check_array("x", x, expected)
        check_array("v", v, expected)
        check_array("f", f, expected)
        velocities = v if self._damped else None
        if self._number < 0:
            key = (self._narrow, self._damped, self._shape.kinds())
            self._number = _FORCES.number(key, (x, velocities, f, *self._still))
        _FORCES.entries[self._number](x, velocities, f, *self._still)


def grid_forces(x: Array, v: Array, springs: GridSprings, f: Array) -> None:
    """f += spring forces; see `GridForces.add`. For more than one call keep a `GridForces`."""
    GridForces(springs).add(x, v, f)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_forces(positions, velocities, forces, near, columns, pitch, window, table, table_rows, ring, shape, values):  # type: ignore[no-untyped-def]
    """Sweep over the rows through a window of three padded ones. `velocities` are None where nothing is damped, `near`
    where positions are not taken relative to the first particle's. Only differences count; near the origin they keep
    more digits in single precision.
    """
    x, f = positions.ravel(), forces.ravel()
    rows = len(table_rows)
    count = rows * columns
    stride = 6 * pitch
    ring[:] = 0.0
    for row in range(-2, rows):
        ahead = row + 2
        place = ahead % 3 * stride
        if ahead < rows:
            for c in range(3):
                origin = 0.0 if near is None else x[c * count]
                copy_in(x, c * count + ahead * columns, origin, columns, window, place + c * pitch)
            if velocities is not None:
                v = velocities.ravel()
                for c in range(3):
                    copy_in(v, c * count + ahead * columns, 0.0, columns, window, place + (3 + c) * pitch)
        if row < 0:
            continue
        at, below = row % 3 * stride, (row + 1) % 3 * stride
        ring0, ring1, ring2 = row % 3 * 3 * pitch, (row + 1) % 3 * 3 * pitch, ahead % 3 * 3 * pitch
        entry = table_rows[row]
        row_forces(window, at, below, place, pitch, table, entry, ring, ring0, ring1, ring2, shape, values)
        for c in range(3):
            add_out(ring, ring0 + c * pitch, columns, f, c * count + row * columns)


_FORCES = Prepared(_add_forces)
