# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Time of the grid kernels against the C kernel, in one run: `python -m cloth_sim_ros.bench.kernel_speed`.

Scene: the square sheet of `raw_sheet`, six damped families, gravity and drag. All candidates take turns, and each
counts by its shortest turn, so that what else the machine does falls on all alike.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from cloth_sim_ros.bench.raw_sheet import GRAVITY, RawSheet
from cloth_sim_ros.bench.reference_kernel import ReferenceKernel, find_compiler
from cloth_sim_ros.physics.kernels.grid_forces import GridForces
from cloth_sim_ros.physics.kernels.grid_leapfrog import GridLeapfrog
from cloth_sim_ros.physics.kernels.grid_springs import GridSprings

_STEP = 1e-9
"""So short [s] that nothing moves, however many steps are timed."""

_FEWEST_STEPS = 40
"""So that copying the state in and out, once a call, hardly counts."""

_UPDATES_A_TURN = 1_000_000
"""Particles times steps in one turn of a candidate: a few milliseconds."""


class KernelTime(NamedTuple):
    """Nanoseconds per spring of one evaluation or step, the shortest of many; None without a C compiler.

    `c`: the C kernel, forces alone. `forces`: `GridForces`, copying the state included. `leapfrog`: a whole step of
    `GridLeapfrog`; `alternate`: with shear and bend springs at every second step; `threads`: the whole step on two
    threads.
    """

    resolution: int
    precision: str
    c: float | None
    forces: float
    leapfrog: float
    alternate: float
    threads: float


def measure(resolution: int, dtype: Any, *, seconds: float = 2.0) -> KernelTime:
    """Time the kernels on a sheet of `resolution` x `resolution` particles for about `seconds`."""
    sheet = RawSheet(resolution=resolution, drag=1.0)
    springs = GridSprings(resolution, resolution, sheet.families())
    x = np.ascontiguousarray(sheet.flat(hung=False).T)
    v = np.zeros_like(x)
    f = np.zeros_like(x)
    steps = max(_UPDATES_A_TURN // resolution**2, _FEWEST_STEPS) | 1

    def stepper(**options: Any) -> Callable[[], None]:
        inverse = np.full(resolution**2, 1.0 / sheet.mass)
        loop = GridLeapfrog(springs, inverse, gravity=GRAVITY, drag=1.0, dtype=dtype, **options)
        loop.compile()
        position, velocity = x.copy(), v.copy()
        return lambda: loop.advance(position, velocity, steps, _STEP)

    forces = GridForces(springs, dtype=dtype)

    def evaluate() -> None:
        for _ in range(steps):
            forces.add(x, v, f)

    candidates = {
        "forces": evaluate,
        "leapfrog": stepper(),
        "alternate": stepper(alternate=True),
        "threads": stepper(threads=2),
    }
    compiler = find_compiler()
    if compiler is not None:
        kernel = ReferenceKernel(springs, dtype, compiler=compiler)
        kernel.set_state(x, v)
        candidates["c"] = lambda: kernel.evaluate(steps)
    unit = 1e9 / (steps * springs.spring_count())
    shortest: dict[str, float | None] = {"c": None}
    shortest |= {name: unit * took for name, took in _take_turns(candidates, seconds).items()}
    return KernelTime(resolution, np.dtype(dtype).name, **shortest)  # type: ignore[arg-type]


def _take_turns(candidates: dict[str, Callable[[], None]], seconds: float) -> dict[str, float]:
    """Shortest time of each candidate [s]; at least three turns each, the first apart."""
    shortest = dict.fromkeys(candidates, np.inf)
    for run in candidates.values():
        run()
    end, turns = time.perf_counter() + seconds, 0
    while turns < 3 or time.perf_counter() < end:
        for name, run in candidates.items():
            start = time.perf_counter()
            run()
            shortest[name] = min(shortest[name], time.perf_counter() - start)
        turns += 1
    return shortest


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a table in Markdown."""
    parser = argparse.ArgumentParser(description="Time of the grid kernels against hand-vectorised C")
    parser.add_argument("--resolutions", type=int, nargs="+", default=[32, 64, 96, 128, 256, 512])
    parser.add_argument("--seconds", type=float, default=2.0, help="for each row of the table")
    options = parser.parse_args(arguments)
    write = sys.stdout.write
    heads = ("N", "precision", "C forces", "forces", "/ C", "leapfrog step", "weak every second", "two threads")
    write("| " + " | ".join(heads) + " |\n" + "|---" * len(heads) + "|\n")
    for dtype in (np.float32, np.float64):
        for resolution in options.resolutions:
            row = measure(resolution, dtype, seconds=options.seconds)
            c = "-" if row.c is None else f"{row.c:.2f}"
            ratio = "-" if row.c is None else f"{row.forces / row.c:.2f}"
            times = f"{row.forces:.2f} | {ratio} | {row.leapfrog:.2f} | x {row.leapfrog / row.alternate:.2f}"
            write(f"| {resolution} | {row.precision} | {c} | {times} | x {row.leapfrog / row.threads:.2f} |\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
