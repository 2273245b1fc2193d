# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fit of a cloth's parameters to point clouds, with error bounds."""

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

#: Half width of the 95 % interval of a normal distribution [standard deviations].
NORMAL_95 = 1.959963984540054
#: Correlation of successive residuals above which the intervals are widened.
LEAST_CORRELATION = 0.1


@attrs.frozen(kw_only=True)
class Estimate:
    """Estimate of one parameter."""

    parameter: Fitted
    #: Fitted value, in the parameter's unit.
    value: float
    #: Relative standard deviation (of the logarithm): the Cramér-Rao bound, widened if residuals are correlated;
    #: infinite if the clouds do not depend on the parameter.
    bound: float
    #: True if the bound is at most the requested deviation, and no doubt exists.
    told: bool
    #: True if the value lies at a limit of the search range.
    at_end: bool = False
    #: True if the model explains the recording, as the bound assumes; see `Fit.doubt`.
    followed: bool = True

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval (lower, upper), in the parameter's unit."""
        reach = min(NORMAL_95 * self.bound, 700.0)
        return self.value * math.exp(-reach), self.value * math.exp(min(reach, 600.0))


@attrs.frozen(eq=False, kw_only=True)
class Fit:
    """Result of a fit."""

    #: Name of the recording.
    name: str
    estimates: tuple[Estimate, ...]
    #: Confounded directions, the most uncertain first.
    ties: tuple[Tie, ...]
    #: Standard deviation of a measured coordinate [m]: prescribed, or estimated from the residuals.
    sigma: float
    #: True if the caller prescribed `sigma`.
    sigma_given: bool
    #: Standard deviation of the residuals [m].
    rms: float
    #: Correlation between a particle's residuals in successive clouds.
    correlation: float
    #: Number of used clouds, number of recorded clouds, and time of the last used cloud [s].
    clouds: int
    all_clouds: int
    until: float
    #: Fraction of the particles that the used clouds lack; None if the clouds are bare points.
    missing: float | None
    #: Common offset of the clouds from the fitted cloth [m], 3 numbers; None if it was not fitted.
    shift: tuple[float, ...] | None
    #: Reason why later clouds were not used; empty if all were used.
    reason: str
    #: Reason why no parameter counts as identified, and the remedy; empty if the bounds are valid.
    doubt: str
    #: Number of simulations.
    runs: int
    #: Tolerance of the last window's simulations [m].
    tolerance: float
    #: Largest relative standard deviation of an identified parameter.
    within: float
    recording: Recording
    #: Time of each used cloud [s], and the standard deviation of its residuals before and after the fit [m]; NaN
    #: if the cloud has no points. Shape (clouds,).
    seconds: NDArray[np.float64]
    before: NDArray[np.float64]
    after: NDArray[np.float64]

    @property
    def values(self) -> dict[str, float]:
        """Fitted values by full name, in the parameters' units."""
        return {estimate.parameter.name: estimate.value for estimate in self.estimates}

    @property
    def all_told(self) -> bool:
        """True if every parameter is identified."""
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
    """Fit parameters by least squares between the simulated cloth and the clouds.

    Args:
        recording: commands and clouds, see `fit_recording`.
        names: names of the parameters, short (`stretch`) or full (`material.stretch_modulus`).
        start: starting values by name; the scene's by default.
        sigma: standard deviation of a measured coordinate [m]; estimated from the residuals by default.
        within: largest relative standard deviation of an identified parameter.
        workers: number of processes; one per core by default.
        on_progress: called with the number of simulations since the last call.

    Returns:
        Estimates, bounds, confounded directions and residuals.

    Raises:
        FitError: if the fit is impossible; the text names cause and remedy.
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
    """Return the reason to doubt the bounds of a fit that used all clouds; empty if none."""
    if problem.sigma is not None and rms > WORSE * problem.sigma:
        return (
            f"the residuals are {rms / problem.sigma:.1f} times the deviation that --sigma gives: the model does not "
            "explain these clouds, and the bounds are too small. Omit --sigma, or add the missing effect to the scene"
        )
    _, missed = followed(problem.runs.recording, problem.runs.fitted, run)
    if missed:
        return (
            f"the simulation missed its tolerance of {run.tolerance:g} m in {missed} frames, because they exceeded "
            "the work limit: the motion is inexact and the bounds are invalid. Use fewer particles, or end before the "
            "violent part by --until"
        )
    return ""


def _by_cloud(r: NDArray[np.float64], offsets: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the root mean square of each cloud's residuals [m], shape (clouds,); NaN if a cloud has none."""
    sums = np.concatenate([[0.0], np.cumsum(np.square(r))])[offsets]
    counts = np.diff(offsets)
    return np.where(counts > 0, np.sqrt(np.maximum(np.diff(sums), 0.0) / np.maximum(counts, 1)), np.nan)


def path_of(fit: Fit) -> NDArray[np.float64]:
    """Return the fitted cloth's positions at the times of the used clouds [m], shape (clouds, particles, 3)."""
    fitted = [estimate.parameter for estimate in fit.estimates]
    run = Run(values=tuple(fit.values.values()), clouds=fit.clouds, tolerance=fit.tolerance)
    return simulate(fit.recording, fitted, run)
