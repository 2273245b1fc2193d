# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Leapfrog steps of a regular sheet, forces and motion in one sweep over the rows.

Drift, kick, drift with a midpoint velocity: x_h = x + dt/2 v; a = a(x_h, v + dt/2 a_previous); v += dt a; x = x_h + dt/2 v.
Second order, one force evaluation a step and one more at the start of each call, so that no history crosses a call. Between
steps the kernel keeps x_h. An undamped mode is stable for dt <= 2/omega; damping in proportion to stiffness, of ratio zeta at that mode,
lowers this to dt <= (2/omega) (sqrt(1 + 4 zeta^2) - 2 zeta).
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cloth_sim_ros.physics.kernels.grid_springs import (
    Array,
    GridSprings,
    aligned_zeros,
    grid_tables,
    parameters,
    spring_fields,
)
from cloth_sim_ros.physics.kernels.grid_sweep import COUNTER_SPACING, HALO, Band, Mail, advance_band


class GridGrips(NamedTuple):
    """Zero-length springs from particles to points on cubic paths (S4 of the model).

    F = -stiffness s - damping ds/dt with s = x - path(t).

    `particles`: indices, ascending, shape (grip_count,). `paths` [m, m/s, m/s^2, m/s^3]: coefficients of 1, t, t^2, t^3 with t
    the time since the start of the call, shape (grip_count, 3, 4). `stiffness` [N/m], `damping` [N s/m]: shape (grip_count,).
    `impulses` [N s], shape (grip_count, 3), receives the time integral of the force of the cloth on each point; `moments`
    [N m s], shape (grip_count, 3), that of path(t) x force.
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
        dtype: float64, or float32 for arithmetic in single precision about the sheet's first particle. Either way `advance`
            takes and gives float64 and adds the change to it; in single precision the positions carry what rounding takes
            from them, so that it does not add up.
        alternate: evaluate the families marked `weak` at every second step only, with twice the impulse.
        threads: the sheet is cut into as many bands of rows, each moved by a thread of its own. The bits do not depend on it.

    Not safe for two calls at once: the object owns its padded copy of the state.

    Raises:
        ValueError: for masses of another shape, drag that is negative or not finite, or bands of less than two rows.
    """

    def __init__(
        self,
        springs: GridSprings,
        inverse_masses: ArrayLike,
        *,
        gravity: ArrayLike | None = None,
        drag: float = 0.0,
        dtype: Any = np.float64,
        alternate: bool = False,
        threads: int = 1,
    ) -> None:
        inverse = np.asarray(inverse_masses, dtype=np.float64)
        count = springs.rows * springs.columns
        if inverse.shape != (count,):
            raise ValueError(f"inverse_masses has shape {inverse.shape}; this sheet needs ({count},)")
        if not (np.isfinite(drag) and drag >= 0.0):
            raise ValueError(f"drag is {drag} 1/s; it must be finite and not negative")
        if threads < 1 or (threads > 1 and springs.rows < HALO * threads):
            raise ValueError(f"{threads} threads for {springs.rows} rows; take from 1 to {max(springs.rows // HALO, 1)}")
        self.springs = springs
        self.alternate = alternate and any(family.weak for family in springs.families)
        self._dtype = np.dtype(dtype)
        self._motion = {} if drag == 0.0 else {"drag": drag}
        if gravity is not None:
            self._motion |= {f"gravity_{c}": float(g) for c, g in enumerate(np.asarray(gravity, dtype=np.float64))}
        if self._dtype == np.float32:
            self._motion["carry"] = 1.0
        self._predicts = springs.damped or drag > 0.0
        self._bands = self._cut(inverse, threads)
        self._mail = self._post_office() if threads > 1 else None
        self._workers = ThreadPoolExecutor(threads - 1, thread_name_prefix="grid") if threads > 1 else None

    def _cut(self, inverse: Array, threads: int) -> list[Band]:
        """Cut the sheet into bands of about equal height."""
        pitch, table, table_rows = grid_tables(self.springs, inverse, self._dtype)
        above = np.concatenate([np.zeros(HALO, dtype=np.intp), table_rows])
        components = 12 if self._dtype == np.float32 else 9
        borders = [self.springs.rows * band // threads for band in range(threads + 1)]
        bands = []
        for index, (first, last) in enumerate(zip(borders[:-1], borders[1:], strict=True)):
            state = aligned_zeros((last - first + 2 * HALO) * components * pitch, self._dtype)
            ring = aligned_zeros(3 * 3 * pitch, self._dtype)
            entries = above[first : last + HALO].copy()
            columns = self.springs.columns
            bands.append(Band(first, last, columns, pitch, components, state, ring, table, entries, index))
        return bands

    def _post_office(self) -> Mail:
        band = self._bands[0]
        boxes = np.zeros((len(self._bands), 2, 2, HALO * band.components * band.pitch), dtype=self._dtype)
        return Mail(boxes, np.zeros(len(self._bands) * COUNTER_SPACING, dtype=np.int64), len(self._bands))

    def _parameters(self, dt: float, weak: float | None, predicts: int | None) -> NDArray[Any]:
        """Parameters of a step in which the weak families count `weak` times, None for not at all."""
        factors = {False: 1.0} if weak is None else {False: 1.0, True: weak}
        fields = spring_fields(self.springs, factors=factors) | self._motion | {"step": dt, "half": 0.5 * dt}
        return parameters(fields | ({} if predicts is None else {"predicted": 1.0}), self._dtype)

    def advance(self, x: Array, v: Array, steps: int, dt: float, *, grips: GridGrips | None = None) -> None:
        """Advance positions x [m] and velocities v [m/s] in place by `steps` steps of dt [s].

        Both (3, rows * columns) float64, C-contiguous. With `alternate` the number of steps must be odd: then the impulses of the weak
        families lie symmetrically in the call, the first and the last counting 1.5 times.

        Raises:
            ValueError: for another shape, or a number of steps that is not positive or, with `alternate`, even.
        """
        expected = (3, self.springs.rows * self.springs.columns)
        for name, array in (("x", x), ("v", v)):
            if array.shape != expected:
                raise ValueError(f"{name} has shape {array.shape}; this sheet needs {expected}")
        if steps < 1:
            raise ValueError(f"{steps} steps; at least one is needed")
        if self.alternate and steps % 2 == 0:
            raise ValueError(f"{steps} steps; weak families at every second step need an odd number")
        predicts = 1 if self._predicts or grips is not None else None
        origin = np.zeros(3) if self._dtype == np.float64 else x[:, 0].copy()
        alternate = self.alternate and steps > 1
        common = (
            *(x, v, origin, steps, dt),
            *(self._parameters(dt, weak, predicts) for weak in (1.0, 1.5, 2.0)),
            self._parameters(dt, None, predicts) if alternate else None,
            *(predicts, None if grips is None else _near(grips, origin), self._mail),
        )
        if self._workers is None or self._mail is None:
            advance_band(self._bands[0], *common)
        else:
            self._mail.counters[:] = 0
            others = [self._workers.submit(advance_band, band, *common) for band in self._bands[1:]]
            advance_band(self._bands[0], *common)
            for other in others:
                other.result()
        if grips is not None:
            grips.moments[:] += np.cross(origin, grips.impulses)


def _near(grips: GridGrips, origin: Array) -> GridGrips:
    """The same grips with paths relative to `origin`, impulses and moments at zero."""
    paths = np.array(grips.paths, dtype=np.float64)
    paths[:, :, 0] -= origin
    grips.impulses[:] = 0.0
    grips.moments[:] = 0.0
    return grips._replace(paths=paths)
