# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fit of a cloth's parameters to point clouds, with error bounds."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.fit.information import ConfoundedDirection, confounded_directions, correlation
from cloth_sim_ros.fit.misfit import MISFIT_RATIO
from cloth_sim_ros.fit.parameters import FitError, FitParameter, choose_parameters
from cloth_sim_ros.fit.recording import FitRecording, check_recording, residual_offsets, visible_mask
from cloth_sim_ros.fit.runs import FitRun, FitRunPool, mean_offset, residuals, simulate, simulate_with_misses
from cloth_sim_ros.fit.solver import FitProblem, fisher_information, standard_deviations
from cloth_sim_ros.fit.windows import IDENTIFIED_DEVIATION, WindowedFit, solve_windows
from cloth_sim_ros.scene.scene import Scene

#: Half width of the 95 % interval of a normal distribution [standard deviations].
NORMAL_95 = 1.959963984540054
#: Correlation of successive residuals above which the intervals are widened.
MIN_CORRELATION = 0.1


#: Least number of degrees of freedom of an identified parameter.
MIN_FREEDOM = 4.0


@attrs.frozen(kw_only=True)
class Estimate:
    """Estimated value of one parameter with its standard deviation, and the verdict on it."""

    parameter: FitParameter
    #: Fitted value, in the parameter's unit.
    value: float
    #: Relative standard deviation (of the logarithm): the Cramér-Rao bound, widened if residuals are correlated;
    #: infinite if the clouds do not depend on the parameter.
    bound: float
    #: True if the bound is at most the requested deviation, and no doubt exists.
    is_identified: bool
    #: True if the value lies at a limit of the search range.
    is_at_limit: bool = False
    #: True if the model explains the recording, as the bound assumes; see `Fit.doubt`.
    is_explained: bool = True
    #: Degrees of freedom of Student's distribution of the interval; None for the normal distribution.
    freedom: float | None = None
    #: False if too few motions allow no interval.
    has_interval: bool = True

    @property
    def has_few_motions(self) -> bool:
        """True if too few motions inform about the parameter to call it identified."""
        return self.has_interval and self.freedom is not None and self.freedom < MIN_FREEDOM

    def is_within(self, within: float) -> bool:
        """Return True if the 95 % interval is no wider than that of a normal relative deviation `within`."""
        quantile = NORMAL_95
        if self.freedom is not None:
            from scipy.stats import t

            quantile = float(t.ppf(0.975, self.freedom))
        return quantile * self.bound <= NORMAL_95 * within

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval (lower, upper) in the parameter's unit: log-normal, or log-Student with `freedom`."""
        return self.interval_at(0.95)

    def interval_at(self, level: float) -> tuple[float, float]:
        """Return the interval (lower, upper) that contains the true value with a probability `level`."""
        quantile = NORMAL_95
        if self.freedom is not None:
            from scipy.stats import t

            quantile = float(t.ppf(0.5 + 0.5 * level, self.freedom))
        elif level != 0.95:
            from scipy.stats import norm

            quantile = float(norm.ppf(0.5 + 0.5 * level))
        reach = min(quantile * self.bound, 700.0)
        return self.value * math.exp(-reach), self.value * math.exp(min(reach, 600.0))


@attrs.frozen(eq=False, kw_only=True)
class Fit:
    """Result of a fit to one recording: estimates, covariance, residuals and doubts."""

    #: Name of the recording.
    name: str
    estimates: tuple[Estimate, ...]
    #: Covariance of the estimates' logarithms, in their order, shape (n, n): bounds and correlations. Without the
    #: directions that the clouds do not determine.
    covariance: NDArray[np.float64]
    #: Confounded directions, the most uncertain first.
    confounded: tuple[ConfoundedDirection, ...]
    #: Standard deviation of a measured coordinate [m]: prescribed, or estimated from the residuals.
    sigma: float
    #: True if the caller prescribed `sigma`.
    is_sigma_prescribed: bool
    #: Standard deviation of the residuals [m].
    rms: float
    #: Correlation between a particle's residuals in successive clouds.
    correlation: float
    #: Number of used clouds, number of recorded clouds, and time of the last used cloud [s].
    n_clouds: int
    n_recorded_clouds: int
    end_time: float
    #: Fraction of the particles that the used clouds lack; None if the clouds are bare points.
    missing_fraction: float | None
    #: Common offset of the clouds from the fitted cloth [m], 3 numbers; None if it was not fitted.
    shift: tuple[float, ...] | None
    #: Reason why later clouds were not used; empty if all were used.
    reason: str
    #: Reason why no parameter counts as identified, and the remedy; empty if the bounds are valid.
    doubt: str
    #: Number of simulations.
    n_runs: int
    #: Tolerance of the last window's simulations [m].
    tolerance: float
    #: Largest relative standard deviation of an identified parameter.
    within: float
    recording: FitRecording
    #: Time of each used cloud [s], and the standard deviation of its residuals before and after the fit [m]; NaN
    #: if the cloud has no points. Shape (clouds,).
    seconds: NDArray[np.float64]
    rms_before: NDArray[np.float64]
    rms_after: NDArray[np.float64]

    @property
    def scene(self) -> Scene:
        """Scene of the recording, without the fitted values."""
        return self.recording.scene

    @property
    def values(self) -> dict[str, float]:
        """Fitted values by full name, in the parameters' units."""
        return {estimate.parameter.name: estimate.value for estimate in self.estimates}

    @property
    def all_identified(self) -> bool:
        """True if every parameter is identified."""
        return all(estimate.is_identified for estimate in self.estimates)


def fit(
    recording: FitRecording,
    names: Sequence[str],
    *,
    start: Mapping[str, float] | None = None,
    sigma: float | None = None,
    within: float = IDENTIFIED_DEVIATION,
    workers: int | None = None,
    on_progress: Callable[[int], None] = lambda _runs: None,
) -> Fit:
    """Fit parameters to one recording, simulating in worker processes; return a `Fit`. Raises FitError.

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
    parameters = choose_parameters(recording.scene, names, start)
    check_recording(recording, [parameter.name for parameter in parameters])
    offsets = residual_offsets(recording)
    with FitRunPool(recording, parameters, workers=workers) as runs:
        problem = FitProblem(pool=runs, offsets=offsets, sigma=sigma, on_progress=on_progress)
        windows = solve_windows(problem, recording.seconds)
        last = windows.windows[-1]
        (start_residuals,) = problem.evaluate([problem.start], last.n_clouds, last.tolerance)
    return _build_fit(problem, windows, start_residuals, within)


def _build_fit(problem: FitProblem, windows: WindowedFit, start_residuals: object, within: float) -> Fit:
    recording, last, parameters = problem.pool.recording, windows.windows[-1], problem.pool.parameters
    r, offsets = last.linearization.r, problem.offsets[: last.n_clouds + 1]
    fisher = fisher_information(last.linearization, last.sigma)
    residual_correlation = correlation(recording, r, last.n_clouds)
    inflation = 1.0
    if residual_correlation > MIN_CORRELATION:
        inflation = math.sqrt((1.0 + residual_correlation) / (1.0 - residual_correlation))
    bounds = inflation * standard_deviations(fisher)
    rms = float(np.sqrt(np.square(r).sum() / max(r.size - len(parameters), 1)))
    values = tuple(np.exp(last.linearization.theta).tolist())
    run = FitRun(values=values, n_clouds=last.n_clouds, tolerance=last.tolerance)
    doubt = windows.doubt or _doubt(problem, run, rms)
    estimates = []
    for parameter, theta, bound in zip(parameters, last.linearization.theta.tolist(), bounds.tolist(), strict=True):
        value = math.exp(theta)
        is_at_limit = min(abs(value / parameter.minimum - 1.0), abs(value / parameter.maximum - 1.0)) < 1e-6
        is_identified = bound <= within and not is_at_limit and not doubt
        flags = {"is_identified": is_identified, "is_at_limit": is_at_limit, "is_explained": not doubt}
        estimates.append(Estimate(parameter=parameter, value=value, bound=bound, **flags))
    n_seen = [int(visible_mask(cloud).sum()) for cloud in recording.clouds[: last.n_clouds]]
    n_points = sum(len(cloud) for cloud in recording.clouds[: last.n_clouds])
    offset = None
    if recording.has_shift:
        unshifted = residuals(attrs.evolve(recording, has_shift=False), parameters, run)
        offset = tuple(mean_offset(unshifted).tolist())
    rms_before = np.full(last.n_clouds, np.nan)
    if isinstance(start_residuals, np.ndarray):
        rms_before = _rms_by_cloud(start_residuals, offsets)
    return Fit(
        name=recording.name,
        estimates=tuple(estimates),
        covariance=np.asarray(inflation**2 * np.linalg.pinv(fisher, hermitian=True), dtype=np.float64),
        confounded=tuple(confounded_directions(parameters, fisher / inflation**2, within)),
        sigma=last.sigma,
        is_sigma_prescribed=problem.sigma is not None,
        rms=rms,
        correlation=residual_correlation,
        n_clouds=last.n_clouds,
        n_recorded_clouds=len(recording.clouds),
        end_time=float(recording.seconds[last.n_clouds - 1]),
        missing_fraction=1.0 - sum(n_seen) / n_points if recording.matched else None,
        shift=offset,
        reason=windows.reason,
        doubt=doubt,
        n_runs=problem.pool.n_runs,
        tolerance=last.tolerance,
        within=within,
        recording=recording,
        seconds=recording.seconds[: last.n_clouds],
        rms_before=rms_before,
        rms_after=_rms_by_cloud(r, offsets),
    )


def _doubt(problem: FitProblem, run: FitRun, rms: float) -> str:
    """Return a reason to distrust a fit's standard deviations, or ""; simulates the recording unless noise decides."""
    if problem.sigma is not None and rms > MISFIT_RATIO * problem.sigma:
        return (
            f"the residuals are {rms / problem.sigma:.1f} times the deviation that --sigma gives: the model does not "
            "explain these clouds, and the bounds are too small. Omit --sigma, or add the missing effect to the scene"
        )
    _, n_missed = simulate_with_misses(problem.pool.recording, problem.pool.parameters, run)
    if n_missed:
        return (
            f"the simulation missed its tolerance of {run.tolerance:g} m in {n_missed} frames, because they exceeded "
            "the work limit: the motion is inexact and the bounds are invalid. Use fewer particles, or end before the "
            "violent part by --until"
        )
    return ""


def _rms_by_cloud(r: NDArray[np.float64], offsets: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the root mean square of each cloud's residuals [m], shape (clouds,); NaN if a cloud has none."""
    sums = np.concatenate([[0.0], np.cumsum(np.square(r))])[offsets]
    counts = np.diff(offsets)
    return np.where(counts > 0, np.sqrt(np.maximum(np.diff(sums), 0.0) / np.maximum(counts, 1)), np.nan)


def fitted_positions(fit: Fit) -> NDArray[np.float64]:
    """Simulate the fitted cloth; return its positions at the used clouds [m], shape (clouds, particles, 3)."""
    parameters = [estimate.parameter for estimate in fit.estimates]
    run = FitRun(values=tuple(fit.values.values()), n_clouds=fit.n_clouds, tolerance=fit.tolerance)
    return simulate(fit.recording, parameters, run)
