# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Time per particle and step, and memory, from 10^3 to 10^6 particles."""

from __future__ import annotations

import argparse
import json
from typing import Any

from validation.command import at_least, run_module
from validation.report import Report, Table

#: Largest ratio of the time per particle and step to that of a sheet of about 10^4 particles.
MAX_TIME_RATIO = 2.0
#: Largest ratio of memory to the sum of state, one set of forces and the scene's tables.
MAX_MEMORY_RATIO = 2.0
#: Particles a side: 10^3 to 10^6.
SIZES = (32, 64, 100, 180, 320, 560, 1000)
_LARGE = 100_000
KINDS = ("grid", "mesh")
_MEGA = 1e6


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS, help="of sheets")
    parser.add_argument("--sizes", type=int, nargs="+", default=[*SIZES], metavar="N", help="particles a side")
    parser.add_argument("--seconds", type=float, default=3.0, help="timing of each sheet [s]")
    parser.add_argument("--rounds", type=at_least(1), default=2, help="processes for each sheet; the fastest counts")


def run(options: argparse.Namespace) -> Report:
    """Measure all sheets, each in separate processes."""
    report = Report("From a thousand particles to a million")
    columns = ["sheet", "particles", "build s", "frame ms", "ns a particle and step", "to 10^4"]
    times = Table("Time", columns)
    columns = ["sheet", "particles", "most while built", "most while run", "state", "forces", "tables"]
    columns.append("run to their sum")
    memory = Table("Memory, MB", columns)
    for kind in options.kinds:
        sheets = _sheets(kind, options, report)
        if not sheets:
            continue
        reference = min(sheets, key=lambda sheet: abs(sheet["particles"] - 1e4))
        for sheet in sheets:
            ratio = sheet["ns"] / reference["ns"]
            row = [kind, sheet["particles"], sheet["build_s"], 1e3 * sheet["frame_s"], sheet["ns"], ratio]
            times.rows.append(row)
            sizes = [sheet[f"{quantity}_bytes"] for quantity in ("build_peak", "peak", "state", "force", "table")]
            share = sizes[1] / sum(sizes[2:])
            memory.rows.append([kind, sheet["particles"], *(size / _MEGA for size in sizes), share])
            if sheet["particles"] >= _LARGE and ratio > MAX_TIME_RATIO:
                report.fail(f"{kind} of {sheet['particles']}: {ratio:.2f} times the time of 10^4")
            if sheet["particles"] >= _LARGE and share > MAX_MEMORY_RATIO:
                report.fail(f"{kind} of {sheet['particles']}: {share:.2f} times the memory of what it must hold")
    report.tables += [times, memory]
    report.note("each sheet in separate processes, sizes in turns; shortest median frame of several")
    report.note("memory beyond that of a process that has run a sheet of 3136 particles of the same kind")
    return report


def _sheets(kind: str, options: argparse.Namespace, report: Report) -> list[dict[str, Any]]:
    best: dict[int, dict[str, Any]] = {}
    for _ in range(options.rounds):
        for size in options.sizes:
            done = run_module("benchmarks.scale.sheet", kind, str(size), str(options.seconds))
            if done.returncode:
                last = (done.stderr.strip().splitlines() or [f"status {done.returncode}"])[-1]
                report.fail(f"{kind}, {size} a side, could not be run: {last}")
                continue
            figures = json.loads(done.stdout.splitlines()[-1])
            best[size] = min(figures, best.get(size, figures), key=lambda sheet: sheet["ns"])
    return [best[size] for size in sorted(best)]
