# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bounds of the stiffness and damping of a regular sheet's springs, without index lists."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.kernels.grid_copy import add_out, copy_in
from cloth_sim_ros.physics.kernels.grid_row_bounds import (
    BLOCK_PARTS,
    WATCHED,
    row_bounds,
    row_rates,
    row_squares,
    row_stiffness,
)
from cloth_sim_ros.physics.kernels.grid_springs import (
    Array,
    GridSprings,
    aligned_zeros,
    check_array,
    constants,
    grid_tables,
)
from cloth_sim_ros.physics.kernels.prepared import Prepared

#: Particles whose blocks, a hundred bytes each, fit into a second cache.
_STRETCH = 8192


class GridBounds:
    """The blocks of a sheet's springs, equal to the sum of `PairSprings.add_stiffness` and `add_damping` to rounding.

    Args:
        springs: the sheet.
        inverse_masses: 1/m [1/kg], zero for anchored particles, shape (rows * columns,); `rates` needs them.

    Not safe for two threads at once: the object owns its row buffers.
    """

    def __init__(self, springs: GridSprings, inverse_masses: Array | None = None) -> None:
        self.springs = springs
        count = springs.rows * springs.columns
        tables = grid_tables(springs, np.zeros(count) if inverse_masses is None else inverse_masses, np.float64)
        self._expected, self._number = (3, count), -1
        self._pitch, self._table, self._table_rows = tables
        self._shape, self._values = constants(springs, {True: 1.0, False: 1.0}, np.float64)
        self._window = aligned_zeros(3 * 3 * self._pitch, np.float64)
        size = 3 * (2 if springs.damped else 1) * BLOCK_PARTS * self._pitch
        self._room = aligned_zeros(size + WATCHED, np.float64)
        self._ring = self._room[:size]

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

    def rates(self, x: Array) -> tuple[float, float]:
        """Return the largest of eig(B_i) / m_i of the stiffness [1/s^2] and of the damping [1/s] at positions x [m]
        (3, rows * columns): what `stability.block_rates` would say of the blocks, without any of them kept.

        Raises:
            ValueError: for another shape.
        """
        check_array("x", x, self._expected)
        arguments = (
            *(x, 1 if self.springs.damped else None, self.springs.columns, self._pitch, self._window),
            *(self._table, self._table_rows, self._room, self._shape, self._values),
        )
        if self._number < 0:
            self._number = _RATES.number((self.springs.damped, self._shape.kinds()), arguments)
        found: tuple[float, float] = _RATES.entries[self._number](*arguments)
        return found

    def blocks(self, x: Array, particles: NDArray[np.int64]) -> Array:
        """Return the blocks of some particles, ascending, at positions x [m]: of the stiffness and of the damping,
        shape (2, 6, particle_count).
        """
        columns = self.springs.columns
        rows = particles // columns
        first, end = int(rows[0]), int(rows[-1]) + 1
        near = (end - first) * columns <= _STRETCH
        found = np.empty((2, BLOCK_PARTS, particles.size))
        for begin, stop in [(first, end)] if near else [(row, row + 1) for row in np.unique(rows).tolist()]:
            both = np.zeros((2, BLOCK_PARTS, (stop - begin) * columns))
            self.add(x, *both, rows=(begin, stop))
            here = slice(*np.searchsorted(rows, (begin, stop)))
            found[:, :, here] = both[:, :, particles[here] - begin * columns]
        return found


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _largest_rates(positions, damped, columns, pitch, window, table, table_rows, room, shape, values):  # type: ignore[no-untyped-def]
    """Sweep over the rows as `_add_bounds` does; `damped` is None where nothing is damped."""
    x, rows = positions.ravel(), len(table_rows)
    count, stride, width = rows * columns, 3 * pitch, (len(room) - WATCHED) // 3
    room[:] = 0.0
    for row in range(-2, rows):
        ahead = row + 2
        place = ahead % 3 * stride
        if ahead < rows:
            for c in range(3):
                copy_in(x, c * count + ahead * columns, 0.0, columns, window, place + c * pitch)
        if row < 0:
            continue
        at, below = row % 3 * stride, (row + 1) % 3 * stride
        ring0, ring1, ring2 = row % 3 * width, (row + 1) % 3 * width, ahead % 3 * width
        entry = table_rows[row]
        if damped is not None:
            row_rates(window, at, below, place, pitch, table, entry, room, ring0, ring1, ring2, shape, values)
        else:
            row_squares(window, at, below, place, pitch, table, entry, room, ring0, ring1, ring2, shape, values)
    part = WATCHED // 4
    omega2, damping, total = 0.0, 0.0, 0.0
    for j in range(3 * width, 3 * width + part):
        omega2, total = max(omega2, room[j]), total + room[part + j]
        if damped is not None:
            damping, total = max(damping, room[2 * part + j]), total + room[3 * part + j]
    # A sum that is none: some rate was none.
    return (omega2, damping) if total == total else (np.nan, np.nan)


_RATES = Prepared(_largest_rates)


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
