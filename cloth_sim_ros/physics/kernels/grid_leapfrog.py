# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Leapfrog steps of a regular sheet, forces and motion in one sweep over the rows.

Drift, kick, drift with a midpoint velocity: x_h = x + dt/2 v; a = a(x_h, v + dt/4 (a' + a'')) with the accelerations
of the two steps before; v += dt a; x = x_h + dt/2 v. Second order, one force evaluation a step and one more at the
start of each call, where a' = a'', so that no history crosses a call. Between steps the kernel keeps x_h. An undamped
mode is stable for dt <= 2/omega; damping in proportion to stiffness, of ratio zeta at that mode, lowers this to dt <=
(2/omega) (sqrt(1 + zeta^2) - zeta).
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cloth_sim_ros.physics.kernels.grid_rows import CARRY
from cloth_sim_ros.physics.kernels.grid_springs import (
    Array,
    Constants,
    GridSprings,
    aligned_zeros,
    check_array,
    constants,
    grid_tables,
)
from cloth_sim_ros.physics.kernels.grid_sweep import COUNTER_SPACING, REACH, Sheet, advance_sheet
from cloth_sim_ros.physics.kernels.prepared import Prepared

_SECOND_CACHE = 1 << 20
"""Bytes; that of the machines at hand. A wrong guess costs a few per cent."""

_KEPT_PLANS = 16
"""Step lengths whose constants are kept: those of an extrapolation's runs, of a few frames."""


class GridTurns(NamedTuple):
    """Grips of which some gripper turns: their points do not follow cubics then.

    `owners`: gripper of each grip. `offsets` [m], shape (grip_count, 3), in the gripper's frame. `poses`: of the
    grippers at every step, see `held_points`. `booked`, shape (grip_count, BOOKED_NUMBERS), receives what is booked.
    """

    owners: NDArray[np.int64]
    offsets: Array
    poses: Array
    booked: Array


class GridGrips(NamedTuple):
    """Zero-length springs from particles to points on cubic paths (S4 of the model).

    F = -stiffness s - damping ds/dt with s = x - path(t).

    `particles`: indices, ascending, shape (grip_count,). `paths` [m, m/s, m/s^2, m/s^3]: coefficients of 1, t, t^2,
    t^3 with t the time since the start of the call, shape (grip_count, 3, 4). `stiffness` [N/m], `damping` [N s/m]:
    shape (grip_count,). `impulses` [N s], shape (grip_count, 3), receives the time integral of the force of the cloth
    on each point; `work` [J], shape (grip_count,), the work done on the cloth by each point. With `turns` these count,
    and `paths`, `impulses` and `work` do not.
    """

    particles: NDArray[np.int64]
    paths: Array
    stiffness: Array
    damping: Array
    impulses: Array
    work: Array
    turns: GridTurns | None = None


class GridLeapfrog:
    """Fused leapfrog of one sheet. What is left out here has no instruction in the compiled loop.

    Args:
        springs: the sheet.
        inverse_masses: 1/m [1/kg], zero for anchored particles (they keep their velocity), shape (rows * columns,).
        gravity: acceleration [m/s^2], shape (3,), or None.
        drag: a = -drag v [1/s]; 0 for none.
        dtype: float64, or float32 for arithmetic in single precision about the sheet's first particle. Either way
            `advance` takes and gives float64 and adds the change to it; in single precision the positions carry what
            rounding takes from them, so that it does not add up.
        threads: the sheet is cut into as many bands of rows, each moved by a thread of its own. The bits do not depend
            on it.
        beside: another loop of the same sheet, which never runs at the same time: they share threads, and the
            room for the copy of the state, where this one's fits.

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
        threads: int = 1,
        beside: GridLeapfrog | None = None,
    ) -> None:
        inverse = np.asarray(inverse_masses, dtype=np.float64)
        count = springs.rows * springs.columns
        if inverse.shape != (count,):
            raise ValueError(f"inverse_masses has shape {inverse.shape}; this sheet needs ({count},)")
        if not (np.isfinite(drag) and drag >= 0.0):
            raise ValueError(f"drag is {drag} 1/s; it must be finite and not negative")
        if threads < 1 or (threads > 1 and springs.rows < REACH * threads):
            raise ValueError(
                f"{threads} threads for {springs.rows} rows; take from 1 to {max(springs.rows // REACH, 1)}"
            )
        self.springs = springs
        self._weak = any(family.weak for family in springs.families)
        self._dtype = np.dtype(dtype)
        self._wide = self._dtype == np.float64
        self._drag = float(drag)
        self._gravity = None if gravity is None else np.array(gravity, dtype=np.float64).reshape(3)
        self._predicts = springs.damped or drag > 0.0
        self._plans: dict[tuple[float, bool, bool], tuple[Any, ...]] = {}
        self._numbers: dict[tuple[bool, bool, bool], int] = {}
        self._bands = threads
        self._expected = (3, count)
        self._sheet: Sheet = self._cut(inverse, threads, None if beside is None else beside._sheet.state)
        self._workers: ThreadPoolExecutor | None = None if beside is None else beside._workers
        if self._workers is None and threads > 1:
            self._workers = ThreadPoolExecutor(threads - 1, thread_name_prefix="grid")

    def _cut(self, inverse: Array, threads: int, room: NDArray[Any] | None) -> Sheet:
        """Cut the sheet into bands of about equal height. Each run clears what it takes of the room."""
        springs = self.springs
        pitch, table, table_rows = grid_tables(springs, inverse, self._dtype)
        components = CARRY + 3 if self._dtype == np.float32 else CARRY
        stride = components * pitch
        levels = _levels(springs.rows // threads, stride * self._dtype.itemsize, threads)
        halo = REACH * levels
        beyond = np.zeros(halo, dtype=np.intp)
        borders = springs.rows * np.arange(threads + 1) // threads
        size = (int(np.diff(borders).max()) + 2 * halo) * stride
        if room is not None and room.nbytes >= threads * size * self._dtype.itemsize:
            state = room.reshape(-1).view(self._dtype)[: threads * size]
        else:
            state = aligned_zeros(threads * size, self._dtype)
        return Sheet(
            *(springs.rows, springs.columns, pitch, components, levels, borders),
            state=state.reshape(threads, size),
            ring=aligned_zeros(threads * levels * 9 * pitch, self._dtype).reshape(threads, levels * 9 * pitch),
            table=table,
            table_rows=np.concatenate([beyond, table_rows, beyond]),
            boxes=np.zeros((threads - 1, 2, 2, halo * stride), dtype=self._dtype),
        )

    def _step_plan(self, dt: float, grips: bool, alternate: bool) -> tuple[Any, ...]:
        """Shapes and values of the steps, as `advance_sheet` takes them. The last ones are kept."""
        known = self._plans.get((dt, grips, alternate))
        if known is not None:
            return known

        def count_weak(factors: dict[bool, float]) -> Constants:
            dtype, drag, gravity, predicted = self._dtype, self._drag, self._gravity, self._predicts or grips
            return constants(self.springs, factors, dtype, step=dt, drag=drag, gravity=gravity, predicted=predicted)

        plan: tuple[Any, ...]
        once = count_weak({False: 1.0, True: 1.0})
        if alternate:
            fast = count_weak({False: 1.0}).shape
            ends, full = (count_weak({False: 1.0, True: factor}).values for factor in (1.5, 2.0))
            plan = (once.shape, fast, once.values, ends, full)
        else:
            plan = (once.shape, None, once.values, once.values, once.values)
        if len(self._plans) == _KEPT_PLANS:
            self._plans.pop(next(iter(self._plans)))
        self._plans[dt, grips, alternate] = plan
        return plan

    def compile(self, *, grips: bool = False, alternate: bool = False) -> None:
        """Compile, or load from the disk cache, what `advance` needs; the first time takes a few seconds."""
        count = self.springs.rows * self.springs.columns
        held = GridGrips(
            *(np.zeros(1, dtype=np.int64), np.zeros((1, 3, 4)), np.zeros(1), np.zeros(1)),
            *(np.zeros((1, 3)), np.zeros(1)),
        )
        self.advance(
            np.zeros((3, count)), np.zeros((3, count)), 3, 0.0, grips=held if grips else None, alternate=alternate
        )

    def advance(
        self,
        x: Array,
        v: Array | None,
        steps: int,
        dt: float,
        *,
        grips: GridGrips | None = None,
        alternate: bool = False,
        start: tuple[Array, Array] | None = None,
    ) -> None:
        """Advance positions x [m] and velocities v [m/s] by `steps` steps of dt [s], in place, or from those of
        `start`, which stay as they are; v may then be None, and only positions are set. No bit depends on it.

        All (3, rows * columns) float64, C-contiguous. `alternate` evaluates the families marked `weak` at every
        second step only, with twice the impulse. The number of steps must be odd then: so the impulses lie
        symmetrically in the call, the first and the last counting 1.5 times.

        Raises:
            ValueError: for another shape, a number of steps that is not positive or, with `alternate`, even, or v that
                is missing without a start.
        """
        expected = self._expected
        x0, v0 = (x, v) if start is None else start
        if v0 is None:
            raise ValueError("v is None without a start; give the velocities that the steps begin with")
        check_array("x", x, expected)
        if v is not None:
            check_array("v", v, expected)
        if start is not None:
            check_array("start's x", x0, expected)
            check_array("start's v", v0, expected)
        if steps < 1:
            raise ValueError(f"{steps} steps; at least one is needed")
        alternate = alternate and self._weak
        if alternate and steps % 2 == 0:
            raise ValueError(f"{steps} steps; weak families at every second step need an odd number")
        origin = _NOWHERE if self._wide else (float(x0[0, 0]), float(x0[1, 0]), float(x0[2, 0]))
        near = None if grips is None else _near(grips, origin)
        turns = near is not None and near.turns is not None
        shape, fast, once, ends, full = self._step_plan(dt, near is not None, alternate)
        # New counters for each call: a thread that comes late finds all done, and this call need not wait for it.
        counters = np.zeros(2 * self._bands * COUNTER_SPACING, dtype=np.int64)
        arguments: tuple[Any, ...] = (
            *(counters, x0, v0, x, _NOTHING if v is None else v, origin, steps, dt, shape, fast, once),
            # A single step is both the first and the last: its weak families count once.
            *(ends if steps > 1 else once, full, near),
        )
        kind = (near is not None, turns, alternate)
        number = self._numbers.get(kind)
        if number is None:
            key = (self._dtype.char, shape.kinds(), None if fast is None else fast.kinds(), *kind)
            number = self._numbers[kind] = _ADVANCE.number(key, (self._sheet, 0, *arguments))
        advance = _ADVANCE.entries[number]
        helpers = []
        if self._workers is not None:
            for own in range(1, self._bands):
                helpers.append(self._workers.submit(advance, self._sheet, own, *arguments))
        advance(self._sheet, 0, *arguments)
        for helper in helpers:
            helper.cancel()


_ADVANCE = Prepared(advance_sheet)
_NOWHERE = (0.0, 0.0, 0.0)
_NOTHING = np.empty((0, 0))


def _levels(rows: int, row_bytes: int, threads: int) -> int:
    """Choose how many steps one sweep over a band of `rows` rows takes; no bit depends on it.

    A band that does not fit the second cache is better taken through memory once for several steps; threads that wait
    for each other less often lose less, but move more rows twice.
    """
    wanted = 4 if rows * row_bytes > _SECOND_CACHE else min(threads, 2)
    return max(1, min(wanted, rows // (4 * REACH)))


def _near(grips: GridGrips, origin: tuple[float, float, float]) -> GridGrips:
    """The same grips with paths and poses relative to `origin`, all that is booked at zero."""
    paths = np.array(grips.paths, dtype=np.float64)
    paths[:, :, 0] -= origin
    grips.impulses[:] = 0.0
    grips.work[:] = 0.0
    turns = grips.turns
    if turns is not None:
        poses = turns.poses.copy()
        poses[:, :, :3] -= origin
        turns.booked[:] = 0.0
        turns = turns._replace(poses=poses)
    return grips._replace(
        # An entry of the compiled loop takes them as they lie.
        particles=np.ascontiguousarray(grips.particles, dtype=np.int64),
        stiffness=np.ascontiguousarray(grips.stiffness, dtype=np.float64),
        damping=np.ascontiguousarray(grips.damping, dtype=np.float64),
        paths=paths,
        turns=turns,
    )
