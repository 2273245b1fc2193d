# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Multirate rule: no wave grows, by the eigenvalues of steps of a single wave in numpy."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cloth_sim_ros.physics.control.multirate import MAX_RATIO, MultirateRule
from cloth_sim_ros.physics.integrators.limit import leapfrog_limit
from cloth_sim_ros.physics.state.controller_state import MultirateState

#: Squared frequencies of waves along springs, relative to the fastest: many close to it, at the limit of steps.
WAVES = np.unique([*np.linspace(0.0, 1.0, 61), *np.geomspace(1e-4, 1.0, 30), *(1.0 - np.geomspace(1e-4, 0.1, 20))])


def growth(h: float, ratio: int, along: tuple[float, float], bent: tuple[float, float]) -> float:
    """Return the largest growth factor of a wave x'' = -a x - b x' over `every` steps of the leapfrog.

    Args:
        h: step size [s].
        ratio: multirate ratio.
        along: squared frequency [1/s^2] and damping rate [1/s] of the force in each step.
        bent: the same of the force in the middle step.
    """
    steps = np.zeros((6, 6))
    for k in range(6):
        x, v, seen, before, lead, last = np.eye(6)[k]
        for step in range(ratio):
            a = -along[0] * x - along[1] * seen
            if step == ratio // 2:
                impulse = ratio * (-bent[0] * x - bent[1] * (seen + lead))
                quarter = 0.25 * h * impulse
                a, lead, last = a + impulse, quarter + last, quarter
            v += h * a
            seen, before = v + 0.25 * h * (a + before), a
            x += h * v
        steps[:, k] = x, v, seen, before, lead, last
    return float(np.abs(np.linalg.eigvals(steps)).max())


def rule(
    min_damping_time: float, bounds: tuple[float, float, float], ratio: int = 1, bent: float = 0.9
) -> MultirateRule:
    """Return the rule of a plan whose hinges take a fraction `bent` of the cost of a step."""

    def cost(steps: int) -> float:
        return 1.0 - bent * (steps - 1) / steps

    plan: Any = SimpleNamespace(
        has_hinges=True,
        min_damping_time=lambda: min_damping_time,
        multirate_step_cost=cost,
        detailed_spectral_bounds=lambda x, hinges: [0.0, 0.0, *bounds],
    )
    return MultirateRule(plan, MultirateState(*bounds, float(ratio)), allowed=True)


def longitudinal_growth(h: float, ratio: int, min_damping_time: float, bent: tuple[float, float]) -> float:
    """Return the largest growth of a longitudinal wave for springs of highest frequency 1/s, with hinge stiffness."""
    max_growth = 0.0
    for square in WAVES:
        for part in (1.0, 0.3):
            stiffness = min(part * bent[0], 1.0 - square)
            damping = stiffness * bent[1] / bent[0]
            max_growth = max(max_growth, growth(h, ratio, (square, min_damping_time * square), (stiffness, damping)))
    return max_growth


@pytest.mark.parametrize("seed", range(12))
def test_longitudinal_waves_do_not_grow(seed: int) -> None:
    rng = np.random.default_rng(seed)
    min_damping_time, ratio = 10.0 ** rng.uniform(-3.0, 0.0), int(rng.choice([3, 5, 7, 9]))
    damping_ratio = 0.0 if seed % 2 else 10.0 ** rng.uniform(-1.5, 1.7)
    h = leapfrog_limit(1.0, min_damping_time) * rng.uniform(0.3, 0.96)
    # The stiffest hinges that the rule allows at this step size.
    low, high = 1e-9, 1.0
    for _ in range(60):
        middle = math.sqrt(low * high)
        fits = rule(min_damping_time, (middle, damping_ratio * middle, 0.0)).min_refinement(ratio, h) <= 1.0
        low, high = (middle, high) if fits else (low, middle)
    assert 1e-8 < low < 1.0
    assert longitudinal_growth(h, ratio, min_damping_time, (low, damping_ratio * low)) <= 1.0 + 1e-9


@pytest.mark.parametrize(
    ("min_damping_time", "damping_ratio", "times"), [(0.2, 0.0, 2.5), (0.05, 10.0, 6.0), (0.2, 40.0, 6.0)]
)
def test_longitudinal_waves_grow_beyond_the_hinge_limit(
    min_damping_time: float, damping_ratio: float, times: float
) -> None:
    h = 0.96 * leapfrog_limit(1.0, min_damping_time)
    low, high = 1e-9, 1.0
    for _ in range(60):
        middle = math.sqrt(low * high)
        fits = rule(min_damping_time, (middle, damping_ratio * middle, 0.0)).min_refinement(3, h) <= 1.0
        low, high = (middle, high) if fits else (low, middle)
    assert longitudinal_growth(h, 3, min_damping_time, (times * low, times * damping_ratio * low)) > 1.0 + 1e-3


@pytest.mark.parametrize("ratio", [3, 5, 9])
@pytest.mark.parametrize("damping_ratio", [0.0, 0.3, 3.0])
def test_transverse_waves_do_not_grow(ratio: int, damping_ratio: float) -> None:
    for across in np.geomspace(1e-4, 0.3, 12):
        for bent in np.geomspace(1e-5, 0.1, 10):
            # Strong damping along springs leaves the transverse limit alone.
            at = rule(1e9, (bent, damping_ratio * bent, across))
            h = 1.0 / at.min_refinement(ratio, 1.0)
            for square in np.linspace(0.0, across, 20):
                assert growth(h, ratio, (square, 0.0), (bent, damping_ratio * bent)) <= 1.0 + 1e-9


def test_transverse_waves_grow_beyond_half_a_period() -> None:
    at = rule(1e9, (1e-3, 0.0, 0.1))
    h = 1.7 / at.min_refinement(3, 1.0)
    assert max(growth(h, 3, (square, 0.0), (1e-3, 0.0)) for square in np.linspace(0.0, 0.1, 400)) > 1.0 + 1e-4


def test_ratio_of_least_cost_is_chosen() -> None:
    soft = rule(1e9, (1e-6, 0.0, 0.0))
    soft.choose_ratio(np.zeros((3, 1)), 1e-3, 36e-3, 1)
    assert soft.ratio == MAX_RATIO
    # 28 steps are four impulses of seven steps, but too few for four of nine.
    short = rule(1e9, (1e-6, 0.0, 0.0))
    short.choose_ratio(np.zeros((3, 1)), 1e-3, 28e-3, 1)
    assert short.ratio == 7
    # Stiffer hinges require impulses so frequent that steps would become shorter.
    stiff = rule(1e9, (3e6, 0.0, 0.0))
    stiff.choose_ratio(np.zeros((3, 1)), 1e-3, 36e-3, 1)
    assert stiff.ratio == 1
    # Cheap hinges do not justify further steps.
    cheap = rule(1e9, (1e-6, 0.0, 0.0), bent=0.01)
    cheap.choose_ratio(np.zeros((3, 1)), 1e-3, 37e-3, 1)
    assert cheap.ratio == 1


def test_ratio_is_kept_while_it_pays() -> None:
    soft = rule(1e9, (1e-6, 0.0, 0.0), ratio=3)
    soft.keep_ratio(1e-3, 36e-3)
    assert soft.ratio == 3
    stiff = rule(1e9, (3e6, 0.0, 0.0), ratio=3)
    stiff.keep_ratio(1e-3, 36e-3)
    assert stiff.ratio == 1
    # 34 steps are fewer than four impulses of nine steps.
    short = rule(1e9, (1e-6, 0.0, 0.0), ratio=9)
    short.keep_ratio(1e-3, 34e-3)
    assert short.ratio == 1


def test_combined_runs_set_the_ratio_to_one_for_some_estimates() -> None:
    at = rule(1e9, (1e-6, 0.0, 0.0), ratio=9)
    at.choose_ratio(np.zeros((3, 1)), 1e-3, 36e-3, 2)
    assert at.ratio == 1
    chosen = []
    for _ in range(20):
        at.choose_ratio(np.zeros((3, 1)), 1e-3, 36e-3, 1)
        chosen.append(at.ratio)
    assert chosen == [1] * 15 + [MAX_RATIO] * 5


def test_interval_has_at_least_four_impulses() -> None:
    soft = rule(1e9, (1e-6, 0.0, 0.0), ratio=9)
    assert soft.ratio_within(1e-3, 36e-3) == (9, pytest.approx(0.0, abs=1.0))
    assert soft.ratio_within(1e-3, 35e-3)[0] == 7
    assert soft.ratio_within(1e-3, 12e-3)[0] == 3
    assert soft.ratio_within(1e-3, 11e-3) == (1, 1.0)


def test_undamped_springs_set_the_ratio_to_one() -> None:
    undamped = rule(0.0, (1e-6, 0.0, 0.0), ratio=9)
    undamped.choose_ratio(np.zeros((3, 1)), 1e-3, 36e-3, 1)
    assert undamped.ratio == 1
    assert undamped.ratio_within(1.0, 45.0) == (1, 1.0)


def test_unstable_bounds_are_reported() -> None:
    at = rule(0.2, (1e-3, 0.0, 0.0), ratio=3)
    summary: Any = SimpleNamespace(hinge_bounds=(1e-3, 0.0, 0.0))
    longest = 3.0 / at.min_refinement(3, 1.0)
    assert not at.exceeds_limit(longest, summary)
    stiffer: Any = SimpleNamespace(hinge_bounds=(1e-1, 0.0, 0.0))
    assert at.exceeds_limit(longest, stiffer)
