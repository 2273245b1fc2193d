# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Leapfrog sweeps over a band of rows: the compiled loops of `grid_leapfrog`.

A sheet is cut into bands of rows. Each has its own padded copy of its rows and of those of its neighbours that it looks
at. Before each sweep it takes in its neighbours' rows, after it posts its own outer ones; the springs that cross a
border are evaluated on both sides, with the same operations in the same order, so that any number of bands gives the
same bits.

A band's next sweep is a task that any thread may take; each prefers the band of its own number, which its cache
holds. So a thread that the system puts aside between two tasks holds nobody up.

None in place of `grips` or `fast` leaves their code out of the compiled loop.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.kernels.grid_load import REACH, load_band, unload_band
from cloth_sim_ros.physics.kernels.grid_rows import CARRY, row_above, row_start, row_step, row_two_above
from cloth_sim_ros.physics.kernels.grid_sync import claim, load_acquire, pause, store_release, yield_processor
from cloth_sim_ros.physics.kernels.held_points import book, held_point

COUNTER_SPACING = 16
"""Counters of two bands lie this many int64 apart, on cache lines of their own."""


_PATIENCE = 2000
"""Looks, some tens of microseconds, before a thread takes another's task or lets others have the processor."""

_IMPATIENCE = 20
"""The same for a thread that has just found another one missing."""


class Sheet(NamedTuple):
    """A sheet of `rows` x `columns` particles, cut into bands.

    `pitch`: numbers in a padded row. `components`: padded rows that make up a row of `state`. `levels`: steps taken
    in one sweep. `borders`: first row of each band, and `rows`. `state`: for each band its rows with REACH * levels
    rows on either side. `ring`: for each band and level 3 rows of 3 times `pitch`. `table`: see `grid_rows`;
    `table_rows`: where the entries of the rows start, from REACH * levels rows above the sheet to as many below.
    `boxes`: rows on either side of each border between two bands, [border, below or above, parity of the sweep,
    numbers].
    """

    rows: int
    columns: int
    pitch: int
    components: int
    levels: int
    borders: NDArray[np.int64]
    state: NDArray[Any]
    ring: NDArray[Any]
    table: NDArray[Any]
    table_rows: NDArray[np.intp]
    boxes: NDArray[Any]


class Band(NamedTuple):
    """Rows `first` to `last` - 1 of a sheet, with the sheet's properties; `state` and `ring` are the band's own."""

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


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _band(sheet, number):  # type: ignore[no-untyped-def]
    first, last = sheet.borders[number], sheet.borders[number + 1]
    state, ring, entries = sheet.state[number], sheet.ring[number], sheet.table_rows[first:]
    return Band(
        first,
        last,
        sheet.rows,
        sheet.columns,
        sheet.pitch,
        sheet.components,
        sheet.levels,
        state,
        ring,
        sheet.table,
        entries,
    )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _reaction(grips, grip, c, time, state, place, pitch):  # type: ignore[no-untyped-def]
    """One component of a held point's velocity and of the force on it; the particle's velocity is the predicted one."""
    path = grips.paths[grip, c]
    point = path[0] + time * (path[1] + time * (path[2] + time * path[3]))
    speed = path[1] + time * (2.0 * path[2] + time * 3.0 * path[3])
    stretch = state[place + c * pitch] - point
    return speed, grips.stiffness[grip] * stretch + grips.damping[grip] * (state[place + (6 + c) * pitch] - speed)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _pull(grips, turns, grip, time, entry, dt, state, place, pitch, ring, ring_place):  # type: ignore[no-untyped-def]
    """Add one grip's force to its particle's entry of the force ring; book the reaction over dt.

    state[place] is the particle's first position component. `turns`: those of the grips, None where none turns.
    """
    if turns is None:
        ux, fx = _reaction(grips, grip, 0, time, state, place, pitch)
        uy, fy = _reaction(grips, grip, 1, time, state, place, pitch)
        uz, fz = _reaction(grips, grip, 2, time, state, place, pitch)
        impulse = grips.impulses[grip]
        impulse[0] += dt * fx
        impulse[1] += dt * fy
        impulse[2] += dt * fz
        grips.work[grip] -= dt * (ux * fx + uy * fy + uz * fz)
    else:
        arm, point, speed = held_point(turns.poses[entry, turns.owners[grip]], turns.offsets[grip])
        stiffness, damping, seen = grips.stiffness[grip], grips.damping[grip], place + 6 * pitch
        fx = stiffness * (state[place] - point[0]) + damping * (state[seen] - speed[0])
        fy = stiffness * (state[place + pitch] - point[1]) + damping * (state[seen + pitch] - speed[1])
        fz = stiffness * (state[place + 2 * pitch] - point[2]) + damping * (state[seen + 2 * pitch] - speed[2])
        book(turns.booked[grip], arm, speed, (fx, fy, fz), dt)
    ring[ring_place] -= fx
    ring[ring_place + pitch] -= fy
    ring[ring_place + 2 * pitch] -= fz


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _pull_row(grips, row, time, entry, dt, band, ring_row):  # type: ignore[no-untyped-def]
    """Add the forces of the grips on one row of the sheet; book them if the row is the band's own."""
    columns, pitch = band.columns, band.pitch
    place = (row - band.first + REACH * band.levels) * band.components * pitch
    booked = dt if band.first <= row < band.last else 0.0
    grip = np.searchsorted(grips.particles, row * columns)
    while grip < len(grips.particles) and grips.particles[grip] < (row + 1) * columns:
        column = grips.particles[grip] - row * columns
        at, ring_at = place + column, ring_row + column
        _pull(grips, grips.turns, grip, time, entry, booked, band.state, at, pitch, band.ring, ring_at)
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
                state[j + CARRY // 3 * width] = way - (end - state[j])
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
                _pull_row(grips, row, 0.0, 0, 0.0, band, ring0)
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
def _step_row(band, level, row, top, shape, values, grips, step, dt):  # type: ignore[no-untyped-def]
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
            _pull_row(grips, row, (step + 0.5) * dt, step + 1, dt, band, ring0)
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
            if fast is not None and step % 2 == 1:
                _step_row(band, level, row, top, fast, once, grips, step, dt)
            else:
                values = once
                if fast is not None:
                    values = ends if step == 0 or step == steps - 1 else full
                _step_row(band, level, row, top, shape, values, grips, step, dt)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _copy(source, place, target, start, count):  # type: ignore[no-untyped-def]
    for j in range(count):
        target[start + j] = source[place + j]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _post(sheet, band, number, turn):  # type: ignore[no-untyped-def]
    """Copy the band's outer rows, as they are before sweep `turn`, to where its neighbours find them.

    Two boxes in turn are enough: a band posts for sweep n + 2 after its neighbours have done sweep n, so have taken
    in n.
    """
    stride = sheet.components * sheet.pitch
    count, size = REACH * sheet.levels * stride, (band.last - band.first) * stride
    if number > 0:
        _copy(band.state, count, sheet.boxes[number - 1, 0, turn % 2], 0, count)
    if number < len(sheet.borders) - 2:
        _copy(band.state, size, sheet.boxes[number, 1, turn % 2], 0, count)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _take_in(sheet, band, number, turn):  # type: ignore[no-untyped-def]
    """Copy what the neighbours posted before sweep `turn` to the rows beyond the band's own."""
    stride = sheet.components * sheet.pitch
    count, size = REACH * sheet.levels * stride, (band.last - band.first) * stride
    if number > 0:
        _copy(sheet.boxes[number - 1, 1, turn % 2], 0, band.state, 0, count)
    if number < len(sheet.borders) - 2:
        _copy(sheet.boxes[number, 0, turn % 2], 0, band.state, count + size, count)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _begin(sheet, number, x, v, origin, dt, shape, once, grips):  # type: ignore[no-untyped-def]
    """First task of a band: load it and go to the first half step."""
    band = _band(sheet, number)
    load_band(band, x, v, origin, shape)
    if shape.predicted is not None:
        _start_sweep(band, shape, once, grips)
    else:
        _drift(band, shape, band.state.dtype.type(0.5 * dt))
    _post(sheet, band, number, 0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _continue(  # type: ignore[no-untyped-def]
    sheet, number, turn, x0, v0, x, v, origin, steps, dt, shape, fast, once, ends, full, grips
):
    """One more sweep of a band; the last one ends with writing the state."""
    band = _band(sheet, number)
    _take_in(sheet, band, number, turn)
    begin = turn * sheet.levels
    _sweep(band, begin, min(sheet.levels, steps - begin), steps, dt, shape, fast, once, ends, full, grips)
    if begin + sheet.levels < steps:
        _post(sheet, band, number, turn + 1)
    else:
        unload_band(band, x0, v0, x, v, origin, 0.5 * dt)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _is_ready(done, number, tasks):  # type: ignore[no-untyped-def]
    """Whether the band has a task left for which its neighbours have done theirs."""
    mine = load_acquire(done, number * COUNTER_SPACING)
    if mine == tasks:
        return False
    bands = len(done) // COUNTER_SPACING
    above = number == 0 or load_acquire(done, (number - 1) * COUNTER_SPACING) >= mine
    return above and (number == bands - 1 or load_acquire(done, (number + 1) * COUNTER_SPACING) >= mine)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def advance_sheet(  # type: ignore[no-untyped-def]
    sheet, own, counters, start_x, start_v, end_x, end_v, origin, steps, dt, shape, fast, once, ends, full, grips
):
    """Advance a sheet by `steps` steps of dt, alone or together with other threads; return when all is done.

    `own`: the band to prefer. `counters`: zeros to begin with, for each band its tasks done, then for each whether one
    is being done, COUNTER_SPACING apart. From `start_x`, `start_v` to `end_x`, `end_v`, all (3, n); these may be the
    same arrays, and `end_v` empty, which then is not written. `shape` and `once` describe an ordinary step. With
    `fast`, the shape without the weak families, odd steps leave them out and even steps use the values `full`, where
    they count double; but the first and the last `ends`, 1.5 times.
    """
    bands = len(sheet.borders) - 1
    done, claims = counters[: bands * COUNTER_SPACING], counters[bands * COUNTER_SPACING :]
    x0, v0, x, v = start_x.ravel(), start_v.ravel(), end_x.ravel(), end_v.ravel()
    tasks = 1 + (steps + sheet.levels - 1) // sheet.levels
    finished, waits, patience = 0, 0, _PATIENCE
    while finished < bands:
        number = own
        if not _is_ready(done, own, tasks):
            # Look at the others only after a while: as a rule their own threads are at hand.
            waits += 1
            if waits >= patience:
                for other in range(bands):
                    if _is_ready(done, other, tasks):
                        number = other
        if _is_ready(done, number, tasks) and claim(claims, number * COUNTER_SPACING):
            if _is_ready(done, number, tasks):
                task = load_acquire(done, number * COUNTER_SPACING)
                if task == 0:
                    _begin(sheet, number, x0, v0, origin, dt, shape, once, grips)
                else:
                    _continue(
                        *(sheet, number, task - 1, x0, v0, x, v, origin, steps, dt),
                        *(shape, fast, once, ends, full, grips),
                    )
                store_release(done, number * COUNTER_SPACING, task + 1)
                # Who found another thread missing looks after its work sooner the next time, until it is back.
                patience = min(2 * patience, _PATIENCE) if number == own else _IMPATIENCE
                waits = 0
            store_release(claims, number * COUNTER_SPACING, 0)
        elif waits >= _PATIENCE:
            yield_processor()
        else:
            pause()
        finished = 0
        for band in range(bands):
            if load_acquire(done, band * COUNTER_SPACING) == tasks:
                finished += 1
