# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Single precision: used only if the tolerance allows its rounding."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from support.raw_sheet import RawSheet

from cloth_sim_ros.physics import cores
from cloth_sim_ros.physics.constants import CONSTANTS
from cloth_sim_ros.physics.control.extrapolated import Extrapolated
from cloth_sim_ros.physics.energy_balance import EnergyBalance
from cloth_sim_ros.physics.integrators.columns import amplification
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.remembered import Noise, Precision, restart
from cloth_sim_ros.physics.state import State

PERIOD = 1 / 60


@pytest.fixture(autouse=True)
def one_run_at_a_time() -> Iterator[None]:
    """Disable prefetching, so that tests observe runs on demand."""
    with cores.alone():
        yield


def build() -> tuple[Plan, State]:
    sheet = RawSheet(resolution=20)
    return sheet.plan(sheet.index[0]), State(sheet.flat(hung=False))


def precisions(plan: Plan) -> list[bool]:
    """Return a list that collects the precision of each further run: True for single."""
    seen: list[bool] = []
    run = plan.runs

    def watched(t, duration, start, steps, *, narrow=False, **others):  # type: ignore[no-untyped-def]
        # Only the first of several runs may use single precision.
        seen.extend([narrow, *(False for _ in steps[1:])])
        return run(t, duration, start, steps, narrow=narrow, **others)

    plan.runs = watched  # type: ignore[method-assign]
    return seen


def frames(tolerance: float, count: int) -> tuple[list[list[bool]], State]:
    """Return the precision of the runs of each frame, and the state at the end."""
    plan, state = build()
    seen, each = precisions(plan), []
    for frame in range(count):
        seen.clear()
        Extrapolated(tolerance=tolerance).advance(plan, state, frame * PERIOD, PERIOD)
        each.append(list(seen))
    return each, state


def test_loose_tolerance_uses_single_precision() -> None:
    each, state = frames(1e-2, 24)
    # Before the first frame, which starts at rest, a few steps in both precisions measure the difference.
    assert each[0] == [False, True, False, False]
    # The energy input of rounding is small against the motion once the sheet moves.
    assert each[1] == [False]
    # Four frames with an error estimate measure it.
    assert each[3] == each[8] == [False, True, True, True]
    assert each[15] == [True, True]
    assert sum(runs == [True] for runs in each) > 12
    rounding = Precision.of(state).rounding
    assert 1e-9 < rounding < CONSTANTS.rounding * CONSTANTS.share * PERIOD * 1e-2


def test_estimate_uses_single_precision_beyond_a_combination() -> None:
    tolerance = 1e-3
    budget = CONSTANTS.share * PERIOD * tolerance
    each, state = frames(tolerance, 24)
    blurred = amplification(2) * Precision.of(state).rounding
    assert CONSTANTS.rounding * budget < blurred < 0.1 * budget
    judged = [runs for runs in each[1:] if len(runs) == 2]
    assert judged
    assert all(runs == [True, True] for runs in judged)


def test_single_precision_estimate_equals_double_estimate() -> None:
    tolerance, count = 1e-3, 24
    budget = CONSTANTS.share * PERIOD * tolerance
    plan, state = build()
    seen, compared = precisions(plan), 0
    for frame in range(count):
        start = state.copy()
        seen.clear()
        done = Extrapolated(tolerance=tolerance).advance(plan, state, frame * PERIOD, PERIOD)
        if seen != [True, True]:
            continue
        # A recorded rounding error that excludes single precision.
        Precision(rounding=1.0).store(start)
        wide = Extrapolated(tolerance=tolerance).advance(plan, start, frame * PERIOD, PERIOD)
        assert abs(done.error - wide.error) < 0.1 * budget
        compared += 1
    assert compared >= 2


@pytest.mark.parametrize(("kick", "doubted"), [(1.0, False), (10.0, True)])
def test_second_miss_in_single_precision_switches_to_double(kick: float, doubted: bool) -> None:
    plan, state = build()
    for frame in range(6):
        Extrapolated(tolerance=1e-3).advance(plan, state, frame * PERIOD, PERIOD)
    # A perturbation [m/s] without an event: the prediction is far off.
    state.v = state.v + kick * np.random.default_rng(1).uniform(-1.0, 1.0, state.v.shape) * (state.v != 0.0)
    seen = precisions(plan)
    done = Extrapolated(tolerance=1e-3).advance(plan, state, 6 * PERIOD, PERIOD)
    assert done.rejected == (3 if doubted else 2)
    # The frame, its error estimate, both with finer steps, and all later runs.
    assert seen[:4] == [True] * 4
    assert len(seen) > 4 if doubted else len(seen) == 4
    assert not any(seen[4:])


def test_tight_tolerance_uses_double_precision() -> None:
    each, state = frames(1e-6, 24)
    assert not any(any(runs) for runs in each)
    assert Precision.of(state).rounding < 0.0


def test_single_precision_error_is_far_below_the_tolerance() -> None:
    _, loose = frames(1e-2, 30)
    _, tight = frames(1e-7, 30)
    assert 0.0 < np.abs(loose.x - tight.x).max() < 1e-3


def hung(stiffness: float, count: int = 20, resolution: int = 16) -> tuple[float, Noise, list[list[bool]]]:
    """Return residual over turnover of the energy balance of a swinging sheet, its noise state, and precisions."""
    sheet = RawSheet(resolution=resolution, stiffness=stiffness)
    positions = sheet.flat(hung=True)
    velocities = np.zeros_like(positions)
    velocities[:, 1] = -0.5 * positions[:, 2]
    plan, state = sheet.plan(sheet.index[0]), State(positions, velocities)
    balance, residual, each = EnergyBalance(plan, state), 0.0, []
    seen = precisions(plan)
    for frame in range(count):
        seen.clear()
        Extrapolated(tolerance=1e-3).advance(plan, state, frame * PERIOD, PERIOD, balance.book)
        residual = max(residual, abs(balance.close((frame + 1) * PERIOD, state)))
        each.append(list(seen))
    return residual / balance.turned_over, Noise.of(state), each


def test_stiff_sheet_uses_double_precision_for_its_energy() -> None:
    residual, noise, each = hung(100.0)
    # In single precision it is 0.1 (docs/time_stepping.md).
    assert residual < 1e-3
    assert noise.power > CONSTANTS.gain * noise.kinetic > 0.0
    # The measurements alone use single precision.
    assert sum(sum(runs) for runs in each) == noise.samples > 2.0


def test_rounding_of_a_flat_sheet_is_measured_once_it_moves() -> None:
    # Multiples of 1/32 m are exact in single precision: the first measurement finds a hundredth of the noise.
    residual, noise, _ = hung(1.0, resolution=33)
    _, beside, _ = hung(1.0, resolution=34)
    assert noise.power > 0.05 * beside.power
    assert residual < 5e-4


def test_soft_sheet_uses_single_precision_and_keeps_its_energy() -> None:
    residual, noise, each = hung(0.3)
    assert residual < 1e-3
    assert 0.0 < noise.power < CONSTANTS.gain * noise.kinetic
    assert sum(all(runs) for runs in each) > 12


def test_event_causes_a_new_measurement() -> None:
    plan, state = build()
    for frame in range(3):
        Extrapolated(tolerance=1e-2).advance(plan, state, frame * PERIOD, PERIOD)
    assert Precision.of(state).rounding > 0.0
    restart(state)
    seen = precisions(plan)
    Extrapolated(tolerance=1e-2).advance(plan, state, 3 * PERIOD, PERIOD)
    assert seen[0] is False
