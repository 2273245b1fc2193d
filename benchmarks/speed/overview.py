# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Speed of the engine: time per spring against hand-vectorised C, scene C, and the gain of a second thread.

The scene of times per spring is the square sheet of `raw_sheet`, six damped families, gravity and drag.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import numpy as np
from support.problems import PERIOD, curtain
from support.raw_sheet import RawSheet
from support.reference_kernel import ReferenceKernel, find_compiler

from benchmarks.speed import curtain as speed_curtain
from benchmarks.timing import repeated, time_interleaved
from cloth_sim_ros import Plan
from cloth_sim_ros.physics.integrators.limit import leapfrog_limit
from cloth_sim_ros.physics.model.forces.force import Array
from validation.report import Report

#: Step too short to move anything [s].
_STILL = 1e-9
#: Smallest difference in steps of the two runs whose time difference gives a step's time.
_MIN_STEPS = 40
#: Steps of the shorter one.
_FEW_STEPS = 20
#: Particles times steps in one turn of a candidate: a few milliseconds.
_UPDATES_A_TURN = 1_000_000
#: Step as a share of the stability limit in the runs whose bits are compared.
_SHARE = 0.9


#: Columns of times per spring. `C forces` is one evaluation of the C kernel, `whole step` a step of the engine without
#: the cost per run, `to C` their ratio, the median over rounds.
KERNEL_COLUMNS = ["N", "precision", "C forces", "whole step", "to C"]
#: Columns of the gain of a second thread in a frame of 1/60 s. `two sheets apart` is the gain in throughput of two
#: independent sheets on two threads over one sheet on one thread.
THREAD_COLUMNS = ["N", "precision", "steps a frame", "one thread ms", "two ms", "gain", "two sheets apart", "same bits"]


def kernel_time(resolution: int, dtype: Any, *, compiler: str | None, seconds: float) -> list[Any]:
    """Time the engine on one core, on a sheet of `resolution` x `resolution` particles; return `KERNEL_COLUMNS`."""
    sheet = RawSheet(resolution=resolution, drag=1.0)
    plan, (x, v) = sheet.plan(sheet.index[0]), _start(sheet)
    single = np.dtype(dtype) == np.float32
    steps = max(_UPDATES_A_TURN // resolution**2, _MIN_STEPS)
    lengths = {"few": _FEW_STEPS, "many": _FEW_STEPS + steps}
    candidates: dict[str, Callable[[], object]] = {
        name: steps_runner(plan, (x, v), count, single_precision=single) for name, count in lengths.items()
    }
    if compiler is not None:
        kernel = ReferenceKernel(sheet.sheet(), dtype, compiler=compiler)
        kernel.set_state(x, v)
        candidates["c"] = lambda: kernel.evaluate(steps)
    turns = time_interleaved(candidates, seconds=seconds, clock=time.thread_time)
    unit = 1e9 / (steps * len(sheet.sheet().pairs))
    whole = turns.differences("many", "few")
    step = unit * statistics.median(whole)
    c_cells: list[Any] = ["-", "-"]
    if compiler is not None:
        pairs = zip(whole, turns.seconds["c"], strict=True)
        c_cells = [unit * turns.median("c"), statistics.median(engine / c for engine, c in pairs)]
    return [resolution, np.dtype(dtype).name, c_cells[0], step, c_cells[1]]


def thread_gain(resolution: int, dtype: Any, *, seconds: float) -> list[Any]:
    """Time frames of scene C with stable steps on one thread and on two; return `THREAD_COLUMNS`.

    Each call includes the start of the second thread.
    """
    sheet = RawSheet(resolution=resolution, drag=1.0)
    plan, start = sheet.plan(sheet.index[0]), _start(sheet)
    single = np.dtype(dtype) == np.float32
    steps = int(np.ceil(PERIOD / (_SHARE * leapfrog_limit(*plan.spectral_bounds(start[0])))))
    # Enough frames per turn for some milliseconds.
    frames = max(_UPDATES_A_TURN // (steps * resolution**2), 1)

    def repeat(which: Plan, threads: int) -> Callable[[], None]:
        return repeated(steps_runner(which, start, steps, single_precision=single, threads=threads), frames)

    ends = []
    for threads in (1, 2):
        (run,), _ = plan.runs(0.0, 3 * PERIOD, start, [3 * steps], single_precision=single, threads=threads)
        ends.append((run.x.tobytes(), run.v.tobytes()))
    independent_plans = [sheet.plan(sheet.index[0]) for _ in range(2)]
    with ThreadPoolExecutor(len(independent_plans)) as pool:

        def apart() -> None:
            for done in [pool.submit(repeat(independent_plan, 1)) for independent_plan in independent_plans]:
                done.result()

        runs = {"1": repeat(plan, 1), "2": repeat(plan, 2), "apart": apart}
        turns = time_interleaved(runs, seconds=seconds)
    times = [1e3 * turns.median(name) / frames for name in ("1", "2")]
    gains = [turns.ratio("1", "2"), 2.0 * turns.ratio("1", "apart")]
    return [resolution, np.dtype(dtype).name, steps, *times, *gains, "yes" if ends[0] == ends[1] else "no"]


def steps_runner(
    plan: Plan, start: tuple[Array, Array], steps: int, *, single_precision: bool, threads: int = 1
) -> Callable[[], object]:
    """Return a function that takes a number of steps of negligible duration, which cost as much as others."""
    return partial(plan.runs, 0.0, steps * _STILL, start, [steps], single_precision=single_precision, threads=threads)


def _start(sheet: RawSheet) -> tuple[Array, Array]:
    x = np.ascontiguousarray(sheet.flat(hung=False).T)
    return x, np.zeros_like(x)


#: Largest ratio of a whole step to the forces of the C kernel.
MAX_KERNEL_RATIO = 1.0
#: Smallest real-time factor of scene C, by N, with an error of at most 1 mm.
MIN_CURTAIN_SPEEDS = {32: 25.0, 64: 8.0, 128: 1.5}
#: Smallest gain of two threads over one, and the particles a side from which it applies.
MIN_THREAD_GAIN, THREADS_FROM = 1.7, 96
#: Tolerances of scene C [m]: the loosest with an error of at most 1 mm counts. The first is the default.
TOLERANCES = (1e-3, 1e-4)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parts = ", ".join(PARTS)
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS, metavar="PART", help=f"of {parts}")
    for name, sizes, text in (
        ("--kernels", [32, 64, 96, 128, 256, 512], "sheets for ns per spring, particles a side"),
        ("--curtains", [*speed_curtain.SCORED_FRAMES], "sheets of scene C"),
        ("--threads", [64, 96, 128, 256], "sheets for two threads against one"),
    ):
        parser.add_argument(name, type=int, nargs="+", metavar="N", default=sizes, help=text)
    parser.add_argument("--seconds", type=float, default=3.0, help="of timing for each row of a table")


def run(options: argparse.Namespace) -> Report:
    """Measure the selected parts."""
    report = Report("Speed")
    for part in options.only:
        PARTS[part](options, report)
    report.note(
        "medians of candidates that take turns; ratios are medians over the rounds; ns on one core by their "
        "processor time, all else by the wall clock"
    )
    return report


def _kernels(options: argparse.Namespace, report: Report) -> None:
    compiler = find_compiler()
    if compiler is None:
        report.note("no C compiler here ($CC, cc, gcc, clang): the engine is timed without a comparison")
    table = report.add_table("Nanoseconds per spring, one core", KERNEL_COLUMNS)
    for dtype in (np.float32, np.float64):
        for resolution in options.kernels:
            row = kernel_time(resolution, dtype, compiler=compiler, seconds=options.seconds)
            table.rows.append(row)
            if compiler is not None and row[-1] > MAX_KERNEL_RATIO:
                target = f"{row[-1]:.2f} times C; target {MAX_KERNEL_RATIO:g}"
                report.fail(f"a step at N = {resolution}, {row[1]}: {target}")


def _curtains(options: argparse.Namespace, report: Report) -> None:
    columns = ["N", "tolerance m", "cores", "x real time", "least", "most", "evaluations a frame", "error m", "at s"]
    table = report.add_table("Scene C as shipped", columns)
    for resolution in options.curtains:
        scene = speed_curtain.scored(curtain, resolution)
        known = speed_curtain.trusted(scene)
        speeds = speed_curtain.curtain_speeds(scene, known, tolerances=TOLERANCES, seconds=options.seconds)
        for speed in speeds:
            row = [resolution, speed.tolerance, "one" if speed.one_core else "all", speed.factor]
            row += [min(speed.factors), max(speed.factors), speed.evaluations, speed.error, scene.duration]
            table.rows.append(row)
        report.note(f"curtain N = {resolution}: the reference's own error is {known.error:.1g} m")
        best = speed_curtain.loosest_accurate(speeds)
        min_speed = MIN_CURTAIN_SPEEDS.get(resolution, 0.0)
        if best is None:
            report.fail(f"curtain N = {resolution}: no tolerance held {speed_curtain.ACCURATE:g} m")
            continue
        report.note(f"curtain N = {resolution} at tolerance {best.tolerance:g} m: {best.reason}")
        if best.factor < min_speed:
            report.fail(f"curtain N = {resolution}: {best.factor:.3g} x real time; target {min_speed:g}")


def _threads(options: argparse.Namespace, report: Report) -> None:
    if len(os.sched_getaffinity(0)) < 2:
        report.note("one core alone is allowed here: two threads are not timed")
        return
    table = report.add_table("A frame of 1/60 s on two threads against one", THREAD_COLUMNS)
    for dtype in (np.float32, np.float64):
        for resolution in options.threads:
            row = thread_gain(resolution, dtype, seconds=options.seconds)
            table.rows.append(row)
            (gain, most, same_bits), where = row[-3:], f"two threads at N = {resolution}, {row[1]}"
            report.require(same_bits == "yes", f"{where}: other bits than one thread")
            if resolution >= THREADS_FROM and gain < MIN_THREAD_GAIN:
                report.fail(f"{where}: {gain:.2f} times one; target {MIN_THREAD_GAIN:g} (apart {most:.2f})")
    report.note(
        "two sheets apart: gain in throughput of two independent sheets on two threads over one sheet on one thread, "
        "the limit of the machine"
    )


PARTS = {"kernels": _kernels, "curtain": _curtains, "threads": _threads}
