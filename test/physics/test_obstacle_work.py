# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Work of obstacles and grippers over large steps, and in the last half step."""

import math

import numpy as np
import pytest
from support.contact_scenes import THICKNESS, contact, drop, flat_sheet, still

from cloth_sim_ros.physics.accounting.work_accumulator import WorkAccumulator
from cloth_sim_ros.physics.control.fallback import finish_implicitly
from cloth_sim_ros.physics.integrators.base import UnstableError
from cloth_sim_ros.physics.integrators.extrapolation_tableau import ExtrapolationTableau
from cloth_sim_ros.physics.integrators.implicit_advance import ImplicitAdvance
from cloth_sim_ros.physics.integrators.stage_matrix import StageMatrix

FRAME = 1.0 / 32.0


def driven(shape, position, speed, turn=(0.0, 0.0, 0.0)):
    """Return a free sheet around the origin, and an obstacle that moves at a speed [m/s] and turns [rad/s]."""
    path = still(position, (0.5, 0.5, 0.5, 0.5) if shape == "capsule" else (0.0, 0.0, 0.0, 1.0))
    path[4:7], path[17:20] = speed, turn
    model, places = flat_sheet(8, 8, contact(shape, paths=[path]), size=0.5, gravity=False, drag=False)
    plan, state, _ = drop(model, places)
    return plan, state


@pytest.mark.parametrize(
    ("shape", "position", "speed", "turn"),
    [
        ("box", (0.0, 0.0, -0.1 - 1.2 * THICKNESS), (0.0, 0.0, 10.0), (0.0, 0.0, 0.0)),
        ("box", (0.0, 0.0, -0.1 - 1.2 * THICKNESS), (0.0, 0.0, 3.0), (0.0, 8.0, 0.0)),
        ("sphere", (0.05, 0.0, -0.2 - 1.2 * THICKNESS), (1.0, 0.0, 10.0), (0.0, 0.0, 0.0)),
        ("capsule", (0.0, 0.02, -0.1 - 1.2 * THICKNESS), (0.0, 0.0, 20.0), (0.0, 0.0, 5.0)),
    ],
)
def test_fallback_steps_record_the_work_of_an_obstacle(shape, position, speed, turn):
    """In one of eight steps it moves further than contact reaches; the law's force has no limit in between."""
    plan, state = driven(shape, position, speed, turn)
    book = WorkAccumulator(plan.gripper_count, obstacle_count=1)
    before, momentum = plan.energy(0.0, state.x, state.v, memory=state.memory), plan.model.masses * state.v
    done = finish_implicitly(plan, state, 0.0, FRAME, book, instead_of="explicit steps", max_evaluations=math.inf)
    assert done.flagged
    gained = (plan.model.masses * state.v - momentum).sum(axis=1)
    assert gained[2] > 0.3 * plan.model.mass * speed[2]
    # The iteration of such steps has not converged: the recorded work has the order of the true one.
    booked = -FRAME * book.obstacle_wrenches[0, 2]
    assert 0.2 * gained[2] < booked < 50.0 * gained[2]
    # Missing energy was dissipated; energy never appears.
    energy_gain = plan.energy(FRAME, state.x, state.v, memory=state.memory) - before
    assert energy_gain <= book.work * (1.0 + 1e-9)
    assert book.work <= 2.0 * booked * max(np.abs(speed))


def test_contact_in_the_last_half_step_is_recorded():
    """The plate is out of reach at the middle of every step: its work remains as contact energy in the end."""
    steps, speed = 64, 5.0
    h = FRAME / steps
    reached = THICKNESS + speed * (FRAME - 0.4 * h)
    plan, state = driven("box", (0.0, 0.0, -0.1 - reached), (0.0, 0.0, speed))
    columns = ExtrapolationTableau(plan, state, 0.0, FRAME, (steps,), record_obstacles=True)
    x, v = columns.combine(1)
    gained = plan.energy(FRAME, x, v, memory={}) - plan.energy(0.0, state.x, state.v, memory=state.memory)
    assert gained > 0.0
    assert np.abs(v).max() < 1e-9
    assert columns.work(1) == pytest.approx(gained, rel=0.5)


def test_abandoned_step_leaves_obstacles_in_place(monkeypatch):
    """During the search for velocities obstacles are ahead in time; a failure then must not leave them there."""
    plan, state = driven("box", (0.0, 0.0, -0.1 - 1.2 * THICKNESS), (0.0, 0.0, 10.0))
    before = plan.contact.obstacle_gaps(FRAME, state.x, memory=state.memory)

    def fails(*_):
        raise UnstableError("no matrix")

    monkeypatch.setattr(StageMatrix, "solve", fails)
    monkeypatch.setattr(ImplicitAdvance, "_solve_step", lambda *_: None)
    with pytest.raises(UnstableError):
        finish_implicitly(plan, state, 0.0, FRAME, None, instead_of="explicit steps", max_evaluations=math.inf)
    assert np.array_equal(plan.contact.obstacle_gaps(FRAME, state.x, memory=state.memory), before)
