# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A band of a regular sheet between the (3, n) float64 arrays of the state and the padded rows of `grid_sweep`."""

from __future__ import annotations

import numba

from cloth_sim_ros.physics.kernels.grid_copy import add_out, change_out, copy_in
from cloth_sim_ros.physics.kernels.grid_rows import CARRY, LAST

REACH = 2
"""Rows that a step looks beyond the rows that it moves: the longest spring."""


@numba.njit(cache=True, nogil=True, error_model="numpy")
def load_band(band, x, v, origin, shape):  # type: ignore[no-untyped-def]
    """Copy the band's rows and its neighbours' outer ones; the predicted velocity starts as the velocity.

    All else is cleared: after a state that was not finite it would spoil the next one.
    """
    columns, pitch, halo = band.columns, band.pitch, REACH * band.levels
    count, stride, state = band.rows * columns, band.components * pitch, band.state
    begin, end = max(band.first - halo, 0), min(band.last + halo, band.rows)
    state[: (begin - band.first + halo) * stride] = 0.0
    state[(end - band.first + halo) * stride :] = 0.0
    for row in range(begin, end):
        place = (row - band.first + halo) * stride
        # Vectors that reach beyond a row's last column see the first numbers behind it, of whatever stands there.
        cleared = place if columns < pitch else place + LAST * pitch
        state[cleared : place + stride] = 0.0
        for c in range(3):
            start = c * count + row * columns
            copy_in(x, start, origin[c], columns, state, place + c * pitch)
            copy_in(v, start, 0.0, columns, state, place + (3 + c) * pitch)
            if shape.predicted is not None:
                copy_in(v, start, 0.0, columns, state, place + (6 + c) * pitch)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def unload_band(band, x0, v0, x, v, origin, half):  # type: ignore[no-untyped-def]
    """Set x, and v unless it is empty, to x0, v0 and what changed since `load_band` rounded these, so that single
    precision rounds the change alone.
    """
    columns, pitch, state = band.columns, band.pitch, band.state
    count, stride = band.rows * columns, band.components * pitch
    for row in range(band.first, band.last):
        place = (row - band.first + REACH * band.levels) * stride
        for c in range(3):
            start, position = c * count + row * columns, place + c * pitch
            speed = position + 3 * pitch
            change_out(x0, start, origin[c], columns, state, position, speed, half, x)
            if len(v):
                change_out(v0, start, 0.0, columns, state, speed, speed, 0.0, v)
            if band.components > CARRY:
                add_out(state, position + CARRY * pitch, columns, x, start)
