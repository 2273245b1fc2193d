# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Leapfrog sweeps over a band of rows: the compiled loops of `grid_leapfrog`.

A band keeps its own padded copy of its rows, two rows of the band above before them and two of the band below after
them. After each step it posts its outer rows and reads those of its neighbours; the springs that cross a border are
evaluated on both sides, with the same operations in the same order, so that any number of bands gives the same bits.

None in place of `grips`, `fast` or `mail` leaves their code out of the compiled loop.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.kernels.grid_copy import copy_in
from cloth_sim_ros.physics.kernels.grid_rows import row_above, row_start, row_step, row_two_above
from cloth_sim_ros.physics.kernels.grid_sync import store_release, wait_for

REACH = 2
"""Rows that a step looks beyond the rows that it moves: the longest spring."""

COUNTER_SPACING = 16
"""Counters of two bands lie this many int64 apart, on cache lines of their own."""


class Band(NamedTuple):
    """Rows `first` to `last` - 1 of a sheet of `rows` x `columns` particles, and the buffers of the thread that moves
    them.

    `state`: flat; the band's rows with REACH * levels rows on either side, `components` times `pitch` numbers each.
    `levels`: steps taken in one sweep. `ring`: flat, for each level 3 rows of 3 times `pitch`. `table_rows`: where
    the table entries of the rows in `state` start. `number`: which band this is.
    """

    first: int
    last: int
    rows: int
    columns: int
    pitch: int
    components: int
    levels: int
    state: NDArray[Any]
    ring: NDArray[Any]
    table: NDArray[Any]
    table_rows: NDArray[np.intp]
    number: int


class Mail(NamedTuple):
    """Where bands exchange their outer rows.

    `boxes`: [band, upwards or downwards, parity of the step, numbers]. `counters`: steps posted by each band,
    COUNTER_SPACING apart.
    """

    boxes: NDArray[Any]
    counters: NDArray[np.int64]
    bands: int


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _load(band, x, v, origin):  # type: ignore[no-untyped-def]
    """Copy the band's rows and its neighbours' outer ones; the predicted velocity starts as the velocity.

    What lies outside the sheet is cleared: after a state that was not finite it would spoil the next one.
    """
    columns, pitch, halo = band.columns, band.pitch, REACH * band.levels
    count = band.rows * columns
    band.state[:] = 0.0
    for row in range(max(band.first - halo, 0), min(band.last + halo, band.rows)):
        place = (row - band.first + halo) * band.components * pitch
        for c in range(3):
            start = c * count + row * columns
            copy_in(x, start, origin[c], columns, band.state, place + c * pitch)
            copy_in(v, start, 0.0, columns, band.state, place + (3 + c) * pitch)
            copy_in(v, start, 0.0, columns, band.state, place + (6 + c) * pitch)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _unload(band, x, v, origin, half):  # type: ignore[no-untyped-def]
    """Add what changed since `_load` rounded the same numbers, so that single precision rounds the change alone."""
    columns, pitch, halo = band.columns, band.pitch, REACH * band.levels
    count = band.rows * columns
    number = band.state.dtype.type
    for row in range(band.first, band.last):
        place = (row - band.first + halo) * band.components * pitch
        for c in range(3):
            start = c * count + row * columns
            for j in range(columns):
                position, speed = band.state[place + c * pitch + j], band.state[place + (3 + c) * pitch + j]
                x[start + j] += (position - number(x[start + j] - origin[c])) - half * speed
                v[start + j] += speed - number(v[start + j])
            if band.components > 9:
                for j in range(columns):
                    x[start + j] += band.state[place + (9 + c) * pitch + j]


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
def _pull_row(grips, row, time, dt, band, ring_row):  # type: ignore[no-untyped-def]
    """Add the forces of the grips on one row of the sheet; book them if the row is the band's own."""
    columns, pitch = band.columns, band.pitch
    place = (row - band.first + REACH * band.levels) * band.components * pitch
    booked = dt if band.first <= row < band.last else 0.0
    grip = np.searchsorted(grips.particles, row * columns)
    while grip < len(grips.particles) and grips.particles[grip] < (row + 1) * columns:
        column = grips.particles[grip] - row * columns
        _pull(grips, grip, time, booked, band.state, place + column, pitch, band.ring, ring_row + column)
        grip += 1


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _drift(band, shape, duration):  # type: ignore[no-untyped-def]
    """Move all positions, where no velocity has to be predicted: what `row_start` does to them."""
    state, width = band.state, 3 * band.pitch
    stride = band.components * band.pitch
    for row in range(len(state) // stride):
        for j in range(row * stride, row * stride + width):
            way = duration * state[j + width]
            end = state[j] + way
            if shape.carry is not None:
                state[j + 3 * width] = way - (end - state[j])
            state[j] = end


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _start_sweep(band, shape, values, grips):  # type: ignore[no-untyped-def]
    """Predict the velocities of the first half step and move the positions there."""
    state, pitch, table, ring = band.state, band.pitch, band.table, band.ring
    stride, width, halo = band.components * pitch, 3 * pitch, REACH * band.levels
    ring[:] = 0.0
    for row in range(max(band.first - REACH, 0), band.last):
        local = row - band.first + halo
        at = local * stride
        ring0, ring1, ring2 = local % 3 * width, (local + 1) % 3 * width, (local + 2) % 3 * width
        entry = band.table_rows[local]
        if row >= band.first:
            if grips is not None:
                _pull_row(grips, row, 0.0, 0.0, band, ring0)
            row_start(
                state, at, at + stride, at + 2 * stride, pitch, table, entry, ring, ring0, ring1, ring2, shape, values
            )
        elif row == band.first - 1:
            row_above(
                state, at, at + stride, at + 2 * stride, pitch, table, entry, ring, ring0, ring1, ring2, shape, values
            )
        else:
            row_two_above(
                state, at, at + stride, at + 2 * stride, pitch, table, entry, ring, ring0, ring1, ring2, shape, values
            )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _step_row(band, level, row, top, shape, values, grips, time, dt):  # type: ignore[no-untyped-def]
    """Move one row of the sheet by one step, or, above row `top`, only do what it does to the rows below."""
    state, pitch, table, ring = band.state, band.pitch, band.table, band.ring
    stride, width = band.components * pitch, 3 * pitch
    local = row - band.first + REACH * band.levels
    at, turn, base = local * stride, local % 3, 3 * level
    ring0 = (base + turn) * width
    ring1 = (base + (turn + 1 if turn < 2 else 0)) * width
    ring2 = (base + (turn - 1 if turn > 0 else 2)) * width
    entry = band.table_rows[local]
    if row >= top:
        if grips is not None:
            _pull_row(grips, row, time, dt, band, ring0)
        row_step(state, at, at + stride, at + 2 * stride, pitch, table, entry, ring, ring0, ring1, ring2, shape, values)
    elif row == top - 1:
        row_above(
            state, at, at + stride, at + 2 * stride, pitch, table, entry, ring, ring0, ring1, ring2, shape, values
        )
    else:
        row_two_above(
            state, at, at + stride, at + 2 * stride, pitch, table, entry, ring, ring0, ring1, ring2, shape, values
        )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _sweep(band, begin, levels, steps, dt, shape, fast, once, ends, full, grips):  # type: ignore[no-untyped-def]
    """Take steps `begin` to `begin` + `levels` - 1 in one sweep, each REACH rows behind the one before it.

    Next to a neighbour a step also moves the rows, REACH fewer with each step, that the later ones will look at.
    """
    band.ring[:] = 0.0
    margin = REACH * (levels - 1)
    for front in range(max(band.first - margin - REACH, 0), min(band.last, band.rows) + margin):
        for level in range(levels):
            row = front - REACH * level
            margin_here = margin - REACH * level
            top = max(band.first - margin_here, 0)
            if row < max(top - REACH, 0) or row >= min(band.last + margin_here, band.rows):
                continue
            step = begin + level
            time = (step + 0.5) * dt
            if fast is not None and step % 2 == 1:
                _step_row(band, level, row, top, fast, once, grips, time, dt)
            else:
                values = once
                if fast is not None:
                    values = ends if step == 0 or step == steps - 1 else full
                _step_row(band, level, row, top, shape, values, grips, time, dt)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _copy(source, place, target, start, count):  # type: ignore[no-untyped-def]
    for j in range(count):
        target[start + j] = source[place + j]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _exchange(band, mail, turn):  # type: ignore[no-untyped-def]
    """Post this band's outer rows before sweep number `turn`; wait for the neighbours' and take them in.

    Two boxes in turn are enough: a band posts for sweep n + 2 only after its neighbour posted for n + 1, so has taken
    in n.
    """
    stride, parity, halo = band.components * band.pitch, turn % 2, REACH * band.levels
    size, count, number = (band.last - band.first) * stride, halo * stride, band.number
    if number > 0:
        _copy(band.state, count, mail.boxes[number, 0, parity], 0, count)
    if number < mail.bands - 1:
        _copy(band.state, size, mail.boxes[number, 1, parity], 0, count)
    store_release(mail.counters, number * COUNTER_SPACING, turn + 1)
    if number > 0:
        wait_for(mail.counters, (number - 1) * COUNTER_SPACING, turn + 1)
        _copy(mail.boxes[number - 1, 1, parity], 0, band.state, 0, count)
    if number < mail.bands - 1:
        wait_for(mail.counters, (number + 1) * COUNTER_SPACING, turn + 1)
        _copy(mail.boxes[number + 1, 0, parity], 0, band.state, count + size, count)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def advance_band(band, x, v, origin, steps, dt, shape, fast, once, ends, full, grips, mail):  # type: ignore[no-untyped-def]
    """Advance one band by `steps` steps of dt; called by as many threads as there are bands, or by one without mail.

    `x`, `v` are flat. `shape` and `once` describe an ordinary step. With `fast`, the shape without the weak families,
    odd steps leave them out and even steps use the values `full`, where they count double; but the first and the last
    `ends`, 1.5 times.
    """
    _load(band, x, v, origin)
    if shape.predicted is not None:
        _start_sweep(band, shape, once, grips)
    else:
        _drift(band, shape, band.state.dtype.type(0.5 * dt))
    for turn in range((steps + band.levels - 1) // band.levels):
        if mail is not None:
            _exchange(band, mail, turn)
        begin = turn * band.levels
        _sweep(band, begin, min(band.levels, steps - begin), steps, dt, shape, fast, once, ends, full, grips)
    _unload(band, x, v, origin, 0.5 * dt)
