# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fit over growing windows; each result is the next window's start.

The windows grow until all clouds are used, or the motion becomes too sensitive to the parameters.
"""

from __future__ import annotations

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.fit.misfit import (
    MISFIT,
    NOT_CONVERGED,
    UNCONFIRMED,
    is_misfit,
    is_remainder_misfit,
    root_mean_square,
)
from cloth_sim_ros.fit.parameters import FitError
from cloth_sim_ros.fit.solver import (
    MAX_DIFFERENCE,
    FitProblem,
    Linearization,
    difference_steps,
    fisher_information,
    minimize,
)
from cloth_sim_ros.physics.model.forces.force import Array

#: Length of the first window [s]; each further window is twice as long.
FIRST_WINDOW = 0.25
#: Least number of clouds of a window.
MIN_CLOUDS = 3
#: Number of starting points of the first window per parameter, and their largest ratio to the user's start.
STARTS_PER_PARAMETER, START_FACTOR = 4, 5.0
#: Tolerance of the search's simulations, and tolerances from which a window's is chosen [m].
SEARCH_TOLERANCE, TOLERANCES = 1e-4, (1e-5, 1e-6, 1e-7, 1e-8)
#: Largest simulation error, relative to the displacement by a difference step.
MAX_ERROR_FRACTION = 0.05
#: Default of the largest relative standard deviation of an identified parameter.
IDENTIFIED_DEVIATION = 0.025
#: Largest second difference of a cloud's residuals, relative to the first difference or the noise.
MAX_CURVATURE = 0.5


@attrs.frozen(kw_only=True)
class FitWindow:
    """Result of a fit to the first clouds: number of clouds, linearization, noise and tolerance."""

    #: Number of clouds.
    n_clouds: int
    #: Linearization at the minimum.
    linearization: Linearization
    #: Standard deviation of a coordinate [m].
    sigma: float
    #: Tolerance of the simulations [m].
    tolerance: float


@attrs.frozen(kw_only=True)
class WindowedFit:
    """Results of the fits to growing windows of clouds; the last one is the result."""

    windows: tuple[FitWindow, ...]
    #: Reason why later clouds were not used; empty if all were used.
    reason: str = ""
    #: Reason why no parameter counts as identified, and the remedy; empty if the bounds are valid.
    doubt: str = ""


def solve_windows(problem: FitProblem, seconds: NDArray[np.float64]) -> WindowedFit:
    """Fit growing windows of clouds until all are used, the motion is unpredictable, or a misfit. Raises FitError.

    Args:
        problem: the least-squares problem.
        seconds: time of each cloud [s], ascending, shape (clouds,).

    Raises:
        FitError: if the motion can't be simulated with the starting values or near them.
    """
    ends = _window_ends(problem, seconds)
    theta = _search_start(problem, ends[0])
    steps = np.full(len(theta), MAX_DIFFERENCE)
    windows: list[FitWindow] = []
    index = 0
    while True:
        n_clouds = ends[index]
        tolerance = windows[-1].tolerance if windows else TOLERANCES[0]
        linearization = problem.linearize(theta, steps, n_clouds, tolerance)
        linearization, tolerance = _ensure_accuracy(problem, linearization, n_clouds, tolerance)
        n_linear = n_clouds if not windows else _linear_range(problem, linearization, windows[-1].sigma)
        reason = ""
        if n_linear < n_clouds:
            if n_linear <= windows[-1].n_clouds * 1.1:
                misfit = is_remainder_misfit(linearization, problem.offsets, n_linear, _min_window_rms(windows))
                doubt = MISFIT if misfit else UNCONFIRMED if len(windows) == 1 else _convergence_doubt(windows)
                return WindowedFit(windows=tuple(windows), reason=_curvature_reason(seconds, n_linear), doubt=doubt)
            n_clouds, linearization = n_linear, linearization.truncate(int(problem.offsets[n_linear]))
        linearization = minimize(problem, linearization, n_clouds, tolerance)
        sigma = problem.deviation(linearization.r)
        if windows and is_misfit(linearization.r, windows[-1].linearization.r.size, _min_window_rms(windows)):
            rms = root_mean_square(linearization.r)
            reason = _misfit_reason(seconds, n_clouds, rms, windows[-1])
            return WindowedFit(windows=tuple(windows), reason=reason, doubt=MISFIT)
        windows.append(FitWindow(n_clouds=n_clouds, linearization=linearization, sigma=sigma, tolerance=tolerance))
        theta, steps = linearization.theta, difference_steps(fisher_information(linearization, sigma))
        if n_clouds == ends[-1]:
            return WindowedFit(windows=tuple(windows), reason=reason, doubt=_convergence_doubt(windows))
        index = next(k for k, end in enumerate(ends) if end > n_clouds)


def _window_ends(problem: FitProblem, seconds: NDArray[np.float64]) -> list[int]:
    """Return the number of clouds of each window; each is about twice as long as the one before."""
    last, ends, length = len(seconds), list[int](), FIRST_WINDOW
    while not ends or ends[-1] < last:
        count = int(np.searchsorted(seconds, seconds[0] + length * (1.0 + 1e-9), side="right"))
        enough = problem.offsets[min(count, last)] > 2 * len(problem.pool.parameters)
        if (count >= MIN_CLOUDS and enough and (not ends or count > ends[-1])) or count >= last:
            ends.append(min(count, last))
        length *= 2.0
    n_coordinates, n_parameters = int(problem.offsets[ends[-1]]), len(problem.pool.parameters)
    if n_coordinates <= n_parameters:
        raise FitError(f"the clouds have {n_coordinates} coordinates for {n_parameters} parameters; record more clouds")
    return ends


def _search_start(problem: FitProblem, n_clouds: int) -> Array:
    """Return the point with the least residuals of many points near the start, simulated in the first window."""
    from scipy.stats import qmc

    start = problem.start
    count = STARTS_PER_PARAMETER * len(start)
    sampler = qmc.Sobol(len(start), scramble=True, rng=np.random.default_rng(0))
    cube = sampler.random_base2(int(np.ceil(np.log2(count))))[:count]
    points = [start, *(problem.clamp(start + (2.0 * row - 1.0) * np.log(START_FACTOR)) for row in cube)]
    results = problem.evaluate(points, n_clouds, SEARCH_TOLERANCE)
    if isinstance(results[0], str):
        raise FitError(f"the motion can't be simulated with the starting values: {results[0]}")
    costs = [np.inf if isinstance(r, str) else float(r @ r) for r in results]
    return points[int(np.argmin(costs))]


def _ensure_accuracy(
    problem: FitProblem, linearization: Linearization, n_clouds: int, tolerance: float
) -> tuple[Linearization, float]:
    """Tighten the tolerance until errors are small against the changes by difference steps; linearize there.

    The simulation at the point is repeated at a tenth of the tolerance. The change must be a small fraction of the
    change by each difference step.
    """
    for tighter in (t for t in TOLERANCES if t < tolerance):
        (repeated,) = problem.evaluate([linearization.theta], n_clouds, tighter)
        if isinstance(repeated, str):
            break
        # An unidentified parameter needs no more accuracy than one that is barely identified.
        min_derivative = problem.deviation(linearization.r) / (IDENTIFIED_DEVIATION * np.sqrt(linearization.r.size))
        derivatives = np.sqrt(np.square(linearization.jacobian).mean(axis=1))
        step_changes = linearization.steps * np.maximum(derivatives, min_derivative)
        if root_mean_square(repeated - linearization.r) <= MAX_ERROR_FRACTION * float(step_changes.min()):
            break
        tolerance = tighter
        linearization = problem.linearize(linearization.theta, linearization.steps, n_clouds, tolerance, repeated)
    return linearization, tolerance


def _linear_range(problem: FitProblem, linearization: Linearization, sigma: float) -> int:
    """Return the number of clouds before the first one that is nonlinear within a parameter's difference step."""
    offsets = problem.offsets[problem.offsets <= linearization.r.size]
    starts = offsets[:-1]
    n_coordinates = np.diff(offsets)
    nonempty = np.flatnonzero(n_coordinates)
    squares = np.add.reduceat(np.square(linearization.curvature), starts[nonempty], axis=1)
    slopes = np.add.reduceat(np.square(linearization.jacobian * linearization.steps[:, None]), starts[nonempty], axis=1)
    is_curved = squares > MAX_CURVATURE**2 * slopes
    is_curved &= squares > MAX_CURVATURE**2 * sigma**2 * n_coordinates[nonempty]
    curved = np.flatnonzero(is_curved.any(axis=0))
    return int(nonempty[curved[0]]) if curved.size else len(n_coordinates)


def _min_window_rms(windows: list[FitWindow]) -> float:
    """Return the least root mean square of a window's residuals [m], at least the simulation's tolerance."""
    return max(min(root_mean_square(window.linearization.r) for window in windows), windows[-1].tolerance)


def _convergence_doubt(windows: list[FitWindow]) -> str:
    return "" if windows[-1].linearization.is_converged else NOT_CONVERGED


def _curvature_reason(seconds: NDArray[np.float64], cloud: int) -> str:
    return (
        f"clouds from {seconds[cloud]:.2f} s on are not used: the motion there depends on the parameters too steeply "
        "for a fit (small differences grow until the motion is unpredictable)"
    )


def _misfit_reason(seconds: NDArray[np.float64], n_clouds: int, rms: float, last: FitWindow) -> str:
    return (
        f"clouds after {seconds[last.n_clouds - 1]:.2f} s are not used: up to {seconds[n_clouds - 1]:.2f} s the "
        f"residuals grow from {1e3 * root_mean_square(last.linearization.r):.3g} to {1e3 * rms:.3g} mm, which the "
        "model does not explain"
    )
