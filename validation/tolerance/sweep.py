# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Command `tolerance-sweep`: achieved error against the requested tolerance."""

from __future__ import annotations

import argparse

import numpy as np
from support.problems import MORE_PROBLEMS, PROBLEMS, problem
from support.reference import reference
from support.reference_runs import measure

from cloth_sim_ros import Scene
from cloth_sim_ros.physics.control.automatic import INTEGRATORS
from validation.report import Report, Table

TOLERANCES = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7)
#: Smallest achieved error relative to the tolerance if accuracy limits the step.
MIN_ERROR_FRACTION = 0.01
#: Largest residual of the energy balance, relative to the energy turned over, at the default tolerance.
MAX_RESIDUAL = 1e-3


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    known = [*PROBLEMS, *MORE_PROBLEMS]
    parser.add_argument("--scenes", nargs="+", choices=known, metavar="SCENE", default=list(PROBLEMS))
    parser.add_argument("--tolerances", nargs="+", type=float, default=list(TOLERANCES), metavar="METRES")
    parser.add_argument("--integrator", choices=INTEGRATORS, default="auto")
    parser.add_argument("--energy", action="store_true", help="also close the energy balance of each run (slower)")


def run(options: argparse.Namespace) -> Report:
    """Measure the errors and compare them with the tolerances."""
    columns = ["scene", "tolerance m", "achieved m", "achieved / tolerance", "estimate / tolerance", "binds"]
    columns += ["integrator", "evaluations", "rejected", "flagged"] + (["energy residual"] if options.energy else [])
    table = Table("Achieved error", columns)
    columns = ["scene", "tolerances", "slope"]
    slopes = Table("Slope of achieved error over tolerance if accuracy limits the step", columns)
    report = Report("Tolerance held", tables=[table, slopes])
    for name in options.scenes:
        scene = problem(name)
        known = reference(scene)
        accurate = []
        for tolerance in options.tolerances:
            run_result = measure(scene, known, options.integrator, tolerance, energy=options.energy)
            error_ratio = run_result.error / tolerance
            limits_text = ", ".join(f"{bound} {count}" for bound, count in run_result.binds.most_common())
            row = [name, tolerance, run_result.error, error_ratio, run_result.estimate / tolerance, limits_text]
            row += [", ".join(run_result.integrators), run_result.evaluations, run_result.rejected, run_result.flagged]
            table.rows.append(row + ([run_result.residual] if options.energy else []))
            report.require(error_ratio <= 1.0, f"{name} at {tolerance:g} m: achieved {run_result.error:.3g} m")
            if run_result.binds["accuracy"] > 0.5 * scene.frames:
                accurate.append((tolerance, run_result.error))
                if error_ratio < MIN_ERROR_FRACTION:
                    limited = "accuracy limits the step"
                    report.fail(f"{name} at {tolerance:g} m: {limited}; error only {error_ratio:.2g} of it")
            if options.energy and tolerance <= Scene().tolerance and not run_result.residual <= MAX_RESIDUAL:
                report.fail(f"{name} at {tolerance:g} m: energy residual {run_result.residual:.2g}")
        if len(accurate) > 1:
            log_tolerances, log_errors = np.log(accurate).T
            slope = float(np.polyfit(log_tolerances, log_errors, 1)[0])
            slopes.rows.append([name, len(accurate), slope])
    return report
