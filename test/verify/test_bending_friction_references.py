# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""References of scenes whose hinges start beyond their yield limit."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from cloth_sim_ros.physics.model.forces.bending_friction import BendingFriction
from cloth_sim_ros.physics.model.forces.pair_springs import PairSprings
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.plan.plan import Plan, compile
from cloth_sim_ros.physics.state.controller_state import PLASTIC_LENGTHS_KEY
from cloth_sim_ros.verify.independent_integrator import dop853
from cloth_sim_ros.verify.reference_integrator import (
    STEP_COUNTS,
    MotionState,
    ReferenceIntegrator,
    integrate_intervals,
)

DURATION = 0.02


def _folded_hinge() -> tuple[Plan, MotionState]:
    """Return a hinge, held at its edge, whose folded wings unfold; its plastic length is far beyond the limit."""
    friction, joints = BendingFriction([[0, 1, 2, 3]], 0.0, 2.0, 0.002), PairSprings([[0, 2], [0, 3]], 0.0, 3.0)
    x = np.array([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-0.1, 0.5, 0.05], [0.1, 0.5, 0.05]]).T.copy()
    v = np.zeros((3, 4))
    v[2, 2:] = -0.5
    return compile(Model(np.full(4, 0.01), [friction, joints], anchors=[0, 1])), MotionState(x, v)


def _integrate_frame(plan: Plan, start: MotionState) -> MotionState:
    return ReferenceIntegrator(1e-9).integrate_frame(plan, 0.0, DURATION, start, math.inf)[0]


def _integrate_intervals(plan: Plan, start: MotionState) -> MotionState:
    return integrate_intervals(plan, 0.0, [DURATION], start, STEP_COUNTS)


def _dop853(plan: Plan, start: MotionState) -> MotionState:
    return dop853(plan, 0.0, DURATION, start)


@pytest.mark.parametrize("integrate", [_dop853, _integrate_frame, _integrate_intervals])
def test_hinge_beyond_yield_limit_starts_at_its_yield_surface(integrate: Callable[..., MotionState]) -> None:
    plan, start = _folded_hinge()
    assert plan.plastic is not None
    lengths, work = plan.plastic.return_mapping(start.x, start.memory)
    assert work > 0.0
    raw, returned = (integrate(plan, start._replace(memory=memory)) for memory in ({}, {PLASTIC_LENGTHS_KEY: lengths}))
    assert raw.memory[PLASTIC_LENGTHS_KEY] == pytest.approx(returned.memory[PLASTIC_LENGTHS_KEY], abs=1e-13)
    assert raw.x == pytest.approx(returned.x, abs=1e-13)
    assert start.memory == {}
