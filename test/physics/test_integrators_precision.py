# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Single precision: taken where the tolerance leaves room for its rounding, and nowhere else."""

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
    """Runs are looked at as they are asked for."""
    with cores.alone():
        yield


def build() -> tuple[Plan, State]:
    sheet = RawSheet(resolution=20)
    return sheet.plan(sheet.index[0]), State(sheet.flat(hung=False))


def precisions(plan: Plan) -> list[bool]:
    """The precision of each run from now on: True for single."""
    seen: list[bool] = []
    run = plan.runs

    def watched(t, duration, start, steps, *, narrow=False, **others):  # type: ignore[no-untyped-def]
        # Of several runs the first alone may be in single precision.
        seen.extend([narrow, *(False for _ in steps[1:])])
        return run(t, duration, start, steps, narrow=narrow, **others)

    plan.runs = watched  # type: ignore[method-assign]
    return seen


def frames(tolerance: float, count: int) -> tuple[list[list[bool]], State]:
    """The precision of the runs of each frame, and the end."""
    plan, state = build()
    seen, each = precisions(plan), []
    for frame in range(count):
        seen.clear()
        Extrapolated(tolerance=tolerance).advance(plan, state, frame * PERIOD, PERIOD)
        each.append(list(seen))
    return each, state


def test_a_loose_tolerance_takes_it_between_judgements() -> None:
    each, state = frames(1e-2, 24)
    # Before the first frame, which starts at rest, a few steps in both measure what single precision changes.
    assert each[0] == [False, True, False, False]
    # What rounding makes of the energy is small against the motion once there is some.
    assert each[1] == [False]
    # Four judged frames measure it.
    assert each[3] == each[8] == [False, True, True, True]
    assert each[15] == [True, True]
    assert sum(runs == [True] for runs in each) > 12
    rounding = Precision.of(state).rounding
    assert 1e-9 < rounding < CONSTANTS.rounding * CONSTANTS.share * PERIOD * 1e-2


def test_a_judgement_takes_it_where_a_combination_could_not() -> None:
    tolerance = 1e-3
    budget = CONSTANTS.share * PERIOD * tolerance
    each, state = frames(tolerance, 24)
    blurred = amplification(2) * Precision.of(state).rounding
    assert CONSTANTS.rounding * budget < blurred < 0.1 * budget
    judged = [runs for runs in each[1:] if len(runs) == 2]
    assert judged
    assert all(runs == [True, True] for runs in judged)


def test_a_judgement_in_it_tells_the_same_error_within_its_blur() -> None:
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
        # So much rounding that nothing has room for it.
        Precision(rounding=1.0).store(start)
        wide = Extrapolated(tolerance=tolerance).advance(plan, start, frame * PERIOD, PERIOD)
        assert abs(done.error - wide.error) < 0.1 * budget
        compared += 1
    assert compared >= 2


@pytest.mark.parametrize(("kick", "doubted"), [(1.0, False), (10.0, True)])
def test_what_misses_the_budget_twice_in_it_is_tried_in_double(kick: float, doubted: bool) -> None:
    plan, state = build()
    for frame in range(6):
        Extrapolated(tolerance=1e-3).advance(plan, state, frame * PERIOD, PERIOD)
    # A kick [m/s] that nothing was told of: what was predicted is far off.
    state.v = state.v + kick * np.random.default_rng(1).uniform(-1.0, 1.0, state.v.shape) * (state.v != 0.0)
    seen = precisions(plan)
    done = Extrapolated(tolerance=1e-3).advance(plan, state, 6 * PERIOD, PERIOD)
    assert done.rejected == (3 if doubted else 2)
    # The frame, what judges it, the same with finer steps, and everything after that.
    assert seen[:4] == [True] * 4
    assert len(seen) > 4 if doubted else len(seen) == 4
    assert not any(seen[4:])


def test_a_tight_tolerance_never_does() -> None:
    each, state = frames(1e-6, 24)
    assert not any(any(runs) for runs in each)
    assert Precision.of(state).rounding < 0.0


def test_it_stays_well_within_the_tolerance() -> None:
    _, loose = frames(1e-2, 30)
    _, tight = frames(1e-7, 30)
    assert 0.0 < np.abs(loose.x - tight.x).max() < 1e-3


def hung(stiffness: float, count: int = 20, resolution: int = 16) -> tuple[float, Noise, list[list[bool]]]:
    """What the energy balance of a hung sheet that swings leaves over, relative to the energy turned over."""
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


def test_a_stiff_sheet_whose_energy_rounding_would_change_does_without() -> None:
    residual, noise, each = hung(100.0)
    # In single precision it is 0.1 (docs/time_stepping.md).
    assert residual < 1e-3
    assert noise.power > CONSTANTS.gain * noise.kinetic > 0.0
    # The samples alone.
    assert sum(sum(runs) for runs in each) == noise.samples > 2.0


def test_a_flat_sheet_that_lies_where_nothing_is_rounded_is_measured_when_it_moves() -> None:
    # Multiples of 1/32 m are numbers of single precision: at the start a hundredth is found of what there is.
    residual, noise, _ = hung(1.0, resolution=33)
    _, beside, _ = hung(1.0, resolution=34)
    assert noise.power > 0.05 * beside.power
    assert residual < 5e-4


def test_a_limp_sheet_takes_it_and_keeps_its_energy() -> None:
    residual, noise, each = hung(0.3)
    assert residual < 1e-3
    assert 0.0 < noise.power < CONSTANTS.gain * noise.kinetic
    assert sum(all(runs) for runs in each) > 12


def test_an_event_asks_anew() -> None:
    plan, state = build()
    for frame in range(3):
        Extrapolated(tolerance=1e-2).advance(plan, state, frame * PERIOD, PERIOD)
    assert Precision.of(state).rounding > 0.0
    restart(state)
    seen = precisions(plan)
    Extrapolated(tolerance=1e-2).advance(plan, state, 3 * PERIOD, PERIOD)
    assert seen[0] is False
