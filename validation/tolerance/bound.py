# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Command `tolerance`: the tolerance's error bound on random scenes.

A window of one second starts from the engine's full state. Within it, positions stay within tolerance x max(1, g) of
the exact solution under the same commands. g is the amplification of a perturbation in that window.
`compiled_reference` calculates the exact solution. A perturbation has a size of 1e-9 m or 1e-9 m/s. Its direction is
random for each particle, or smooth over the cloth. Each window has three perturbations of positions and three of
velocities; g is the largest amplification. With `--climb`, a search varies public parameters to violate the bound.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Any

from validation.case_pool import CasePool
from validation.command import above, at_least
from validation.report import Report, Table
from validation.tolerance.climb import FAMILIES as CLIMB_FAMILIES
from validation.tolerance.climb import climb_command
from validation.tolerance.random_scenes import MAX_COST, draw_scene
from validation.tolerance.windows import CALM_AMPLIFICATION, SceneEvaluation, evaluate_scene

#: Largest fraction of flagged windows among those with amplification below `CALM_AMPLIFICATION`, and largest ratio of
#: error to error bound of a flagged window.
MAX_FLAGGED_FRACTION, MAX_FLAGGED_RATIO = 0.002, 2.0
#: Smallest ratio of error to error bound of a listed window.
_LISTED_RATIO = 0.5
#: Largest number of consecutive draws beyond the cap.
_MAX_REJECTED_DRAWS = 1000

_Case = tuple[int, int, int]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    mode = parser.add_mutually_exclusive_group()
    mode.add_argument("--regimes", action="store_true", help="evaluate springs, chains and pendulums of fixed regimes")
    mode.add_argument("--violent", action="store_true", help="evaluate scenes whose grippers jump with each frame")
    mode.add_argument("--contact", action="store_true", help="evaluate sheets that fall on obstacles and on themselves")
    climb = "search for violations by climbs over families of scenes"
    mode.add_argument("--climb", action="store_true", help=climb)
    replay = "evaluate the best scene of each climb of this file (of --climb --resume FILE) again"
    mode.add_argument("--replay", type=Path, metavar="FILE", help=replay)
    only = "evaluate this scene of the seed only, window by window"
    mode.add_argument("--only", type=int, metavar="INDEX", help=only)
    parser.add_argument("--seed", type=int, default=1, help="seed of the scenes")
    count = "number of evaluated scenes (40), not counting draws beyond the cap"
    parser.add_argument("--count", type=at_least(1), default=40, help=count)
    windows = "windows of one second per scene, besides the whole run"
    parser.add_argument("--windows", type=at_least(1), default=4, help=windows)
    cap = "largest estimated cost of a scene"
    parser.add_argument("--cap", type=float, default=MAX_COST, metavar="WORK", help=cap)
    parser.add_argument("--jobs", type=at_least(1), default=len(os.sched_getaffinity(0)), help="processes")
    resume = "append each result to this file, and run only scenes without one"
    parser.add_argument("--resume", type=Path, metavar="FILE", help=resume)
    parser.add_argument("--climbs", type=at_least(1), default=200, help="number of climbs")
    parser.add_argument("--seconds", type=above(0.0), default=60.0, help="processor time of a climb [s]")
    families = f"families of scenes to climb over, in turn (all): {', '.join(CLIMB_FAMILIES)}"
    parser.add_argument("--family", nargs="+", choices=CLIMB_FAMILIES, metavar="FAMILY", help=families)
    limit = "wall time limit of a scene; a scene that takes longer fails"
    parser.add_argument("--limit", type=float, default=1800.0, metavar="SECONDS", help=limit)


def run(options: argparse.Namespace) -> Report:
    """Evaluate the selected scenes."""
    if options.regimes:
        from validation.tolerance.regimes import regimes

        return regimes(options)
    if options.climb or options.replay:
        return climb_command(options)
    if options.violent:
        from validation.tolerance.violent import violent

        return violent(options)
    return _evaluate_scenes(options)


def _evaluate_scenes(options: argparse.Namespace) -> Report:
    report = Report("Error bound with contact" if options.contact else "Error bound")
    evaluate, min_ratio, title = evaluate_case, _LISTED_RATIO, f"Windows above {_LISTED_RATIO} of the error bound"
    if options.contact:
        evaluate = _evaluate_contact_case
        cases = [(options.seed, index, options.windows) for index in range(options.count)]
    elif options.only is not None:
        cases, min_ratio, title = [(options.seed, options.only, options.windows)], 0.0, "Windows"
    else:
        cases, beyond = select_cases(options)
        report.note(f"{len(beyond)} draws beyond the cap: {_join_numbers(beyond)}")
    done = CasePool(options.jobs, options.limit, options.resume).report(
        evaluate,
        cases,
        report,
        name=lambda case: f"scene {case[1]}",
        describe=_describe,
        kinds=(_Case, SceneEvaluation),
    )
    evaluations = sorted((evaluation for _, evaluation in done), key=lambda evaluation: evaluation.index)
    rows = [_row(evaluation) for evaluation in evaluations]
    report.tables.append(Table("Error relative to tolerance x max(1, g)", _COLUMNS, rows))
    report.tables.append(Table(title, _WINDOW_COLUMNS, _window_rows(evaluations, min_ratio)))
    report.note(f"{len(evaluations)} scenes evaluated")
    _add_summary(evaluations, report)
    return report


def select_cases(options: argparse.Namespace) -> tuple[list[_Case], list[int]]:
    """Return the cases to evaluate, and the indices of draws beyond the cap."""
    cases, rejected, index, n_rejected = list[_Case](), list[int](), 0, 0
    while len(cases) < options.count:
        if draw_scene(options.seed, index).cost <= options.cap:
            cases.append((options.seed, index, options.windows))
            n_rejected = 0
        else:
            rejected.append(index)
            n_rejected += 1
            if n_rejected == _MAX_REJECTED_DRAWS:
                raise ValueError(f"{n_rejected} consecutive draws are beyond --cap {options.cap:g}; raise --cap")
        index += 1
    return cases, rejected


def evaluate_case(case: _Case) -> SceneEvaluation:
    """Evaluate a case in a worker process."""
    return evaluate_scene(*case)


def _evaluate_contact_case(case: _Case) -> SceneEvaluation:
    from validation.tolerance.contact import evaluate_contact

    return evaluate_contact(*case)


def _describe(evaluation: SceneEvaluation) -> str:
    row = dict(zip(_COLUMNS[1:], _row(evaluation)[1:], strict=True))
    return ", ".join(
        f"{name} {value:.3g}" if isinstance(value, float) else f"{name} {value}" for name, value in row.items()
    )


_COLUMNS = ["scene", "verdict", "tolerance m", "particles", "windows", "worst unflagged", "its g", "worst flagged"]
_COLUMNS += ["its g ", "whole", "flagged frames", "evaluations", "engine s", "longest s", "what"]


def _row(evaluation: SceneEvaluation) -> list[Any]:
    worst: list[Any] = []
    for flagged in (False, True):
        window = evaluation.worst(flagged=flagged)
        worst += [window.ratio, window.amplification] if window else ["-", "-"]
    whole = evaluation.whole
    whole_ratio = whole.ratio if whole and whole.is_known else "-"
    row: list[Any] = [evaluation.index, evaluation.verdict, evaluation.tolerance, evaluation.particles]
    row += [len(evaluation.windows), *worst, whole_ratio, evaluation.flagged_frames / max(1, evaluation.frames)]
    return [*row, evaluation.evaluations, evaluation.seconds, evaluation.longest_frame, evaluation.words]


_WINDOW_COLUMNS = ["scene", "from s", "length s", "error m", "tolerance m", "g from start", "g from later", "ratio"]
_WINDOW_COLUMNS += ["reference m", "flagged", "asleep", "frames", "evaluations", "reference evaluations", "binds"]


def _window_rows(evaluations: list[SceneEvaluation], min_ratio: float) -> list[list[Any]]:
    rows: list[list[Any]] = []
    for evaluation in evaluations:
        for window in [*evaluation.windows, *([evaluation.whole] if evaluation.whole else [])]:
            if not min_ratio or (window.is_known and window.ratio >= min_ratio):
                times = window.first * evaluation.period, window.frames * evaluation.period
                row: list[Any] = [evaluation.index, *times, window.error, evaluation.tolerance, window.amplification]
                row += [window.later_amplification or "-", window.ratio if window.is_known else "unknown"]
                row += [window.reference_error, window.flagged, window.asleep, window.frames, window.evaluations]
                rows.append([*row, window.reference_evaluations, window.limited_by])
    return rows


def _add_summary(evaluations: list[SceneEvaluation], report: Report) -> None:
    """Add a summary of the scenes and the violations of the error bound to the report."""
    windows = [window for evaluation in evaluations for window in evaluation.windows]
    known = [window for window in windows if window.is_known]
    unflagged = [window for window in known if not window.flagged]
    violated = [window for window in unflagged if window.ratio > 1.0]
    well_conditioned = [window for window in known if window.amplification < CALM_AMPLIFICATION]
    flagged = [window for window in well_conditioned if window.flagged]
    far_violated = [window for window in known if window.ratio > MAX_FLAGGED_RATIO]
    n_calm_violated = sum(window.amplification < CALM_AMPLIFICATION for window in far_violated)
    n_unknown = len(windows) - len(known) + sum(len(evaluation.unknown) for evaluation in evaluations)
    worst = max((window.ratio for window in known), default=0.0)
    worst_unflagged = max((window.ratio for window in unflagged), default=0.0)
    from_start = [window.ratio_from_start for window in unflagged]
    frames = sum(evaluation.frames for evaluation in evaluations)
    n_flagged_frames = sum(evaluation.flagged_frames for evaluation in evaluations)
    report.notes += [
        f"{len(known)} windows evaluated, {n_unknown} that the reference can't follow",
        f"unflagged: {len(unflagged)}, of which {len(violated)} violate the bound, the worst "
        f"{worst_unflagged:.3g} times",
        f"with perturbations at window starts only: {sum(ratio > 1.0 for ratio in from_start)} of these above it, "
        f"the worst {max(from_start, default=0.0):.3g} times",
        f"flagged: {len(known) - len(unflagged)}; among the {len(well_conditioned)} windows with g below "
        f"{CALM_AMPLIFICATION:g}: {len(flagged)}",
        f"worst of all {worst:.3g} times; above {MAX_FLAGGED_RATIO:g} times: {len(far_violated)}, "
        f"with g below {CALM_AMPLIFICATION:g}: {n_calm_violated}",
        f"{n_flagged_frames} of {frames} frames flagged ({n_flagged_frames / max(1, frames):.2%})",
    ]
    report.require(not violated, f"{len(violated)} unflagged windows violate the error bound")
    report.require(
        not far_violated, f"{len(far_violated)} windows are above {MAX_FLAGGED_RATIO:g} times the error bound"
    )
    if well_conditioned and len(flagged) > MAX_FLAGGED_FRACTION * len(well_conditioned):
        fraction = len(flagged) / len(well_conditioned)
        report.fail(f"{fraction:.2%} of windows with g below {CALM_AMPLIFICATION:g} are flagged")
    for description, listed in (
        ("that violate the error bound over the whole run", [e for e in evaluations if e.verdict == "BROKEN, whole"]),
        ("with forces that differ from the reference's", [e for e in evaluations if e.verdict == "FORCES DIFFER"]),
        ("that stopped", [e for e in evaluations if e.trouble]),
    ):
        report.require(not listed, f"scenes {description}: {_join_numbers([e.index for e in listed])}")


def _join_numbers(indices: list[int]) -> str:
    return ", ".join(str(index) for index in indices) or "none"
