# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Command `tolerance`: the tolerance's error bound on random scenes.

A window of one second starts from the engine's full state. Within it, positions stay within tolerance x max(1, g) of
the exact solution under the same commands. g is the amplification of a perturbation in that window.
`compiled_reference` calculates the exact solution. A perturbation has a size of 1e-9 m or 1e-9 m/s. Its direction is
random for each particle, or smooth over the cloth. Each window has three perturbations of positions and three of
velocities; g is the largest amplification.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from validation.case_pool import Done, run_missing, shown
from validation.report import Report, Table
from validation.tolerance.random_scenes import CAP, draw
from validation.tolerance.windows import CALM, Judgement, Window, judge

#: Largest fraction of flagged windows among those with amplification below `CALM_AMPLIFICATION`, and largest ratio of
#: error to error bound of a flagged window.
MOST_FLAGGED, MOST_MISSED = 0.002, 2.0
#: Smallest ratio of error to error bound of a listed window.
_LISTED = 0.5
#: Largest number of consecutive draws beyond the cap.
_PATIENCE = 1000

_Case = tuple[int, int, int]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--regimes", action="store_true", help="evaluate springs, chains and pendulums of fixed regimes")
    what.add_argument("--violent", action="store_true", help="evaluate scenes whose grippers jump with each frame")
    what.add_argument("--contact", action="store_true", help="evaluate sheets that fall on obstacles and on themselves")
    what.add_argument(
        "--only", type=int, metavar="INDEX", help="evaluate this scene of the seed only, window by window"
    )
    parser.add_argument("--seed", type=int, default=1, help="seed of the scenes (1)")
    parser.add_argument(
        "--count", type=int, default=40, help="number of evaluated scenes (40), not counting draws beyond the cap"
    )
    parser.add_argument(
        "--windows", type=int, default=4, help="windows of one second per scene, besides the whole run (4)"
    )
    parser.add_argument(
        "--cap", type=float, default=CAP, metavar="WORK", help=f"largest estimated cost of a scene ({CAP:g})"
    )
    parser.add_argument("--jobs", type=int, default=len(os.sched_getaffinity(0)), help="processes (one per core)")
    parser.add_argument(
        "--resume", type=Path, metavar="FILE", help="append each result to this file, and run only scenes without one"
    )
    parser.add_argument(
        "--limit",
        type=float,
        default=1800.0,
        metavar="SECONDS",
        help="wall time limit of a scene; a scene that takes longer fails",
    )


def run(options: argparse.Namespace) -> Report:
    """Evaluate the selected scenes."""
    if options.count < 1 or options.windows < 1 or options.jobs < 1:
        raise ValueError("--count, --windows and --jobs must be at least 1")
    if options.regimes:
        from validation.tolerance.regimes import regimes

        return regimes(options)
    if options.violent:
        from validation.tolerance.violent import violent

        return violent(options)
    if options.contact:
        return _contact(options)
    if options.only is not None:
        return _one(options)
    return _many(options)


def _one(options: argparse.Namespace) -> Report:
    judgement = judge(options.seed, options.only, options.windows)
    report = Report("Error bound", f"python -m validation tolerance --seed {options.seed} --only {options.only}")
    report.tables.append(_scenes([judgement]))
    table = _windows("Windows", [judgement], least=0.0)
    report.tables.append(table)
    report.notes += [
        f"flagged or most expensive frame of the window at {w.first}: {w.reason}" for w in judgement.windows
    ]
    report.notes += judgement.unknown
    _count([judgement], report)
    return report


def _contact(options: argparse.Namespace) -> Report:
    command = f"python -m validation tolerance --contact --seed {options.seed} --count {options.count}"
    cases = [(options.seed, index, options.windows) for index in range(options.count)]
    report = Report("Error bound with contact", command)
    _judge_all(_judge_contact, cases, options, report)
    return report


def _many(options: argparse.Namespace) -> Report:
    cases, beyond = drawn(options)
    report = Report("Error bound", f"python -m validation tolerance --seed {options.seed} --count {options.count}")
    report.notes.append(f"{len(beyond)} draws beyond the cap: {_listed(beyond)}")
    _judge_all(_judge, cases, options, report)
    return report


def _judge_all(
    judged_by: Callable[[_Case], Judgement], cases: list[_Case], options: argparse.Namespace, report: Report
) -> None:
    judged: list[Judgement] = []
    for done in progress(cases, options, judged_by):
        if done.result is None:
            report.failures.append(f"scene {done.case[1]}: {done.trouble}")
            continue
        judged.append(done.result)
    judged.sort(key=lambda judgement: judgement.index)
    report.tables += [_scenes(judged), _windows(f"Windows above {_LISTED} of the error bound", judged, least=_LISTED)]
    report.notes.append(f"{len(judged)} scenes evaluated")
    _count(judged, report)


def drawn(options: argparse.Namespace) -> tuple[list[_Case], list[int]]:
    """Return the cases to evaluate, and the indices of draws beyond the cap."""
    cases, beyond, index, since = list[_Case](), list[int](), 0, 0
    while len(cases) < options.count:
        if draw(options.seed, index).cost <= options.cap:
            cases.append((options.seed, index, options.windows))
            since = 0
        else:
            beyond.append(index)
            since += 1
            if since == _PATIENCE:
                raise ValueError(f"{since} consecutive draws are beyond --cap {options.cap:g}; raise --cap")
        index += 1
    return cases, beyond


def progress(cases: list[_Case], options: argparse.Namespace, judged_by: Callable[[_Case], Judgement]) -> Any:
    """Yield the result of each scene as it ends, and print it beside a progress bar."""
    from tqdm import tqdm

    limits = {"workers": options.jobs, "limit": options.limit}
    found = run_missing(judged_by, cases, **limits, file=options.resume, read=_read)
    for done in shown(found, len(cases), "scene"):
        tqdm.write(_line(done))
        yield done


def _read(entry: dict[str, Any]) -> Done[_Case, Judgement]:
    seed, index, windows = entry["case"]
    result = entry["result"]
    if result is not None:
        result["windows"] = tuple(Window(**window) for window in result["windows"])
        result["whole"] = result["whole"] and Window(**result["whole"])
        result["unknown"] = tuple(result["unknown"])
    return Done((seed, index, windows), result and Judgement(**result), entry["seconds"], entry["trouble"])


def _judge(case: _Case) -> Judgement:
    return judge(*case)


def _judge_contact(case: _Case) -> Judgement:
    from validation.tolerance.contact import judge_contact

    return judge_contact(*case)


def _line(done: Done[_Case, Judgement]) -> str:
    if done.result is None:
        return f"{done.case[1]:4d} {done.trouble}"
    row = dict(zip(_COLUMNS, _row(done.result), strict=True))
    return ", ".join(
        f"{name} {value:.3g}" if isinstance(value, float) else f"{name} {value}" for name, value in row.items()
    )


_COLUMNS = [
    "scene",
    "verdict",
    "tolerance m",
    "particles",
    "windows",
    "worst unflagged",
    "its g",
    "worst flagged",
    "its g ",
    "whole",
    "flagged frames",
    "evaluations",
    "engine s",
    "longest s",
    "what",
]


def _row(judgement: Judgement) -> list[Any]:
    worst: list[Any] = []
    for flagged in (False, True):
        window = judgement.worst(flagged=flagged)
        worst += [window.ratio, window.growth] if window else ["-", "-"]
    whole = judgement.whole
    return [
        judgement.index,
        judgement.verdict,
        judgement.tolerance,
        judgement.particles,
        len(judgement.windows),
        *worst,
        whole.ratio if whole and whole.known else "-",
        judgement.flagged_frames / max(1, judgement.frames),
        judgement.evaluations,
        judgement.seconds,
        judgement.longest_frame,
        judgement.words,
    ]


def _scenes(judged: list[Judgement]) -> Table:
    return Table("Error relative to tolerance x max(1, g)", _COLUMNS, [_row(judgement) for judgement in judged])


def _windows(name: str, judged: list[Judgement], *, least: float) -> Table:
    columns = [
        "scene",
        "from s",
        "length s",
        "error m",
        "tolerance m",
        "g from start",
        "g from later",
        "ratio",
        "reference m",
        "flagged",
        "asleep",
    ]
    table = Table(name, [*columns, "frames", "evaluations", "reference evaluations", "binds"])
    for judgement in judged:
        whole = [judgement.whole] if judgement.whole else []
        for window in [*judgement.windows, *whole]:
            if not least or (window.known and window.ratio >= least):
                table.rows.append(_window_row(judgement, window))
    return table


def _window_row(judgement: Judgement, window: Window) -> list[Any]:
    return [
        judgement.index,
        window.first * judgement.period,
        window.frames * judgement.period,
        window.error,
        judgement.tolerance,
        window.growth,
        window.later or "-",
        window.ratio if window.known else "unknown",
        window.reference_error,
        window.flagged,
        window.asleep,
        window.frames,
        window.evaluations,
        window.reference_evaluations,
        window.binds,
    ]


def _count(judged: list[Judgement], report: Report) -> None:
    """Add a summary of the scenes and the violations of the error bound to the report."""
    every = [window for judgement in judged for window in judgement.windows]
    known = [window for window in every if window.known]
    unflagged = [window for window in known if not window.flagged]
    broken = [window for window in unflagged if window.ratio > 1.0]
    calm = [window for window in known if window.growth < CALM]
    flagged = [window for window in calm if window.flagged]
    missed = [window for window in known if window.ratio > MOST_MISSED]
    lost = len(every) - len(known) + sum(len(judgement.unknown) for judgement in judged)
    worst = max((window.ratio for window in known), default=0.0)
    worst_unflagged = max((window.ratio for window in unflagged), default=0.0)
    from_start = [window.from_start for window in unflagged]
    frames = sum(judgement.frames for judgement in judged)
    flags = sum(judgement.flagged_frames for judgement in judged)
    report.notes += [
        f"{len(known)} windows evaluated, {lost} that the reference can't follow",
        f"unflagged: {len(unflagged)}, of which {len(broken)} violate the bound, the worst {worst_unflagged:.3g} times",
        f"with perturbations at window starts only: {sum(ratio > 1.0 for ratio in from_start)} of these above it, "
        f"the worst {max(from_start, default=0.0):.3g} times",
        f"flagged: {len(known) - len(unflagged)}; among the {len(calm)} windows with g below {CALM:g}: {len(flagged)}",
        f"worst of all {worst:.3g} times; above {MOST_MISSED:g} times: {len(missed)}, "
        f"with g below {CALM:g}: "
        f"{sum(window.growth < CALM for window in missed)}",
        f"{flags} of {frames} frames flagged ({flags / max(1, frames):.2%})",
    ]
    if broken:
        report.failures.append(f"{len(broken)} unflagged windows violate the error bound")
    if missed:
        report.failures.append(f"{len(missed)} windows are above {MOST_MISSED:g} times the error bound")
    if calm and len(flagged) > MOST_FLAGGED * len(calm):
        report.failures.append(f"{len(flagged) / len(calm):.2%} of windows with g below {CALM:g} are flagged")
    whole = [j.index for j in judged if j.verdict == "BROKEN, whole"]
    for what, found in (
        ("that violate the error bound over the whole run", whole),
        ("with forces that differ from the reference's", [j.index for j in judged if j.verdict == "FORCES DIFFER"]),
        ("that stopped", [j.index for j in judged if j.trouble]),
    ):
        if found:
            report.failures.append(f"scenes {what}: {_listed(found)}")


def _listed(numbers: list[int]) -> str:
    return ", ".join(str(number) for number in numbers) or "none"
