# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Weak springs at every second step: taken where the tolerance leaves room for it, and what it loses is followed."""

from __future__ import annotations

import numpy as np
import pytest

from cloth_sim_ros.bench.problems import PERIOD, carried
from cloth_sim_ros.bench.raw_sheet import RawSheet
from cloth_sim_ros.physics.arrays import largest_distance
from cloth_sim_ros.physics.control.automatic import make_integrator
from cloth_sim_ros.physics.control.control import SHARE_PER_SECOND, Memory
from cloth_sim_ros.physics.control.extrapolated import Extrapolated
from cloth_sim_ros.physics.remembered import restart
from cloth_sim_ros.physics.state import State


def frames(tolerance: float, count: int, **sheet: float) -> tuple[list[str], State]:
    """What was said of each frame of a sheet that falls from flat, held by an edge."""
    made = RawSheet(resolution=40, drag=1.0, **sheet)  # type: ignore[arg-type]
    plan, state = made.plan(made.index[0]), State(made.flat(hung=False))
    said = []
    for frame in range(count):
        if frame == 12:
            restart(state)
        said.append(Extrapolated(tolerance=tolerance).advance(plan, state, frame * PERIOD, PERIOD).reason)
    return said, state


def test_a_loose_tolerance_takes_weak_springs_less_often() -> None:
    said, loose = frames(2e-3, 18)
    assert sum("every second step" in reason for reason in said) >= 15
    memory = Memory.of(loose)
    assert 0.0 < memory.alternating < SHARE_PER_SECOND * PERIOD * 2e-3
    _, tight = frames(1e-6, 18)
    assert 1e-7 < np.abs(loose.x - tight.x).max() < 1e-3


@pytest.mark.parametrize(("tolerance", "sheet"), [(1e-4, {}), (2e-3, {"k_d0": 0.05})])
def test_otherwise_they_are_taken_at_every_step(tolerance: float, sheet: dict[str, float]) -> None:
    said, _ = frames(tolerance, 4, **sheet)
    assert not any("every second step" in reason for reason in said)


def test_a_stretched_sheet_takes_them_at_every_step() -> None:
    made = RawSheet(resolution=40, drag=1.0)
    plan, state = made.plan(made.index[0]), State(1.4 * made.flat(hung=False))
    reason = Extrapolated(tolerance=2e-3).advance(plan, state, 0.0, PERIOD).reason
    assert "every second step" not in reason


def test_what_it_loses_is_followed_while_a_motion_gets_going() -> None:
    """A corner is carried off from rest: what the weak springs lose grows tenfold within a few frames."""
    ends = []
    for tolerance in (1e-3, 1e-8):
        scene = carried(16)
        plan, state = scene.build()
        integrator = make_integrator("auto", tolerance=tolerance)
        for frame in range(scene.frames):
            integrator.advance(plan, state, frame * PERIOD, PERIOD)
        ends.append(state.x)
    assert largest_distance(*ends) < 0.5e-3
