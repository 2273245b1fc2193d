# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fits to a synthetic copy of a recorded set of swings: errors, coverage, widths and held particles.

A complete fit searches from the middle of the ranges of the true values, within a factor of 2.8. It finds held
particles, time offset and camera pose itself.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path
from typing import Any

import numpy as np

from cloth_sim_ros.fit.real import fit_real
from cloth_sim_ros.fit.trajectory import TrajectoryPool
from validation.case_pool import read_lines
from validation.reality import swing_samples as samples
from validation.reality.linear_fits import LinearFit, linear_fit, linearize
from validation.report import Report, Table, print_progress

#: Level of the examined intervals, largest relative error of an identified parameter, and longest time of a fit [s].
LEVEL, MAX_ERROR, MAX_SECONDS = 0.9, 0.05, 600.0
#: Limits of the covered fraction, least number of fits that they apply to, and largest mean ratio of the widths.
MIN_COVERAGE, MAX_COVERAGE, MIN_FITS, MAX_WIDTH_RATIO = 0.85, 0.95, 50, 1.5


def complete_fit(seed: int, n_motions: int, workers: int | None) -> dict[str, Any]:
    """Return the result of one complete fit."""
    truth, start = samples.draw_truth(seed), samples.starting_values()
    recordings = [samples.record_motion(k, samples.exact_motion(k, truth), seed) for k in range(n_motions)]
    begin, begin_processor = time.perf_counter(), _processor_time()
    fit = fit_real(recordings, samples.swing_scene(start), list(truth), workers=workers)
    seconds, processor = time.perf_counter() - begin, _processor_time() - begin_processor
    chosen = {} if fit.grasp is None else dict(fit.grasp.best.particles)
    first = fit.alignments[0]
    assert first is not None
    return {
        "seed": seed,
        "motions": n_motions,
        "set": samples.SET,
        "seconds": seconds,
        "processor_seconds": processor,
        "runs": fit.n_runs,
        "doubt": fit.doubt,
        "is_right_grasp": chosen == samples.HELD,
        "is_tie": fit.grasp is not None and fit.grasp.is_tie,
        "offset": first.offset,
        "angle": float(np.degrees(first.angle)),
        "rms": {
            name: None if entry is None else 1e3 * entry.rms
            for name, entry in (("held_out", fit.held_out), ("rigid", fit.rigid), ("floor", fit.floor))
        },
        "parameters": {
            e.parameter.name: {
                "error": e.value / truth[e.parameter.name] - 1.0,
                "bound": e.bound,
                "freedom": e.freedom,
                "identified": e.is_identified,
                "covered": e.interval_at(LEVEL)[0] <= truth[e.parameter.name] <= e.interval_at(LEVEL)[1],
            }
            for e in fit.estimates
        },
    }


def _processor_time() -> float:
    """Return the processor time of this process and of its finished ones [s]."""
    return sum(os.times()[:4])


def recorded_fits(file: Path | None, n_motions: int) -> dict[int, dict[str, Any]]:
    """Return the finished fits of a file by seed."""
    entries = read_lines(file) if file is not None and file.exists() else ()
    key = n_motions, samples.SET
    return {entry["seed"]: entry for entry in entries if (entry["motions"], entry.get("set")) == key}


def run(options: argparse.Namespace) -> Report:
    """Run complete and linear fits."""
    report = Report("Swings of a cloth with known parameters")
    if options.fits:
        _report_complete(report, options)
    if options.linear:
        _report_linear(report, options)
    return report


def _report_complete(report: Report, options: argparse.Namespace) -> None:
    fits = recorded_fits(options.record, options.motions)
    entries = []
    for seed in range(options.first, options.first + options.fits):
        if seed not in fits:
            fits[seed] = complete_fit(seed, options.motions, options.workers)
            if options.record is not None:
                with options.record.open("a") as stream:
                    stream.write(json.dumps(fits[seed]) + "\n")
        entries.append(fits[seed])
        used = fits[seed]["seconds"], fits[seed]["processor_seconds"], fits[seed]["runs"]
        print_progress(f"fit {seed}: {used[0]:.0f} s, {used[1]:.0f} s of processors, {used[2]} runs")
    columns = ["parameter", "identified", "largest error of these %", "rms error %", "mean bound %", "covered"]
    table = report.add_table(f"{len(entries)} complete fits to {options.motions} motions", columns)
    for name in samples.TRUTH:
        rows = [entry["parameters"][name] for entry in entries]
        identified = [row for row in rows if row["identified"]]
        largest = max((abs(row["error"]) for row in identified), default=float("nan"))
        errors, bounds = ([row[key] for row in rows] for key in ("error", "bound"))
        cells = [100 * largest, _rms_percent(errors), 100 * float(np.mean(bounds))]
        table.rows.append([name, len(identified), *cells, sum(row["covered"] for row in rows)])
        report.require(not largest > MAX_ERROR, f"{name} is identified with an error of {100 * largest:.1f} %")
    fit_columns = ["fit", "seconds", "processor seconds", "simulations", "right particles", "offset s", "angle deg"]
    fit_table = report.add_table("Fits", [*fit_columns, "left out one mm", "rigid mm", "floor mm", "doubt"])
    for entry in entries:
        keys = ("seed", "seconds", "processor_seconds", "runs", "is_right_grasp", "offset", "angle")
        errors = [entry["rms"][name] for name in ("held_out", "rigid", "floor")]
        fit_table.rows.append([*(entry[key] for key in keys), *errors, entry["doubt"]])
    wrong = [entry["seed"] for entry in entries if not entry["is_right_grasp"] and not entry["is_tie"]]
    report.require(not wrong, f"fits {wrong} hold wrong particles")
    longest = max(entry["seconds"] for entry in entries)
    report.require(longest <= MAX_SECONDS, f"the longest fit took {longest:.0f} s")
    covered = [row["covered"] for entry in entries for row in entry["parameters"].values()]
    _check_coverage(report, "complete", covered, len(entries))


def _report_linear(report: Report, options: argparse.Namespace) -> None:
    exact = [samples.exact_motion(k, samples.TRUTH) for k in range(options.motions)]
    with TrajectoryPool(options.workers) as pool:
        linearized = linearize(exact, options.first, pool)
        seeds = range(options.first, options.first + options.linear)
        fits = [linear_fit(linearized, exact, seed) for seed in seeds]
    report.tables.append(linear_table(fits, options.motions))
    covered = [bool(c) for fit in fits for c in np.abs(fit.errors) <= fit.reach(LEVEL)]
    _check_coverage(report, "linear", covered, len(fits))
    ratio = float(np.mean([fit.covariance.deviations / fit.best for fit in fits]))
    report.note(f"mean width of linear fits over the best possible: {ratio:.2f}")
    report.require(ratio <= MAX_WIDTH_RATIO, f"intervals are {ratio:.2f} times as wide as the best possible")


def linear_table(fits: list[LinearFit], n_motions: int) -> Table:
    """Return the table of linear fits."""
    columns = ["parameter", "rms error %", "mean bound %", "best possible %", "width over best", "covered"]
    table = Table(f"{len(fits)} linear fits to {n_motions} motions", columns)
    for i, name in enumerate(samples.TRUTH):
        errors, bounds = [fit.errors[i] for fit in fits], [fit.covariance.deviations[i] for fit in fits]
        best = [fit.best[i] for fit in fits]
        covered = sum(bool(abs(fit.errors[i]) <= fit.reach(LEVEL)[i]) for fit in fits)
        cells = [_rms_percent(errors), 100 * float(np.mean(bounds)), 100 * float(np.mean(best))]
        table.rows.append([name, *cells, float(np.mean(np.array(bounds) / np.array(best))), covered])
    return table


def _rms_percent(errors: list[float]) -> float:
    return 100 * float(np.sqrt(np.mean(np.square(errors))))


def _check_coverage(report: Report, kind: str, covered: list[bool], n_fits: int) -> None:
    fraction = float(np.mean(covered))
    report.note(f"{100 * fraction:.1f} % of {len(covered)} {100 * LEVEL:.0f} % intervals of {kind} fits hold the truth")
    if n_fits >= MIN_FITS and not MIN_COVERAGE <= fraction <= MAX_COVERAGE:
        report.fail(f"{100 * fraction:.1f} % of the intervals of {kind} fits hold the truth")
