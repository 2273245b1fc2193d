# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fits of the plain model to motions of another one: scores, warnings, and intervals against held-out motions.

The motions are cut into halves at random, and both are fitted. If intervals hold, the difference of both fits lies
within its interval in 90 % of all cases. This applies to right and wrong models. Physical values lie within the
intervals of a right model alone.
"""

from __future__ import annotations

import argparse

import attrs
import numpy as np
from scipy.stats import t

from cloth_sim_ros.fit.scores import excess_misfit
from cloth_sim_ros.fit.trajectory import TrajectoryPool
from cloth_sim_ros.physics.model.forces.force import Array
from validation.reality import swing_samples as samples
from validation.reality.linear_fits import HeldOut, LinearFit, held_out, linear_fit, linearize
from validation.report import Report, print_progress

#: Level of the examined intervals.
LEVEL = 0.9
#: What the true cloth has and the fitted model lacks, by parameters of the scene.
MODELS: dict[str, dict[str, float]] = {
    "nothing": {},
    "friction of bending": {"bending.friction_moment": 5e-4, "bending.yield_curvature": 20.0},
    "strong friction of bending": {"bending.friction_moment": 2e-3, "bending.yield_curvature": 20.0},
    "air that is carried along": {"air.added_mass": 0.067},
    "drag in all directions": {"air.drag": 0.5},
}
#: Limits of the covered fraction of differences, and least number of them that the limits apply to.
MIN_COVERAGE, MAX_COVERAGE, MIN_COUNT = 0.85, 0.95, 200


@attrs.frozen(kw_only=True, eq=False)
class Halves:
    """Fits to both halves of the motions, and the errors on the second half of the first half's values."""

    first: LinearFit
    second: LinearFit
    held_out: HeldOut

    def are_consistent(self, level: float) -> Array:
        """Return, for each parameter, true if the difference lies within its interval, shape (p,)."""
        covariances = [fit.covariance for fit in (self.first, self.second)]
        variances = np.array([covariance.deviations**2 for covariance in covariances])
        freedoms = np.array([covariance.freedoms for covariance in covariances], dtype=np.float64)
        # Degrees of freedom of a sum of variances (Welch and Satterthwaite).
        together = variances.sum(axis=0) ** 2 / (variances**2 / freedoms).sum(axis=0)
        reach = t.ppf(0.5 + 0.5 * level, together) * np.sqrt(variances.sum(axis=0))
        return np.asarray(np.abs(self.first.errors - self.second.errors) <= reach)


def halves_of(n_motions: int, seed: int) -> tuple[list[int], list[int]]:
    """Return the indices of a random half of the motions, and of the others."""
    order = np.random.default_rng([samples.SET, seed, 3]).permutation(n_motions)
    return sorted(order[: n_motions // 2].tolist()), sorted(order[n_motions // 2 :].tolist())


def run(options: argparse.Namespace) -> Report:
    """Fit the plain model to motions of other ones."""
    n_fits = options.linear or 10
    report = Report("Motions of a cloth that the fitted model lacks")
    columns = ["the model lacks", "held out mm", "rigid mm", "floor mm", "misfit stated", "misfit mm"]
    table = report.add_table(f"{n_fits} linear fits to half of {options.motions} motions", [*columns, "halves agree"])
    truths = report.add_table("Intervals that hold the true value", ["the model lacks", *samples.TRUTH, "all"])
    errors = report.add_table("Mean error %", ["the model lacks", *samples.TRUTH])
    plain = [samples.exact_motion(k, samples.TRUTH) for k in range(options.motions)]
    with TrajectoryPool(options.workers) as pool:
        linearized = linearize(plain, options.first, pool)
        for name, lacking in MODELS.items():
            truth = {**samples.TRUTH, **lacking}
            exact = [samples.exact_motion(k, truth) for k in range(options.motions)] if lacking else plain
            cases = []
            for seed in range(options.first, options.first + n_fits):
                inside, outside = halves_of(options.motions, seed)
                fits = [linear_fit(linearized, exact, seed, part, has_best=False) for part in (inside, outside)]
                errors_outside = held_out(linearized, exact, seed, outside, fits[0])
                cases.append(Halves(first=fits[0], second=fits[1], held_out=errors_outside))
            print_progress(f"{name}: {n_fits} fits")
            consistent = np.array([case.are_consistent(LEVEL) for case in cases])
            covered = np.array([np.abs(case.first.errors) <= case.first.reach(LEVEL) for case in cases])
            misfits = [excess_misfit(case.held_out.models, case.held_out.floors) for case in cases]
            stated = [misfit for misfit in misfits if misfit is not None]
            distances = [
                1e3 * float(np.mean([getattr(case.held_out, key) for case in cases]))
                for key in ("rms", "rigid", "floor")
            ]
            misfit = 1e3 * float(np.mean(stated)) if stated else 0.0
            agreement = f"{int(consistent.sum())} of {consistent.size}"
            table.rows.append([name, *distances, len(stated), misfit, agreement])
            truths.rows.append([name, *covered.sum(axis=0).tolist(), f"{int(covered.sum())} of {covered.size}"])
            errors.rows.append([name, *(100 * np.mean([case.first.errors for case in cases], axis=0)).tolist()])
            fraction = float(consistent.mean())
            report.require(
                consistent.size < MIN_COUNT or MIN_COVERAGE <= fraction <= MAX_COVERAGE,
                f"{name}: {100 * fraction:.0f} % of the differences of halves lie within their intervals",
            )
            worse = [case for case in cases if case.held_out.rms >= case.held_out.rigid]
            report.require(not worse, f"{name}: a rigid cloth is nearer in {len(worse)} of {n_fits} fits")
    return report
