# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Speed of the engine: time per spring against hand-vectorised C, scene C, and the gain of a second thread."""

from __future__ import annotations

import argparse
import os

import numpy as np
from support.problems import curtain
from support.reference_kernel import find_compiler

from benchmarks.speed import curtain as speed_curtain
from benchmarks.speed.kernels import kernel_time, thread_gain
from validation.report import Report

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
    report = Report("Speed", "python -m benchmarks speed")
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
    columns = ["N", "precision", "C forces", "whole step", "to C", "accelerations by themselves"]
    table = report.add_table("Nanoseconds per spring, one core", columns)
    for dtype in (np.float32, np.float64):
        for resolution in options.kernels:
            row = kernel_time(resolution, dtype, compiler=compiler, seconds=options.seconds)
            known = ["-", row.step, "-"] if row.c is None else [row.c, row.step, row.ratio]
            alone = "-" if row.accelerations is None else row.accelerations
            table.rows.append([resolution, row.precision, *known, alone])
            if row.ratio is not None and row.ratio > MAX_KERNEL_RATIO:
                target = f"target {MAX_KERNEL_RATIO:g}"
                report.fail(f"a step at N = {resolution}, {row.precision}: {row.ratio:.2f} times C; {target}")


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
    columns = ["N", "precision", "steps a frame", "one thread ms", "two ms", "gain", "two sheets apart", "same bits"]
    table = report.add_table("A frame of 1/60 s on two threads against one", columns)
    for dtype in (np.float32, np.float64):
        for resolution in options.threads:
            row = thread_gain(resolution, dtype, seconds=options.seconds)
            cells = [resolution, row.precision, row.steps, 1e3 * row.one_thread, 1e3 * row.two_threads]
            table.rows.append([*cells, row.gain, row.most, "yes" if row.same_bits else "no"])
            where = f"two threads at N = {resolution}, {row.precision}"
            report.require(row.same_bits, f"{where}: other bits than one thread")
            if resolution >= THREADS_FROM and row.gain < MIN_THREAD_GAIN:
                report.fail(f"{where}: {row.gain:.2f} times one; target {MIN_THREAD_GAIN:g} (apart {row.most:.2f})")
    report.note(
        "two sheets apart: gain in throughput of two independent sheets on two threads over one sheet on one thread, "
        "the limit of the machine"
    )


PARTS = {"kernels": _kernels, "curtain": _curtains, "threads": _threads}
