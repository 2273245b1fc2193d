# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A fit: parameters of a cloth from clouds of it, how well they are known, and what can't be told apart."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.batch.fit_information import Tie, correlation, ties
from cloth_sim_ros.batch.fit_misfit import WORSE
from cloth_sim_ros.batch.fit_parameters import FitError, Fitted, choose
from cloth_sim_ros.batch.fit_recording import Recording, check, cloud_offsets, visible
from cloth_sim_ros.batch.fit_runs import Run, Runs, followed, residuals, shift, simulate
from cloth_sim_ros.batch.fit_solver import Problem, deviations, information
from cloth_sim_ros.batch.fit_windows import TOLD, Windows, solve

#: Standard deviations to either side of 95 % of a normal distribution.
NORMAL_95 = 1.959963984540054
#: A correlation of successive residuals above this widens the intervals.
LEAST_CORRELATION = 0.1


@attrs.frozen(kw_only=True)
class Estimate:
    """What came out for one parameter."""

    parameter: Fitted
    value: float
    #: Relative standard deviation, of its logarithm: the Cramér-Rao bound, widened where residuals are correlated;
    #: infinite where the clouds tell nothing.
    bound: float
    #: Whether the bound is within what was asked for, and nothing speaks against it.
    told: bool
    #: Whether it came to lie at the end of the range that was searched.
    at_end: bool = False
    #: Whether the simulated cloth follows the recording as far as the bound takes for granted; see `Fit.doubt`.
    followed: bool = True

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % interval, in the parameter's unit."""
        reach = min(NORMAL_95 * self.bound, 700.0)
        return self.value * math.exp(-reach), self.value * math.exp(min(reach, 600.0))


@attrs.frozen(eq=False, kw_only=True)
class Fit:
    """All that a fit tells."""

    name: str
    estimates: tuple[Estimate, ...]
    #: What can't be told apart, the least known first.
    ties: tuple[Tie, ...]
    #: Deviation of a measured coordinate [m]: as given, or that of the residuals.
    sigma: float
    sigma_given: bool
    #: Deviation of the residuals [m].
    rms: float
    #: Correlation of a particle's residuals in one cloud and the next.
    correlation: float
    #: Clouds that were used and that there are, and until when the former reach [s].
    clouds: int
    all_clouds: int
    until: float
    #: Share of particles of those clouds that were not seen; None where clouds are bare points.
    missing: float | None
    #: By what the clouds lie off the fitted cloth on the whole [m], 3 numbers, where that was sought too; else None.
    shift: tuple[float, ...] | None
    #: Why later clouds were not used; empty where all were.
    reason: str
    #: Why no parameter counts as identified, and the remedy; empty if nothing speaks against the bounds.
    doubt: str
    #: Simulations that were run.
    runs: int
    #: Of the last window's simulations [m].
    tolerance: float
    #: Largest relative deviation of a parameter that counts as told.
    within: float
    recording: Recording
    #: When each used cloud was taken [s], and the deviation of its residuals before and after the fit [m]; NaN
    #: where it has none.
    seconds: NDArray[np.float64]
    before: NDArray[np.float64]
    after: NDArray[np.float64]

    @property
    def values(self) -> dict[str, float]:
        """The values by full name."""
        return {estimate.parameter.name: estimate.value for estimate in self.estimates}

    @property
    def all_told(self) -> bool:
        """Whether every parameter is known as well as was asked for."""
        return all(estimate.told for estimate in self.estimates)


def fit(
    recording: Recording,
    names: Sequence[str],
    *,
    start: Mapping[str, float] | None = None,
    sigma: float | None = None,
    within: float = TOLD,
    workers: int | None = None,
    tick: Callable[[int], None] = lambda _runs: None,
) -> Fit:
    """Find parameters with which the simulated cloth comes closest to the clouds.

    Args:
        recording: commands and clouds, see `fit_recording`.
        names: of the parameters, short (`stretch`) or full (`material.stretch_modulus`).
        start: values to begin with, by name, where not the scene's.
        sigma: deviation of a measured coordinate [m]; taken from the residuals where left out.
        within: a parameter counts as told if its relative standard deviation is at most this.
        workers: processes; one a core where left out.
        tick: told how many runs have just been made.

    Raises:
        FitError: naming what can't be fitted, and the remedy.
    """
    if sigma is not None and not (math.isfinite(sigma) and sigma > 0.0):
        raise FitError(f"sigma is {sigma:g} m; the deviation of a coordinate must be above 0, e.g. 0.002")
    if not (math.isfinite(within) and 0.0 < within < 1.0):
        raise FitError(f"within is {within:g}; a relative deviation must be between 0 and 1, e.g. 0.025")
    if workers is not None and workers < 1:
        raise FitError(f"workers is {workers}; at least 1 is needed")
    fitted = choose(recording.scene, names, start)
    check(recording, [parameter.name for parameter in fitted])
    offsets = cloud_offsets(recording)
    with Runs(recording, fitted, workers=workers) as runs:
        problem = Problem(runs=runs, offsets=offsets, sigma=sigma, tick=tick)
        windows = solve(problem, recording.seconds)
        last = windows.done[-1]
        (before,) = problem.ask([problem.start], last.clouds, last.tolerance)
    return _told(problem, windows, before, within)


def _told(problem: Problem, windows: Windows, before: object, within: float) -> Fit:
    recording, last, fitted = problem.runs.recording, windows.done[-1], problem.runs.fitted
    r, offsets = last.linear.r, problem.offsets[: last.clouds + 1]
    fisher = information(last.linear, last.sigma)
    related = correlation(recording, r, last.clouds)
    wider = math.sqrt((1.0 + related) / (1.0 - related)) if related > LEAST_CORRELATION else 1.0
    bounds = wider * deviations(fisher)
    rms = float(np.sqrt(np.square(r).sum() / max(r.size - len(fitted), 1)))
    run = Run(values=tuple(np.exp(last.linear.theta).tolist()), clouds=last.clouds, tolerance=last.tolerance)
    doubt = windows.doubt or _doubt(problem, run, rms)
    estimates = []
    for parameter, theta, bound in zip(fitted, last.linear.theta.tolist(), bounds.tolist(), strict=True):
        value = math.exp(theta)
        at_end = min(abs(value / parameter.least - 1.0), abs(value / parameter.most - 1.0)) < 1e-6
        told = bound <= within and not at_end and not doubt
        estimates.append(
            Estimate(parameter=parameter, value=value, bound=bound, told=told, at_end=at_end, followed=not doubt)
        )
    seen = [int(visible(cloud).sum()) for cloud in recording.clouds[: last.clouds]]
    every = sum(len(cloud) for cloud in recording.clouds[: last.clouds])
    moved = None
    if recording.shifted:
        bare = residuals(attrs.evolve(recording, shifted=False), fitted, run)
        moved = tuple(shift(bare).tolist())
    return Fit(
        name=recording.name,
        estimates=tuple(estimates),
        ties=tuple(ties(fitted, fisher / wider**2, within)),
        sigma=last.sigma,
        sigma_given=problem.sigma is not None,
        rms=rms,
        correlation=related,
        clouds=last.clouds,
        all_clouds=len(recording.clouds),
        until=float(recording.seconds[last.clouds - 1]),
        missing=1.0 - sum(seen) / every if recording.matched else None,
        shift=moved,
        reason=windows.reason,
        doubt=doubt,
        runs=problem.runs.made,
        tolerance=last.tolerance,
        within=within,
        recording=recording,
        seconds=recording.seconds[: last.clouds],
        before=_by_cloud(before, offsets) if isinstance(before, np.ndarray) else np.full(last.clouds, np.nan),
        after=_by_cloud(r, offsets),
    )


def _doubt(problem: Problem, run: Run, rms: float) -> str:
    """Reason to doubt the bounds of a fit whose last window was followed to its end; empty if there is none."""
    if problem.sigma is not None and rms > WORSE * problem.sigma:
        return (
            f"the residuals are {rms / problem.sigma:.1f} times the deviation that --sigma gives: the model does not "
            "explain these clouds, and the bounds are too small. Leave --sigma out, or give what the scene lacks"
        )
    _, missed = followed(problem.runs.recording, problem.runs.fitted, run)
    if missed:
        return (
            f"the simulation missed its tolerance of {run.tolerance:g} m in {missed} frames, because they took more "
            "work than is allowed: the bounds hold for no exact motion. Take fewer particles, or end before the "
            "violent part by --until"
        )
    return ""


def _by_cloud(r: NDArray[np.float64], offsets: NDArray[np.int64]) -> NDArray[np.float64]:
    """Deviation of each cloud's residuals [m]; NaN where it has none."""
    sums = np.concatenate([[0.0], np.cumsum(np.square(r))])[offsets]
    counts = np.diff(offsets)
    return np.where(counts > 0, np.sqrt(np.maximum(np.diff(sums), 0.0) / np.maximum(counts, 1)), np.nan)


def path_of(fit: Fit) -> NDArray[np.float64]:
    """Return where the fitted cloth's particles were when each used cloud was taken [m], (clouds, particles, 3)."""
    fitted = [estimate.parameter for estimate in fit.estimates]
    run = Run(values=tuple(fit.values.values()), clouds=fit.clouds, tolerance=fit.tolerance)
    return simulate(fit.recording, fitted, run)
