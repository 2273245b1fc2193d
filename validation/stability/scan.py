# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Command `stability`: scan of stress cases, measured step limits and peer cases."""

from __future__ import annotations

import argparse
from collections import defaultdict
from pathlib import Path
from typing import Any

import attrs

from validation.case_pool import CasePool, CaseResult
from validation.report import Report, Table
from validation.stability.cases import Case, StabilityResult, all_cases, contact_cases, random_cases, run_case
from validation.stability.limits import limits

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
        table, failures = limits()
        report.tables.append(table)
        report.failures += failures
    return report


def _add_scan_results(report: Report, results: list[CaseResult[Case, StabilityResult]], n_all_cases: int) -> None:
    report.tables += [
        _summary(results, ("sheet", "stress_case", "stepping")),
        _summary(results, ("stiffness", "damping")),
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
