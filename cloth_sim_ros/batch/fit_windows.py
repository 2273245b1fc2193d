# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fit over growing windows; each result is the next window's start.

The windows grow until all clouds are used, or the motion becomes too sensitive to the parameters.
"""

from __future__ import annotations

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.batch.fit_misfit import (
    MISFIT,
    UNSETTLED,
    UNSTEADY,
    is_misfit,
    is_rest_misfit,
    root_mean_square,
)
from cloth_sim_ros.batch.fit_parameters import FitError
from cloth_sim_ros.batch.fit_solver import (
    MOST_DIFFERENCE,
    Linear,
    Problem,
    descend,
    difference_steps,
    information,
)
from cloth_sim_ros.physics.forces.force import Array

#: Length of the first window [s]; each further window is twice as long.
FIRST = 0.25
#: Least number of clouds of a window.
LEAST_CLOUDS = 3
#: Number of starting points of the first window per parameter, and their largest ratio to the user's start.
STARTS, AROUND = 4, 5.0
#: Tolerance of the search's simulations, and tolerances from which a window's is chosen [m].
COARSE, TOLERANCES = 1e-4, (1e-5, 1e-6, 1e-7, 1e-8)
#: Largest simulation error, relative to the displacement by a difference step.
OFF = 0.05
#: Default of the largest relative standard deviation of an identified parameter.
TOLD = 0.025
#: Largest second difference of a cloud's residuals, relative to the first difference or the noise.
BENT = 0.5


@attrs.frozen(kw_only=True)
class Window:
    """Result of one window."""

    #: Number of clouds.
    clouds: int
    #: Linearization at the minimum.
    linear: Linear
    #: Standard deviation of a coordinate [m].
    sigma: float
    #: Tolerance of the simulations [m].
    tolerance: float


@attrs.frozen(kw_only=True)
class Windows:
    """Results of all windows; the last one is the fit's result."""

    done: tuple[Window, ...]
    #: Reason why later clouds were not used; empty if all were used.
    reason: str = ""
    #: Reason why no parameter counts as identified, and the remedy; empty if the bounds are valid.
    doubt: str = ""


def solve(problem: Problem, seconds: NDArray[np.float64]) -> Windows:
    """Fit window after window.

    Args:
        problem: the least-squares problem.
        seconds: time of each cloud [s], ascending, shape (clouds,).

    Raises:
        FitError: if the motion can't be simulated with the starting values or near them.
    """
    ends = _ends(problem, seconds)
    theta = _search(problem, ends[0])
    steps = np.full(len(theta), MOST_DIFFERENCE)
    done: list[Window] = []
    index = 0
    while True:
        clouds = ends[index]
        tolerance = done[-1].tolerance if done else TOLERANCES[0]
        linear, tolerance = _sure(problem, problem.linear(theta, steps, clouds, tolerance), clouds, tolerance)
        bent = clouds if not done else _straight(problem, linear, done[-1].sigma)
        reason = ""
        if bent < clouds:
            if bent <= done[-1].clouds * 1.1:
                misfit = is_rest_misfit(linear, problem.offsets, bent, _noise(done))
                doubt = MISFIT if misfit else UNSTEADY if len(done) == 1 else _unsettled(done)
                return Windows(done=tuple(done), reason=_bent_words(seconds, bent), doubt=doubt)
            clouds, linear = bent, linear.first(int(problem.offsets[bent]))
        linear = descend(problem, linear, clouds, tolerance)
        sigma = problem.deviation(linear.r)
        if done and is_misfit(linear.r, done[-1].linear.r.size, _noise(done)):
            rms = root_mean_square(linear.r)
            return Windows(done=tuple(done), reason=_worse_words(seconds, clouds, rms, done[-1]), doubt=MISFIT)
        done.append(Window(clouds=clouds, linear=linear, sigma=sigma, tolerance=tolerance))
        theta, steps = linear.theta, difference_steps(information(linear, sigma))
        if clouds == ends[-1]:
            return Windows(done=tuple(done), reason=reason, doubt=_unsettled(done))
        index = next(k for k, end in enumerate(ends) if end > clouds)


def _ends(problem: Problem, seconds: NDArray[np.float64]) -> list[int]:
    """Return the number of clouds of each window."""
    last, ends, length = len(seconds), list[int](), FIRST
    while not ends or ends[-1] < last:
        count = int(np.searchsorted(seconds, seconds[0] + length * (1.0 + 1e-9), side="right"))
        enough = problem.offsets[min(count, last)] > 2 * len(problem.runs.fitted)
        if (count >= LEAST_CLOUDS and enough and (not ends or count > ends[-1])) or count >= last:
            ends.append(min(count, last))
        length *= 2.0
    if int(problem.offsets[ends[-1]]) <= len(problem.runs.fitted):
        raise FitError(
            f"the clouds have {int(problem.offsets[ends[-1]])} coordinates for {len(problem.runs.fitted)} "
            "parameters; record more clouds"
        )
    return ends


def _search(problem: Problem, clouds: int) -> Array:
    """Return the best of many points near the start in the first window; the minimization starts there."""
    from scipy.stats import qmc

    start = problem.start
    count = STARTS * len(start)
    sampler = qmc.Sobol(len(start), scramble=True, rng=np.random.default_rng(0))
    cube = sampler.random_base2(int(np.ceil(np.log2(count))))[:count]
    points = [start, *(problem.within(start + (2.0 * row - 1.0) * np.log(AROUND)) for row in cube)]
    made = problem.ask(points, clouds, COARSE)
    if isinstance(made[0], str):
        raise FitError(f"the motion can't be simulated with the starting values: {made[0]}")
    costs = [np.inf if isinstance(r, str) else float(r @ r) for r in made]
    return points[int(np.argmin(costs))]


def _sure(problem: Problem, linear: Linear, clouds: int, tolerance: float) -> tuple[Linear, float]:
    """Return differences with a negligible simulation error, and the required tolerance [m].

    The simulation at the point is repeated at a tenth of the tolerance. The change must be a small fraction of the
    change by each difference step.
    """
    for finer in (t for t in TOLERANCES if t < tolerance):
        (again,) = problem.ask([linear.theta], clouds, finer)
        if isinstance(again, str):
            break
        # An unidentified parameter needs no more accuracy than one that is barely identified.
        just = problem.deviation(linear.r) / (TOLD * np.sqrt(linear.r.size))
        moved = linear.steps * np.maximum(np.sqrt(np.square(linear.jacobian).mean(axis=1)), just)
        if root_mean_square(again - linear.r) <= OFF * float(moved.min()):
            break
        tolerance = finer
        linear = problem.linear(linear.theta, linear.steps, clouds, tolerance, again)
    return linear, tolerance


def _straight(problem: Problem, linear: Linear, sigma: float) -> int:
    """Return the number of clouds before the first one whose residuals are nonlinear within a difference step."""
    offsets = problem.offsets[problem.offsets <= linear.r.size]
    starts = offsets[:-1]
    seen = np.diff(offsets)
    whole = np.flatnonzero(seen)
    squares = np.add.reduceat(np.square(linear.bend), starts[whole], axis=1)
    slopes = np.add.reduceat(np.square(linear.jacobian * linear.steps[:, None]), starts[whole], axis=1)
    bent = (squares > BENT**2 * slopes) & (squares > BENT**2 * sigma**2 * seen[whole])
    found = np.flatnonzero(bent.any(axis=0))
    return int(whole[found[0]]) if found.size else len(seen)


def _noise(done: list[Window]) -> float:
    """Return the least root mean square of a window's residuals [m], at least the simulation's tolerance."""
    return max(min(root_mean_square(window.linear.r) for window in done), done[-1].tolerance)


def _unsettled(done: list[Window]) -> str:
    return "" if done[-1].linear.settled else UNSETTLED


def _bent_words(seconds: NDArray[np.float64], cloud: int) -> str:
    return (
        f"clouds from {seconds[cloud]:.2f} s on are not used: the motion there depends on the parameters too steeply "
        "for a fit (small differences grow until the motion is unpredictable)"
    )


def _worse_words(seconds: NDArray[np.float64], clouds: int, rms: float, last: Window) -> str:
    return (
        f"clouds after {seconds[last.clouds - 1]:.2f} s are not used: up to {seconds[clouds - 1]:.2f} s the "
        f"residuals grow from {1e3 * root_mean_square(last.linear.r):.3g} to {1e3 * rms:.3g} mm, which the "
        "model does not explain"
    )
