# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Time of the grid kernels: per spring against the C kernel, and on two threads against one.

Scene: the square sheet of `raw_sheet`, six damped families, gravity and drag.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import attrs
import numpy as np

from cloth_sim_ros.bench.problems import PERIOD
from cloth_sim_ros.bench.raw_sheet import GRAVITY, RawSheet
from cloth_sim_ros.bench.reference_kernel import ReferenceKernel
from cloth_sim_ros.bench.speed_turns import Turns, take_turns
from cloth_sim_ros.physics.integrators.march import leapfrog_limit
from cloth_sim_ros.physics.kernels.grid_forces import GridForces
from cloth_sim_ros.physics.kernels.grid_leapfrog import GridLeapfrog
from cloth_sim_ros.physics.kernels.grid_springs import GridSprings
from cloth_sim_ros.physics.forces.force import Array

#: So short [s] that nothing moves, however many steps are timed.
_STILL = 1e-9
#: So that copying the state in and out, once a call, hardly counts.
_FEWEST_STEPS = 40
#: Particles times steps in one turn of a candidate: a few milliseconds.
_UPDATES_A_TURN = 1_000_000
#: Share of the longest stable step that the runs compared for their bits take.
_SHARE = 0.9


@attrs.frozen(kw_only=True)
class KernelTime:
    """Nanoseconds per spring, medians.

    `c`: one evaluation of the C kernel, forces alone; None without a C compiler. `forces`: one of `GridForces`,
    copying the state included. `ratio`: forces to C, the median over rounds. `step`: a whole step of `GridLeapfrog`;
    `alternate`: with shear and bend springs at every second step.
    """

    resolution: int
    precision: str
    c: float | None
    forces: float
    ratio: float | None
    step: float
    alternate: float


@attrs.frozen(kw_only=True)
class ThreadGain:
    """What a second thread brings to a frame of 1/60 s; `same`: whether both moved the sheet to the same bits.

    `most`: by how much more two sheets that share nothing get done on two threads than one on one.
    """

    resolution: int
    precision: str
    steps: int
    one: float
    two: float
    gain: float
    most: float
    same: bool


def kernel_time(resolution: int, dtype: Any, *, compiler: str | None, seconds: float) -> KernelTime:
    """Time the kernels on one core, on a sheet of `resolution` x `resolution` particles, for about `seconds`."""
    sheet = RawSheet(resolution=resolution, drag=1.0)
    springs = _springs(sheet)
    x, v = _start(sheet)
    f = np.zeros_like(x)
    steps = max(_UPDATES_A_TURN // resolution**2, _FEWEST_STEPS) | 1
    forces = GridForces(springs, dtype=dtype)

    def evaluate() -> None:
        for _ in range(steps):
            forces.add(x, v, f)

    def stepper(*, alternate: bool) -> Callable[[], None]:
        loop = _loop(sheet, springs, dtype)
        position, velocity = x.copy(), v.copy()
        return lambda: loop.advance(position, velocity, steps, _STILL, alternate=alternate)

    candidates = {
        "forces": evaluate,
        "step": stepper(alternate=False),
        "alternate": stepper(alternate=True),
    }
    if compiler is not None:
        kernel = ReferenceKernel(springs, dtype, compiler=compiler)
        kernel.set_state(x, v)
        candidates["c"] = lambda: kernel.evaluate(steps)
    turns = take_turns(candidates, seconds=seconds, clock=time.thread_time)
    unit = 1e9 / (steps * springs.spring_count())
    return KernelTime(
        resolution=resolution,
        precision=np.dtype(dtype).name,
        c=unit * turns.median("c") if compiler else None,
        forces=unit * turns.median("forces"),
        ratio=turns.ratio("forces", "c") if compiler else None,
        step=unit * turns.median("step"),
        alternate=unit * turns.median("alternate"),
    )


def thread_gain(resolution: int, dtype: Any, *, seconds: float) -> ThreadGain:
    """Time frames of scene C, as many steps a call as it needs there, on one thread and on two, for about `seconds`.

    Each call includes what it costs to start the second thread.
    """
    sheet = RawSheet(resolution=resolution, drag=1.0)
    springs = _springs(sheet)
    longest = _SHARE * leapfrog_limit(*sheet.dynamics(sheet.index[0]).rates(_start(sheet)[0]))
    steps = int(np.ceil(PERIOD / longest))
    # As many frames a turn as make some milliseconds.
    frames = max(_UPDATES_A_TURN // (steps * resolution**2), 1)
    loops = {count: _loop(sheet, springs, dtype, threads=count) for count in (1, 2)}

    ends = []
    for loop in loops.values():
        position, velocity = _start(sheet)
        for _ in range(3):
            loop.advance(position, velocity, steps, PERIOD / steps)
        ends.append((position.tobytes(), velocity.tobytes()))
    start = _start(sheet)
    others = [(_loop(sheet, springs, dtype, threads=1), _start(sheet)) for _ in loops]
    with ThreadPoolExecutor(len(others)) as pool:

        def apart() -> None:
            for done in [pool.submit(_repeat, *other, steps, frames) for other in others]:
                done.result()

        turns: Turns = take_turns(
            {
                "1": lambda: _repeat(loops[1], start, steps, frames),
                "2": lambda: _repeat(loops[2], start, steps, frames),
                "apart": apart,
            },
            seconds=seconds,
        )
    return ThreadGain(
        resolution=resolution,
        precision=np.dtype(dtype).name,
        steps=steps,
        one=turns.median("1") / frames,
        two=turns.median("2") / frames,
        gain=turns.ratio("1", "2"),
        most=2.0 * turns.ratio("1", "apart"),
        same=ends[0] == ends[1],
    )


def _repeat(loop: GridLeapfrog, start: tuple[Array, Array], steps: int, frames: int) -> None:
    """Frames of no length: they do all that others do, and go on from the same place."""
    for _ in range(frames):
        loop.advance(*start, steps, _STILL)


def _springs(sheet: RawSheet) -> GridSprings:
    return GridSprings(sheet.resolution, sheet.resolution, sheet.families())


def _start(sheet: RawSheet) -> tuple[Array, Array]:
    x = np.ascontiguousarray(sheet.flat(hung=False).T)
    return x, np.zeros_like(x)


def _loop(sheet: RawSheet, springs: GridSprings, dtype: Any, **options: Any) -> GridLeapfrog:
    inverse = np.full(sheet.resolution**2, 1.0 / sheet.mass)
    inverse[sheet.index[0]] = 0.0
    loop = GridLeapfrog(springs, inverse, gravity=GRAVITY, drag=sheet.drag, dtype=dtype, **options)
    loop.compile()
    return loop
