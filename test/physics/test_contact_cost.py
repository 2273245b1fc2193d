# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Cost model of contact: it depends on elements in reach, not on clocks or earlier calls."""

from __future__ import annotations

from typing import Any

import pytest

from cloth_sim_ros.physics.contact.binding import FRICTION_OPERATIONS, PAIR_OPERATIONS, PARTICLE_OPERATIONS
from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.control.work_budget import WorkBudget
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.simulation import Simulation

#: A cloth at rest above the obstacles.
OVER: dict[str, Any] = {
    "cloth.resolution": [5, 5],
    "cloth.size": [0.2, 0.2],
    "cloth.orientation": [0.0, 0.0, 0.0, 1.0],
    "cloth.position": [0.0, 0.0, 0.0],
    "cloth.anchors": [""],
    "gravity": [0.0, 0.0, 0.0],
    "contact.thickness": 0.004,
    "obstacles": ["it"],
    "it.shape": "plane",
    "it.position": [0.0, 0.0, -0.005],
}


def added(**values: Any) -> float:
    """Return the operations that contact adds to an evaluation of a frame."""
    cloth = Simulation(Scene.from_parameters({**OVER, **{k.replace("__", "."): v for k, v in values.items()}}))
    costs = []
    for _ in range(2):
        costs.append(cloth.plan.contact_cost(cloth.time, cloth.scene.period, cloth.state))
        # Meanwhile neighbour lists are built for another reach.
        cloth.plan.predict_contact(
            cloth.time, 10.0 * cloth.scene.period, cloth.state.x, cloth.state.v + 1.0, memory=cloth.state.memory
        )
    assert costs[0] == costs[1]
    return costs[0] / CONSTANTS.operation_time


def test_obstacles_out_of_reach_cost_nothing() -> None:
    assert added(it__position=[0.0, 0.0, -0.5], contact__self=True) == 0.0
    assert added(obstacles=[""]) == 0.0


def test_particles_in_reach_cost_more_with_friction() -> None:
    assert added(it__position=[0.0, 0.0, -0.003]) == pytest.approx(25 * PARTICLE_OPERATIONS)
    assert added(it__position=[0.0, 0.0, -0.003], it__friction=[0.5]) == pytest.approx(
        25 * (PARTICLE_OPERATIONS + FRICTION_OPERATIONS)
    )


def test_edge_and_face_pairs_in_reach_cost() -> None:
    ball = {"it__shape": "sphere", "it__size": [0.01], "it__position": [0.02, 0.02, -0.0115]}
    added_cost = added(**ball)
    # A point and its adjacent triangles.
    assert added_cost >= PAIR_OPERATIONS
    assert added_cost == pytest.approx(PAIR_OPERATIONS * round(added_cost / PAIR_OPERATIONS))


def test_work_limit_allows_fewer_evaluations_if_each_costs_more() -> None:
    plan = Scene.from_parameters({**OVER, "obstacles": [""]}).plan()
    bare = plan.step_cost * plan.model.particle_count
    budgets = [WorkBudget(plan, 1000.0, 1 / 60, 1e-3, contact_time=contact_time) for contact_time in (0.0, bare)]
    caps = [budget.cap + budget.reserve for budget in budgets]
    assert caps[0] == pytest.approx(2.0 * caps[1], rel=1e-2)


def test_work_limit_always_fits_some_runs_during_contact() -> None:
    plan = Scene.from_parameters({**OVER, "obstacles": [""]}).plan()
    bare, longest = plan.step_cost * plan.model.particle_count, 1e-4
    runs = CONSTANTS.min_work_cap / 60.0 / longest
    # The budget of explicit steps is halved after each fallback; the fallback itself stays.
    for fallback_count, cap in ((0.0, runs), (3.0, runs / 8.0)):
        budget = WorkBudget(plan, 1e-3, 1 / 60, longest, fallback_count, bare)
        assert (budget.cap, budget.reserve) == (pytest.approx(cap), pytest.approx(runs))
    assert WorkBudget(plan, 1e-3, 1 / 60, longest).cap < runs
