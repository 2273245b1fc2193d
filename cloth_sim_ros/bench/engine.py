# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""This tree against an older commit of itself: the same scenes in turns, in one run, the same figures of both."""

from __future__ import annotations

import argparse
import contextlib
import sys
from pathlib import Path
from typing import Any

import attrs

from cloth_sim_ros.bench import engine_side, old_tree
from cloth_sim_ros.bench.engine_side import Pair, Side, in_turns, median
from cloth_sim_ros.bench.report import Plot, Report, Table
from cloth_sim_ros.engine.instruction_set import libraries

PARTS = ("step", "forces", "mesh", "bending", "carried", "curtain", "garment")
#: A published frame [s].
_FRAME = 1.0 / 60.0
#: A frame of a garment of so many vertices takes at most so many seconds, the slowest hundredth left out.
GARMENT_PROMISES = {1460: _FRAME * 2.0 / 3.0, 3000: _FRAME}
#: Python's share of the frame of the default cloth.
PYTHON_PROMISE = 0.1
#: What the carried cloth takes at most of its old time, by tolerance, and scene C by N.
CARRIED_PROMISES = {1e-3: 1.0 / 2.5, 1e-4: 1.0 / 1.6}
CURTAIN_PROMISES = {16: 1.0 / 1.5, 32: 1.0 / 1.5, 64: 1.0 / 1.15, 128: 1.0 / 1.15}
STEP_PROMISE, MESH_PROMISE, BENDING_PROMISE = 0.95, 0.8, 0.7
#: Rounds of what takes long.
_FEW = 3


@attrs.frozen(kw_only=True)
class Row:
    """One thing that both trees do."""

    part: str
    what: str
    #: Job of `engine_jobs` and its options.
    job: str
    options: dict[str, Any]
    #: Unit of the figures, and how many a second make.
    unit: str
    scale: float
    #: New over old at most; None where nothing was promised.
    promise: float | None
    #: The same with AVX-512, where the old loop took the processor's estimates of inverse roots, which are gone.
    with_avx512: float | None = None
    slow: bool = False


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parts = ", ".join(PARTS)
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS, metavar="PART", help=f"of {parts}")
    parser.add_argument("--against", default=old_tree.BEFORE_ENGINE, metavar="COMMIT", help="older tree (%(default)s)")
    parser.add_argument(
        "--cache", type=Path, default=old_tree.default_folder(), metavar="FOLDER", help="where it is kept (%(default)s)"
    )
    known = libraries()
    parser.add_argument("--engines", nargs="+", metavar="NAME", default=[n for n in known if n != "baseline"] or known)
    for name, sizes, text in (
        ("--sheets", [32, 64, 128, 256, 512], "sheets of six families, particles a side"),
        ("--meshes", [4096], "meshes in random order, particles"),
        ("--bendings", [30, 64], "grids with hinges, particles a side"),
        ("--carried", [30], "cloths that a gripper carries, particles a side"),
        ("--curtains", [16, 32, 64, 128], "sheets of scene C"),
        ("--garments", [1460, 3000], "T-shirts, vertices"),
    ):
        parser.add_argument(name, type=int, nargs="+", metavar="N", default=sizes, help=text)
    parser.add_argument("--frames", type=int, default=300, help="frames of a cloth that is carried")
    parser.add_argument("--updates", type=int, default=1_500_000, help="particles times steps that are timed at once")
    parser.add_argument("--rounds", type=int, default=9, help="turns of each tree; of what takes long three")


def run(options: argparse.Namespace) -> Report:
    """Measure what was asked for.

    Raises:
        ValueError: for an option out of range, without the older tree, or if a tree can't do its part.
    """
    for name in ("rounds", "frames", "updates"):
        if getattr(options, name) < 1:
            raise ValueError(f"--{name} is {getattr(options, name)}; it must be at least 1")
    if unknown := [name for name in options.engines if name not in libraries()]:
        raise ValueError(f"no engine {', '.join(unknown)} runs on this machine; there are {', '.join(libraries())}")
    old = old_tree.prepare(options.against, _say, folder=options.cache)
    report = Report("Against an older tree", f"cloth_bench engine --against {options.against}")
    with contextlib.ExitStack() as stack:
        # Each against the older tree on the same vectors: it takes the widest that it finds.
        narrow = {
            name: {"NUMBA_CPU_NAME": engine_side.NARROW} if name != "avx512" and "avx512" in libraries() else {}
            for name in options.engines
        }
        by_variables = {
            str(variables): Side(
                f"the tree of {options.against}", tree=old.tree, python=old.python, variables=variables
            )
            for variables in narrow.values()
        }
        for side in by_variables.values():
            stack.enter_context(side)
        olds = {name: by_variables[str(variables)] for name, variables in narrow.items()}
        sides = {
            name: stack.enter_context(Side(f"this tree on {name}", variables={"CLOTH_SIM_ROS_ENGINE": name}))
            for name in options.engines
        }
        measure(olds, sides, options, report)
    report.notes.append(
        f"old: {old.commit[:12]} with its own versions; medians of rounds in turns, new/old the median of the rounds' "
        "ratios with the least and the most; steps and forces by processor time on one core, the rest by the wall "
        "clock, with the ratio of processor times beside it"
    )
    return report


def measure(olds: dict[str, Side], sides: dict[str, Side], options: argparse.Namespace, report: Report) -> None:
    """Let the old sides and the new ones, each by the instruction set, do every row in turns."""
    first = list(dict.fromkeys(olds.values()))
    columns = ["what", "engine", "unit", "old", "new", "new/old", "least", "most", "processor", "at most"]
    table = Table("Time of this tree and of the older one", columns)
    shares = Table("Python's share of the frame of a carried cloth", ["what", "engine", "share", "at most"])
    shirts = Table(
        "A T-shirt that two grippers swing, ms a frame",
        ["vertices", "tree", "engine", "median", "p99", "p99 at most", "steps a frame"],
    )
    lines: dict[str, list[tuple[float, float]]] = {}
    for row in rows(options):
        figures = in_turns(
            [*first, *sides.values()],
            row.job,
            row.options,
            rounds=min(_FEW, options.rounds) if row.slow else options.rounds,
            say=_say,
        )
        for name, mine in zip(sides, figures[len(first) :], strict=True):
            pair = Pair(old=figures[first.index(olds[name])], new=mine)
            promise = row.with_avx512 or row.promise if name == "avx512" else row.promise
            times = [row.scale * median(pair.old), row.scale * median(pair.new)]
            ratio, ratios = pair.ratio(), pair.ratios()
            busy = pair.ratio("processor") if "processor" in mine[0] else "-"
            spread = [ratio, min(ratios), max(ratios), busy]
            table.rows.append([row.what, name, row.unit, *times, *spread, "-" if promise is None else promise])
            if promise is not None and ratio > promise:
                report.failures.append(f"{row.what}, {name}: {ratio:.3g} of the old time; at most {promise:.3g}")
            if "resolution" in row.options and row.job in ("step", "forces"):
                line = f"{row.what.partition(',')[0]}, {name}"
                lines.setdefault(line, []).append((float(row.options["resolution"]), ratio))
        if row.job == "garment":
            who = [("old", next(name for name in olds if olds[name] is side)) for side in first]
            _tell_garment(row, [*who, *(("new", name) for name in sides)], figures, shirts, report)
        if row.job == "carried":
            _tell_share(row, sides, shares, report)
    report.tables += [one for one in (table, shares, shirts) if one.rows]
    if lines:
        report.plots.append(Plot("This tree to the older one", "particles a side", "new/old", lines))


def rows(options: argparse.Namespace) -> list[Row]:
    """What was asked for, in the order of the table."""
    wanted: list[Row] = []
    for narrow in (False, True):
        for n in options.sheets:
            given = {"resolution": n, "narrow": narrow, "updates": options.updates}
            what = f"whole step {'float32' if narrow else 'float64'}, N = {n}"
            most, wide = (1.15 if n < 128 else 1.0, 1.25) if narrow else (STEP_PROMISE, None)
            row = _plain("step", what, "step", given, "ns/spring", 1e9 / springs(n), most)
            wanted.append(attrs.evolve(row, with_avx512=wide))
    for n in options.sheets:
        what, unit = f"forces alone float64, N = {n}", 1e9 / springs(n)
        wanted.append(
            _plain(
                "forces", what, "forces", {"resolution": n, "updates": options.updates}, "ns/spring", unit, STEP_PROMISE
            )
        )
    for n in options.meshes:
        what, given = f"mesh of {n} in random order, step", {"particles": n, "updates": options.updates}
        wanted.append(_plain("mesh", what, "mesh_step", given, "us", 1e6, MESH_PROMISE))
    for bending in ("altitude", "crossed"):
        for n in options.bendings:
            what = f"{bending} hinges, {n} x {n}, step"
            given = {"resolution": n, "bending": bending, "updates": options.updates}
            wanted.append(_plain("bending", what, "bending_step", given, "us", 1e6, BENDING_PROMISE))
    for n in options.carried:
        for tolerance, most in CARRIED_PROMISES.items():
            what = f"carried {n} x {n} at {tolerance:g} m, frame"
            given = {"tolerance": tolerance, "resolution": n, "warm": options.frames // 5}
            given["frames"] = options.frames
            wanted.append(_plain("carried", what, "carried", given, "ms", 1e3, most))
    for n in options.curtains:
        what = f"scene C at 0.001 m, N = {n}"
        given = {"resolution": n, "tolerance": 1e-3, "frames": 18 if n >= 128 else 30}
        limit = CURTAIN_PROMISES.get(n)
        wanted.append(_plain("curtain", what, "curtain", given, "s a simulated s", 1.0, limit, slow=n >= 64))
    for n in options.garments:
        given = {"vertices": n, "bending": "altitude", "tolerance": 1e-3}
        given |= {"warm": options.frames // 5, "frames": options.frames // 2}
        wanted.append(
            _plain("garment", f"T-shirt of {n}, altitude, frame", "garment", given, "ms", 1e3, None, slow=True)
        )
    return [row for row in wanted if row.part in options.only]


def springs(n: int) -> int:
    """Springs of a sheet of n x n particles with six families."""
    return 2 * n * (n - 1) + 2 * (n - 1) ** 2 + 2 * n * (n - 2)


def _plain(
    part: str,
    what: str,
    job: str,
    options: dict[str, Any],
    unit: str,
    scale: float,
    promise: float | None,
    *,
    slow: bool = False,
) -> Row:
    return Row(
        part=part,
        what=what,
        job=job,
        options=options,
        unit=unit,
        scale=scale,
        promise=promise,
        slow=slow,
    )


def _tell_garment(
    row: Row, who: list[tuple[str, str]], figures: list[list[dict[str, Any]]], table: Table, report: Report
) -> None:
    promise = GARMENT_PROMISES.get(row.options["vertices"])
    for (tree, engine), mine in zip(who, figures, strict=True):
        middle, slowest, steps = (median(mine, name) for name in ("seconds", "p99", "steps"))
        limit = "-" if promise is None else 1e3 * promise
        table.rows.append([int(mine[0]["vertices"]), tree, engine, 1e3 * middle, 1e3 * slowest, limit, steps])
        if tree == "new" and promise is not None and slowest > promise:
            report.failures.append(
                f"{row.what}, {engine}: p99 is {1e3 * slowest:.3g} ms; at most {1e3 * promise:.3g} ms"
            )


def _tell_share(row: Row, sides: dict[str, Side], table: Table, report: Report) -> None:
    for name, side in sides.items():
        share = median(
            [side.measure(row.job, **row.options, share=True) for _ in range(engine_side.FEWEST_ROUNDS)], "python"
        )
        side.forget()
        table.rows.append([row.what, name, share, PYTHON_PROMISE])
        if share > PYTHON_PROMISE:
            report.failures.append(f"{row.what}, {name}: Python's share is {share:.2g}; at most {PYTHON_PROMISE:g}")


def _say(text: str) -> None:
    sys.stderr.write(f"cloth_bench engine: {text}\n")
    sys.stderr.flush()
