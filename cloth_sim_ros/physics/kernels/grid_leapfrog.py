# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Leapfrog steps of a regular sheet, forces and motion in one sweep over the rows.

Drift, kick, drift with a midpoint velocity: x_h = x + dt/2 v; a = a(x_h, v + dt/2 a_previous); v += dt a; x = x_h + dt/2 v. Second order,
one force evaluation a step and one more at the start of each call, so that no history crosses a call. Between steps the kernel keeps x_h.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from cloth_sim_ros.physics.kernels.grid_rows import row_start, row_step
from cloth_sim_ros.physics.kernels.grid_springs import (
    Array,
    GridSprings,
    aligned_zeros,
    grid_tables,
    parameters,
    spring_fields,
)


class GridGrips(NamedTuple):
    """Zero-length springs from particles to points on cubic paths, F = -stiffness s - damping ds/dt, s = x - path(t) (S4 of the model).

    `particles`: indices, ascending, shape (grip_count,). `paths` [m, m/s, m/s^2, m/s^3]: coefficients of 1, t, t^2, t^3 with t the time since the
    start of the call, shape (grip_count, 3, 4). `stiffness` [N/m], `damping` [N s/m]: shape (grip_count,).
    `impulses` [N s]: shape (grip_count, 3), receives the time integral of the force of the cloth on each point.
    `moments` [N m s]: shape (grip_count, 3), receives the time integral of path(t) x that force.
    """

    particles: NDArray[np.int64]
    paths: Array
    stiffness: Array
    damping: Array
    impulses: Array
    moments: Array


class GridLeapfrog:
    """Fused leapfrog of one sheet. What is left out here has no instruction in the compiled loop.

    Args:
        springs: the sheet.
        inverse_masses: 1/m [1/kg], zero for anchored particles (they keep their velocity), shape (rows * columns,).
        gravity: acceleration [m/s^2], shape (3,), or None.
        drag: a = -drag v [1/s]; 0 for none.
        dtype: float64, or float32 for arithmetic in single precision about the sheet's first particle. Either way `advance` takes and
            gives float64, and adds the change to it, so that nothing is lost from frame to frame.

    Not safe for two threads at once: the object owns its padded copy of the state.

    Raises:
        ValueError: for masses of another shape, or drag that is negative or not finite.
    """

    def __init__(
        self,
        springs: GridSprings,
        inverse_masses: ArrayLike,
        *,
        gravity: ArrayLike | None = None,
        drag: float = 0.0,
        dtype: Any = np.float64,
    ) -> None:
        self.springs = springs
        inverse = np.asarray(inverse_masses, dtype=np.float64)
        if inverse.shape != (springs.rows * springs.columns,):
            raise ValueError(
                f"inverse_masses has shape {inverse.shape}; this sheet needs ({springs.rows * springs.columns},)"
            )
        if not (np.isfinite(drag) and drag >= 0.0):
            raise ValueError(f"drag is {drag} 1/s; it must be finite and not negative")
        self._dtype = np.dtype(dtype)
        self._tables = grid_tables(springs, inverse, dtype)
        self._fields = spring_fields(springs, factors={True: 1.0, False: 1.0})
        if drag > 0.0:
            self._fields["drag"] = drag
        if gravity is not None:
            self._fields |= {f"gravity_{c}": float(g) for c, g in enumerate(np.asarray(gravity, dtype=np.float64))}
        self._predicts = springs.damped or drag > 0.0
        pitch = self._tables.pitch
        # Two rows of zeros below the last: no weight points there, but the loads do.
        self._state = aligned_zeros((springs.rows + 2) * 9 * pitch, dtype)
        self._ring = aligned_zeros(3 * 3 * pitch, dtype)

    def advance(self, x: Array, v: Array, steps: int, dt: float, *, grips: GridGrips | None = None) -> None:
        """Advance positions x [m] and velocities v [m/s], (3, rows * columns) float64, in place, by `steps` steps of dt [s].

        Raises:
            ValueError: for another shape, or fewer than one step.
        """
        expected = (3, self.springs.rows * self.springs.columns)
        for name, array in (("x", x), ("v", v)):
            if array.shape != expected:
                raise ValueError(f"{name} has shape {array.shape}; this sheet needs {expected}")
        if steps < 1:
            raise ValueError(f"{steps} steps; at least one is needed")
        fields = self._fields | {"step": dt, "half": 0.5 * dt}
        predicts = 1 if self._predicts or grips is not None else None
        if predicts:
            fields["predicted"] = 1.0
        params = parameters(fields, self._dtype)
        origin = np.zeros(3) if self._dtype == np.float64 else x[:, 0].copy()
        near = None if grips is None else _near(grips, origin)
        pitch, table, table_rows = self._tables
        columns = self.springs.columns
        _advance(
            x, v, origin, steps, dt, columns, pitch, self._state, table, table_rows, self._ring, params, predicts, near
        )
        if grips is not None:
            grips.moments[:] += np.cross(origin, grips.impulses)


def _near(grips: GridGrips, origin: Array) -> GridGrips:
    """The same grips with paths relative to `origin`, impulses and moments at zero."""
    paths = np.array(grips.paths, dtype=np.float64)
    paths[:, :, 0] -= origin
    grips.impulses[:] = 0.0
    grips.moments[:] = 0.0
    return grips._replace(paths=paths)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _load(x, v, origin, rows, columns, pitch, state):  # type: ignore[no-untyped-def]
    for row in range(rows):
        for c in range(3):
            place = (row * 9 + c) * pitch
            for j in range(columns):
                state[place + j] = x[c, row * columns + j] - origin[c]
            place += 3 * pitch
            for j in range(columns):
                state[place + j] = v[c, row * columns + j]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _unload(x, v, origin, rows, columns, pitch, half, state):  # type: ignore[no-untyped-def]
    """Add what changed since `_load` rounded the same numbers, so that single precision rounds the change alone."""
    number = state.dtype.type
    for row in range(rows):
        for c in range(3):
            place, speed = (row * 9 + c) * pitch, (row * 9 + 3 + c) * pitch
            for j in range(columns):
                k = row * columns + j
                x[c, k] += state[place + j] - half * state[speed + j] - number(x[c, k] - origin[c])
                v[c, k] += state[speed + j] - number(v[c, k])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _pull(grips, grip, time, dt, state, place, velocity, pitch, ring, ring_place):  # type: ignore[no-untyped-def]
    """Add one grip's force to its particle's entry of the force ring; book the reaction over dt.

    `place` is the particle's first position component in `state`, `velocity` how far behind it that of its velocity is.
    """
    reaction = np.empty(3)
    point = np.empty(3)
    for c in range(3):
        path = grips.paths[grip, c]
        point[c] = path[0] + time * (path[1] + time * (path[2] + time * path[3]))
        speed = path[1] + time * (2.0 * path[2] + time * 3.0 * path[3])
        stretch = state[place + c * pitch] - point[c]
        reaction[c] = grips.stiffness[grip] * stretch + grips.damping[grip] * (
            state[place + velocity + c * pitch] - speed
        )
        ring[ring_place + c * pitch] -= reaction[c]
        grips.impulses[grip, c] += dt * reaction[c]
    for c in range(3):
        d, e = (c + 1) % 3, (c + 2) % 3
        grips.moments[grip, c] += dt * (point[d] * reaction[e] - point[e] * reaction[d])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _pull_row(grips, grip, row, columns, time, dt, state, velocity, pitch, ring):  # type: ignore[no-untyped-def]
    """Add the forces of the grips on one row, `grip` being the first; return the first of the next rows."""
    while grip < len(grips.particles) and grips.particles[grip] // columns == row:
        column = grips.particles[grip] % columns
        ring_place = row % 3 * 3 * pitch + column
        _pull(grips, grip, time, dt, state, row * 9 * pitch + column, velocity, pitch, ring, ring_place)
        grip += 1
    return grip


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _advance(  # type: ignore[no-untyped-def]
    x, v, origin, steps, dt, columns, pitch, state, table, table_rows, ring, params, predicts, grips
):
    rows = len(table_rows)
    stride = 9 * pitch
    _load(x, v, origin, rows, columns, pitch, state)
    grip = 0
    if predicts is not None:
        ring[:] = 0.0
        for row in range(rows):
            at = row * stride
            ring0, ring1, ring2 = row % 3 * 3 * pitch, (row + 1) % 3 * 3 * pitch, (row + 2) % 3 * 3 * pitch
            if grips is not None:
                grip = _pull_row(grips, grip, row, columns, 0.0, 0.0, state, 3 * pitch, pitch, ring)
            row_start(
                state,
                at,
                at + stride,
                at + 2 * stride,
                pitch,
                table,
                table_rows[row],
                ring,
                ring0,
                ring1,
                ring2,
                params,
            )
    else:
        for row in range(rows):
            for j in range(row * stride, row * stride + 3 * pitch):
                state[j] += state.dtype.type(0.5 * dt) * state[j + 3 * pitch]
    for step in range(steps):
        ring[:] = 0.0
        grip = 0
        for row in range(rows):
            at = row * stride
            ring0, ring1, ring2 = row % 3 * 3 * pitch, (row + 1) % 3 * 3 * pitch, (row + 2) % 3 * 3 * pitch
            if grips is not None:
                grip = _pull_row(grips, grip, row, columns, (step + 0.5) * dt, dt, state, 6 * pitch, pitch, ring)
            row_step(
                state,
                at,
                at + stride,
                at + 2 * stride,
                pitch,
                table,
                table_rows[row],
                ring,
                ring0,
                ring1,
                ring2,
                params,
            )
    _unload(x, v, origin, rows, columns, pitch, 0.5 * dt, state)
