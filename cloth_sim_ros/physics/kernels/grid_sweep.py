# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Leapfrog sweeps over a band of rows: the compiled loops of `grid_leapfrog`.

A band keeps its own padded copy of its rows, two rows of the band above before them and two of the band below after them. After each
step it posts its outer rows and reads those of its neighbours; the springs that cross a border are evaluated on both sides, with the
same operations in the same order, so that any number of bands gives the same bits.

None in place of `grips`, `fast` or `mail` leaves their code out of the compiled loop.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.kernels.grid_rows import row_above, row_start, row_step, row_two_above
from cloth_sim_ros.physics.kernels.grid_sync import store_release, wait_for

HALO = 2
"""Rows of a neighbour that a band needs on either side: the longest spring's reach."""

COUNTER_SPACING = 16
"""Counters of two bands lie this many int64 apart, on cache lines of their own."""


class Band(NamedTuple):
    """Rows `first` to `last` - 1 of a sheet and the buffers of the thread that moves them.

    `state`: flat; HALO + rows + HALO rows of `components` times `pitch` numbers. `ring`: flat, 3 rows of 3 times `pitch`. `table_rows`: where the table
    entries of the rows start, from HALO rows above on. `index`: which band this is.
    """

    first: int
    last: int
    columns: int
    pitch: int
    components: int
    state: NDArray[Any]
    ring: NDArray[Any]
    table: NDArray[Any]
    table_rows: NDArray[np.intp]
    index: int


class Mail(NamedTuple):
    """Where bands exchange their outer rows.

    `boxes`: [band, upwards or downwards, parity of the step, numbers]. `counters`: steps posted by each band, COUNTER_SPACING apart.
    """

    boxes: NDArray[Any]
    counters: NDArray[np.int64]
    bands: int


@numba.njit(cache=True, nogil=True, error_model="numpy")
def load(band, x, v, origin, rows):  # type: ignore[no-untyped-def]
    """Copy the band's rows and its neighbours' outer ones; the predicted velocity starts as the velocity."""
    columns, pitch = band.columns, band.pitch
    band.state[:] = 0.0
    for row in range(max(band.first - HALO, 0), min(band.last + HALO, rows)):
        place = (row - band.first + HALO) * band.components * pitch
        for c in range(3):
            for j in range(columns):
                band.state[place + c * pitch + j] = x[c, row * columns + j] - origin[c]
            for j in range(columns):
                speed = v[c, row * columns + j]
                band.state[place + (3 + c) * pitch + j] = speed
                band.state[place + (6 + c) * pitch + j] = speed


@numba.njit(cache=True, nogil=True, error_model="numpy")
def unload(band, x, v, origin, half):  # type: ignore[no-untyped-def]
    """Add what changed since `load` rounded the same numbers, so that single precision rounds the change alone."""
    columns, pitch = band.columns, band.pitch
    number = band.state.dtype.type
    for row in range(band.first, band.last):
        place = (row - band.first + HALO) * band.components * pitch
        for c in range(3):
            for j in range(columns):
                k = row * columns + j
                position, speed = band.state[place + c * pitch + j], band.state[place + (3 + c) * pitch + j]
                x[c, k] += (position - number(x[c, k] - origin[c])) - half * speed
                v[c, k] += speed - number(v[c, k])
            if band.components > 9:
                for j in range(columns):
                    x[c, row * columns + j] += band.state[place + (9 + c) * pitch + j]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _reaction(grips, grip, c, time, state, place, pitch):  # type: ignore[no-untyped-def]
    """One component of a grip's point and of the force on it; the velocity is the predicted one."""
    path = grips.paths[grip, c]
    point = path[0] + time * (path[1] + time * (path[2] + time * path[3]))
    speed = path[1] + time * (2.0 * path[2] + time * 3.0 * path[3])
    stretch = state[place + c * pitch] - point
    return point, grips.stiffness[grip] * stretch + grips.damping[grip] * (state[place + (6 + c) * pitch] - speed)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _pull(grips, grip, time, dt, state, place, pitch, ring, ring_place):  # type: ignore[no-untyped-def]
    """Add one grip's force to its particle's entry of the force ring; book the reaction over dt.

    state[place] is the particle's first position component.
    """
    x, fx = _reaction(grips, grip, 0, time, state, place, pitch)
    y, fy = _reaction(grips, grip, 1, time, state, place, pitch)
    z, fz = _reaction(grips, grip, 2, time, state, place, pitch)
    ring[ring_place] -= fx
    ring[ring_place + pitch] -= fy
    ring[ring_place + 2 * pitch] -= fz
    impulse, moment = grips.impulses[grip], grips.moments[grip]
    impulse[0] += dt * fx
    impulse[1] += dt * fy
    impulse[2] += dt * fz
    moment[0] += dt * (y * fz - z * fy)
    moment[1] += dt * (z * fx - x * fz)
    moment[2] += dt * (x * fy - y * fx)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _first_grip(grips, band):  # type: ignore[no-untyped-def]
    return np.searchsorted(grips.particles, band.first * band.columns)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _pull_row(grips, grip, row, time, dt, band, ring_place):  # type: ignore[no-untyped-def]
    """Add the forces of the grips on one row of the sheet, `grip` being the first; return the first of the next rows."""
    columns, pitch = band.columns, band.pitch
    start = (row - band.first + HALO) * band.components * pitch
    while grip < len(grips.particles) and grips.particles[grip] // columns == row:
        column = grips.particles[grip] % columns
        _pull(grips, grip, time, dt, band.state, start + column, pitch, band.ring, ring_place + column)
        grip += 1
    return grip


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _above(band, params):  # type: ignore[no-untyped-def]
    """Start the force ring with what the two rows above the band do to its first two."""
    state, pitch, table, ring = band.state, band.pitch, band.table, band.ring
    stride, width = band.components * pitch, 3 * pitch
    entries = band.table_rows
    row_two_above(state, 0, stride, 2 * stride, pitch, table, entries[0], ring, 0, width, 2 * width, params)
    row_above(state, stride, 2 * stride, 3 * stride, pitch, table, entries[1], ring, width, 2 * width, 0, params)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _start_sweep(band, params, grips):  # type: ignore[no-untyped-def]
    state, pitch, table, ring = band.state, band.pitch, band.table, band.ring
    stride, width = band.components * pitch, 3 * pitch
    ring[:] = 0.0
    if band.first > 0:
        _above(band, params)
    if grips is not None:
        grip = _first_grip(grips, band)
    for local in range(HALO, HALO + band.last - band.first):
        at = local * stride
        ring0, ring1, ring2 = local % 3 * width, (local + 1) % 3 * width, (local + 2) % 3 * width
        if grips is not None:
            grip = _pull_row(grips, grip, band.first + local - HALO, 0.0, 0.0, band, ring0)
        entry = band.table_rows[local]
        row_start(state, at, at + stride, at + 2 * stride, pitch, table, entry, ring, ring0, ring1, ring2, params)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _step_sweep(band, params, grips, time, dt):  # type: ignore[no-untyped-def]
    state, pitch, table, ring = band.state, band.pitch, band.table, band.ring
    stride, width = band.components * pitch, 3 * pitch
    ring[:] = 0.0
    if band.first > 0:
        _above(band, params)
    if grips is not None:
        grip = _first_grip(grips, band)
    for local in range(HALO, HALO + band.last - band.first):
        at = local * stride
        ring0, ring1, ring2 = local % 3 * width, (local + 1) % 3 * width, (local + 2) % 3 * width
        if grips is not None:
            grip = _pull_row(grips, grip, band.first + local - HALO, time, dt, band, ring0)
        entry = band.table_rows[local]
        row_step(state, at, at + stride, at + 2 * stride, pitch, table, entry, ring, ring0, ring1, ring2, params)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _copy(source, place, target, start, rows, stride, pitch):  # type: ignore[no-untyped-def]
    """Copy positions and predicted velocities of consecutive rows, all that springs look at."""
    for row in range(rows):
        for kind in (0, 6):
            for j in range(3 * pitch):
                target[start + row * stride + kind * pitch + j] = source[place + row * stride + kind * pitch + j]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _exchange(band, mail, step):  # type: ignore[no-untyped-def]
    """Post this band's outer rows as they are before step `step`; wait for the neighbours' and take them in.

    Two boxes in turn are enough: a band posts step n + 2 only after its neighbour posted n + 1, so has taken in n.
    """
    stride, parity, size = band.components * band.pitch, step % 2, band.last - band.first
    if band.index > 0:
        _copy(band.state, HALO * stride, mail.boxes[band.index, 0, parity], 0, HALO, stride, band.pitch)
    if band.index < mail.bands - 1:
        _copy(band.state, size * stride, mail.boxes[band.index, 1, parity], 0, HALO, stride, band.pitch)
    store_release(mail.counters, band.index * COUNTER_SPACING, step + 1)
    if band.index > 0:
        wait_for(mail.counters, (band.index - 1) * COUNTER_SPACING, step + 1)
        _copy(mail.boxes[band.index - 1, 1, parity], 0, band.state, 0, HALO, stride, band.pitch)
    if band.index < mail.bands - 1:
        wait_for(mail.counters, (band.index + 1) * COUNTER_SPACING, step + 1)
        below = mail.boxes[band.index + 1, 0, parity]
        _copy(below, 0, band.state, (HALO + size) * stride, HALO, stride, band.pitch)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def advance_band(band, x, v, origin, steps, dt, once, ends, full, fast, predicts, grips, mail):  # type: ignore[no-untyped-def]
    """Advance one band by `steps` steps of dt; called by as many threads as there are bands, or by one without mail.

    `once` are the parameters of an ordinary step. With `fast`, those without the weak families, odd steps use it and even steps `full`, where the weak
    ones count double, but the first and the last `ends`, where they count 1.5 times.
    """
    rows = x.shape[1] // band.columns
    load(band, x, v, origin, rows)
    if predicts is not None:
        _start_sweep(band, once, grips)
    else:
        half = band.state.dtype.type(0.5 * dt)
        stride = band.components * band.pitch
        for row in range(len(band.state) // stride):
            for j in range(row * stride, row * stride + 3 * band.pitch):
                band.state[j] += half * band.state[j + 3 * band.pitch]
    for step in range(steps):
        if mail is not None:
            _exchange(band, mail, step)
        time = (step + 0.5) * dt
        if fast is not None and step % 2 == 1:
            _step_sweep(band, fast, grips, time, dt)
        else:
            params = once
            if fast is not None:
                params = ends if step == 0 or step == steps - 1 else full
            _step_sweep(band, params, grips, time, dt)
    unload(band, x, v, origin, 0.5 * dt)
