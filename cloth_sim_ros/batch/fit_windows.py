# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Windows that grow: a short one first, whose answer is the next one's start, as far as the motion can be foretold."""

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

#: Length of the first window [s]; each further one is twice as long.
FIRST = 0.25
#: Fewest clouds of a window.
LEAST_CLOUDS = 3
#: Starts that the first window is searched from, for each parameter, and how far from the user's [factor].
STARTS, AROUND = 4, 5.0
#: Simulations of the search, and of the first window, have this tolerance [m]; that of the rest is found.
COARSE, TOLERANCES = 1e-4, (1e-5, 1e-6, 1e-7, 1e-8)
#: What the simulation may be off by, of what a difference step moves the particles by.
OFF = 0.05
#: A parameter is told where its relative deviation is at most this.
TOLD = 0.025
#: A cloud is bent where the second difference is this part of the first, and of the noise.
BENT = 0.5


@attrs.frozen(kw_only=True)
class Window:
    """What one window came to."""

    clouds: int
    linear: Linear
    #: Deviation of a coordinate [m].
    sigma: float
    #: Of the simulations [m].
    tolerance: float


@attrs.frozen(kw_only=True)
class Windows:
    """What all of them came to; the last one counts."""

    done: tuple[Window, ...]
    #: Why later clouds were not used; empty where all were.
    reason: str = ""
    #: Why no parameter counts as identified, and the remedy; empty where nothing speaks against it.
    doubt: str = ""


def solve(problem: Problem, seconds: NDArray[np.float64]) -> Windows:
    """Fit window after window.

    Args:
        problem: what is fitted.
        seconds: when each cloud was taken [s], ascending.

    Raises:
        FitError: where the motion can't be simulated with the starting values, nor beside them.
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
    """How many clouds each window has."""
    last, ends, length = len(seconds), list[int](), FIRST
    while not ends or ends[-1] < last:
        count = int(np.searchsorted(seconds, seconds[0] + length * (1.0 + 1e-9), side="right"))
        enough = problem.offsets[min(count, last)] > 2 * len(problem.runs.fitted)
        if (count >= LEAST_CLOUDS and enough and (not ends or count > ends[-1])) or count >= last:
            ends.append(min(count, last))
        length *= 2.0
    if int(problem.offsets[ends[-1]]) <= len(problem.runs.fitted):
        raise FitError(
            f"{int(problem.offsets[ends[-1]])} coordinates were seen for {len(problem.runs.fitted)} parameters; "
            "more clouds are needed"
        )
    return ends


def _search(problem: Problem, clouds: int) -> Array:
    """Return the best of many points about the start in the first window: a fit goes downhill from there."""
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
    """Return differences that the simulation's own error does not spoil, and the tolerance that it takes.

    The run at the point is repeated at a tenth of the tolerance: what that changes may be a small part of what the
    difference steps change.
    """
    for finer in (t for t in TOLERANCES if t < tolerance):
        (again,) = problem.ask([linear.theta], clouds, finer)
        if isinstance(again, str):
            break
        # Of a parameter that is not told anyway, no more is asked than of one that just is.
        just = problem.deviation(linear.r) / (TOLD * np.sqrt(linear.r.size))
        moved = linear.steps * np.maximum(np.sqrt(np.square(linear.jacobian).mean(axis=1)), just)
        if root_mean_square(again - linear.r) <= OFF * float(moved.min()):
            break
        tolerance = finer
        linear = problem.linear(linear.theta, linear.steps, clouds, tolerance, again)
    return linear, tolerance


def _straight(problem: Problem, linear: Linear, sigma: float) -> int:
    """Return how many clouds there are before the first one that a difference step bends."""
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
    """The least deviation of a window's residuals [m]; none is below what the simulation may be off by."""
    return max(min(root_mean_square(window.linear.r) for window in done), done[-1].tolerance)


def _unsettled(done: list[Window]) -> str:
    return "" if done[-1].linear.settled else UNSETTLED


def _bent_words(seconds: NDArray[np.float64], cloud: int) -> str:
    return (
        f"clouds from {seconds[cloud]:.2f} s on are not used: there the motion hangs on the parameters too steeply for "
        "a fit (small differences grow until they are a matter of luck)"
    )


def _worse_words(seconds: NDArray[np.float64], clouds: int, rms: float, last: Window) -> str:
    return (
        f"clouds after {seconds[last.clouds - 1]:.2f} s are not used: up to {seconds[clouds - 1]:.2f} s the residuals "
        f"grow from {1e3 * root_mean_square(last.linear.r):.3g} to {1e3 * rms:.3g} mm, which the model does not explain"
    )
