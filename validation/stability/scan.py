# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Command `stability`: scan of stress cases, and measured step limits against predicted ones."""

from __future__ import annotations

import argparse
import itertools
import math
from collections import defaultdict
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from support.raw_sheet import RawSheet

from cloth_sim_ros import Leapfrog, Plan, State
from cloth_sim_ros.physics.model.forces.force import Array
from validation.case_pool import CasePool, CaseResult
from validation.report import Report, Table
from validation.stability.cases import Case, StabilityResult, all_cases, contact_cases, random_cases, run_case

#: Largest relative excess of a measured limit over its bound; a limit below its bound is a failure.
LARGEST_EXCESS = 0.25
STRETCHES, DAMPINGS = (1.0, 1.2, 1.5, 2.0, 3.0), (0.0, 0.2, 1.0)
#: Steps over which a perturbation must not grow, and the perturbation [m].
_STEPS, _PERTURBATION = 1500, 1e-9


def limits(report: Report) -> None:
    """Report measured limits of fixed steps at stretched states, and those that violate their bounds."""
    columns = ["stretch", "k_d0", "bound s", "found s", "found / bound"]
    table = report.add_table("Step limit of the leapfrog about stretched states", columns)
    for stretch, k_d0 in itertools.product(STRETCHES, DAMPINGS):
        plan, x = stretched_sheet(stretch, k_d0)
        bound = Leapfrog().step_limit(*plan.spectral_bounds(x))
        measured = measure_step_limit(plan, x, bound)
        table.rows.append([stretch, k_d0, bound, measured, measured / bound])
        if not 0.998 <= measured / bound <= 1.0 + LARGEST_EXCESS:
            report.fail(f"limit at stretch {stretch}, k_d0 {k_d0}: found {measured:.3g} s, bound {bound:.3g} s")


def stretched_sheet(stretch: float, k_d0: float, resolution: int = 12) -> tuple[Plan, Array]:
    """Return the plan and positions (3, n) [m] of a sheet with pinned border and every spring stretched."""
    sheet = RawSheet(resolution=resolution, k_d0=k_d0, relative_rest_length=1.0 / stretch, gravity=(0.0, 0.0, 0.0))
    index = sheet.index
    border = np.unique(np.concatenate([index[0], index[-1], index[:, 0], index[:, -1]]))
    return sheet.plan(border), State(sheet.flat(hung=False)).x


def measure_step_limit(plan: Plan, x: Array, bound: float) -> float:
    """Find the largest step [s] at which a perturbation does not grow, by bisection."""
    low, high = 0.5 * bound, 2.0 * bound
    perturbation = _PERTURBATION * np.random.default_rng(1).normal(size=x.shape) * (plan.model.inverse_masses > 0.0)
    while high / low > 1.002:
        step = math.sqrt(low * high)
        final_positions = []
        for start in (x, x + perturbation):
            (run,), _ = plan.runs(0.0, _STEPS * step, (start, np.zeros_like(x)), [_STEPS])
            final_positions.append(run.x)
        deviation = float(np.abs(final_positions[1] - final_positions[0]).max())
        low, high = (step, high) if deviation < 100.0 * _PERTURBATION else (low, step)
    return low


#: Largest energy gain of a case beyond the external work, relative to the energy turned over.
MAX_ENERGY_GAIN = 0.01
PARTS = ("scan", "limits")
#: Number of slowest cases in the report.
_N_SLOWEST = 10


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS, help="parts to run")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="run every N-th case of the scan only")
    parser.add_argument("--random", type=int, default=0, metavar="N", help="run N random cases instead of the scan")
    parser.add_argument("--contact", type=int, default=0, metavar="N", help="run N random contact stress cases instead")
    parser.add_argument("--seed", type=int, default=1, help="seed of random cases")
    parser.add_argument("--only", type=int, metavar="N", help="run the first N of these cases only")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    limit = "wall time limit of a case of the scan"
    parser.add_argument("--limit", type=float, default=60.0, metavar="SECONDS", help=limit)
    resume = "append each result to this file, and run only cases without one"
    parser.add_argument("--resume", type=Path, metavar="FILE", help=resume)


def run(options: argparse.Namespace) -> Report:
    """Run the selected parts."""
    report = Report("Stability")
    if "scan" in options.parts:
        candidates = random_cases(options.seed, options.random) if options.random else all_cases()
        if options.contact:
            candidates = contact_cases(options.seed, options.contact)
        cases = candidates[:: options.every][: options.only]
        pool = CasePool(options.workers, options.limit, options.resume)
        results = [*pool.run_missing(run_case, cases, (Case, StabilityResult))]
        _add_scan_results(report, results, len(candidates))
    if "limits" in options.parts:
        limits(report)
    return report


def _add_scan_results(report: Report, results: list[CaseResult[Case, StabilityResult]], n_all_cases: int) -> None:
    report.tables += [
        _summary(results, keys) for keys in (("sheet", "stress_case", "stepping"), ("stiffness", "damping"))
    ]
    for done in results:
        case, verdict = done.case, done.result
        if verdict is None or not verdict.finite:
            report.fail(f"{case}: {done.trouble or (verdict and verdict.trouble) or 'not finite'}")
        elif verdict.gain > MAX_ENERGY_GAIN:
            names = ", ".join(verdict.integrators)
            report.fail(f"{case} by {names}: gains {verdict.gain:.2g} of the energy turned over")
    slowest = report.add_table(
        "Slowest cases", ["sheet", "stress_case", "moduli x", "k_d0", "rate 1/s", "stepping", "wall s"]
    )
    for done in sorted(results, key=lambda done: -done.seconds)[:_N_SLOWEST]:
        slowest.rows.append([*attrs.astuple(done.case), done.seconds])
    total = sum(done.seconds for done in results)
    report.note(f"{len(results)} cases of {n_all_cases}, {total:.0f} s of wall time in all processes together")


def _summary(results: list[CaseResult[Case, StabilityResult]], keys: tuple[str, ...]) -> Table:
    columns = [*keys, "cases", "not finite", "not ended", "largest strain", "largest energy gain", "with flags"]
    table = Table(f"Scan by {', '.join(keys)}", [*columns, "mean wall s", "integrators"])
    groups: dict[tuple[Any, ...], list[CaseResult[Case, StabilityResult]]] = defaultdict(list)
    for done in results:
        groups[tuple(getattr(done.case, key) for key in keys)].append(done)
    for key in sorted(groups):
        group = groups[key]
        verdicts = [done.result for done in group if done.result is not None]
        strain = max((verdict.strain for verdict in verdicts), default=0.0)
        gain = max((verdict.gain for verdict in verdicts), default=0.0)
        n_not_finite = sum(not verdict.finite for verdict in verdicts)
        n_flagged = sum(verdict.flagged > 0 for verdict in verdicts)
        mean_time = sum(done.seconds for done in group) / len(group)
        integrators = ", ".join(sorted({name for verdict in verdicts for name in verdict.integrators}))
        row = [*key, len(group), n_not_finite, len(group) - len(verdicts), strain, gain, n_flagged]
        table.rows.append([*row, mean_time, integrators])
    return table
