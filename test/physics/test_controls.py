# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Uploads of a plan: controls and the memory of a state, and what later changes of arrays do to them."""

from functools import partial
from itertools import permutations

import attrs
import numpy as np
import pytest
from support.contact_scenes import SHAPES, THICKNESS, contact, still

from cloth_sim_ros.engine.binding import PATH_NUMBERS
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.forces.grips import Grips
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.plan.plan import Plan, compile
from cloth_sim_ros.physics.state.controller_state import ANCHORS_KEY, THICKNESS_KEY
from cloth_sim_ros.physics.state.state import State


def _plan(n: int = 3) -> Plan:
    """Return the plan of n particles, of which a gripper grasps the last one."""
    grips = Grips(1)
    grips.set_grips(grips.paths, np.array([0, 1]), np.array([n - 1]), np.ones((1, 3)), np.full(1, 30.0), np.ones(1))
    return compile(Model(np.ones(n), [grips]))


def _accelerations(plan: Plan) -> Array:
    x = np.zeros((3, plan.model.particle_count))
    out = np.empty_like(x)
    plan.accelerations(0.0, x, x, out)
    return out


def test_grasps_are_validated_for_each_plan() -> None:
    plan, small = _plan(3), _plan(2)
    _accelerations(plan)
    small.controls = plan.controls
    with pytest.raises(ValueError, match="particle 2"):
        _accelerations(small)


def test_controls_before_a_refused_path_are_uploaded_again() -> None:
    plan = _plan()
    before, expected = plan.controls, _accelerations(plan)
    assert before.grips is not None
    grasps = attrs.evolve(before.grips.grasps, particles=np.array([0]))
    grips = before.grips._replace(paths=np.full((1, PATH_NUMBERS), np.nan), grasps=grasps)
    plan.controls = before._replace(grips=grips)
    with pytest.raises(ValueError, match="must be finite"):
        _accelerations(plan)
    plan.controls = before
    assert (_accelerations(plan) == expected).all()


def test_controls_keep_their_own_copies() -> None:
    plan = _plan()
    expected, grips, paths = _accelerations(plan), plan.grips, np.zeros((1, PATH_NUMBERS))
    assert grips is not None
    paths[:, 16] = 1.0
    stiffness = np.full(1, 30.0)
    grips.set_grips(paths, grips.starts, grips.particles, grips.offsets, stiffness, np.ones(1))
    paths[:, 1], stiffness[:] = 1.0, 0.0
    assert (_accelerations(plan) == expected).all()
    grips.set_paths(paths)
    paths[:, 1] = 2.0
    assert _accelerations(plan)[0, 2] == expected[0, 2] + 30.0


def _frictional_plan() -> tuple[Plan, State]:
    """Return the plan of particles on a rough floor that moves, and their state without anchors."""
    floor = attrs.evolve(SHAPES["plane"], friction=(0.5, 0.3))
    path = still()
    path[4] = 0.1
    x = np.array([[0.0, 0.0, 0.5 * THICKNESS], [0.1, 0.0, 0.7 * THICKNESS]])
    return compile(Model(np.ones(2), [contact(floor, paths=[path])])), State(x)


def test_plan_with_contact_refuses_a_missing_memory() -> None:
    plan, state = _frictional_plan()
    out = np.empty_like(state.x)
    plan.accelerations(0.0, state.x, state.v, out, state.memory)
    for query in (plan.energy, plan.dissipation, plan.powers, partial(plan.predict_contact, 0.0)):
        with pytest.raises(ValueError, match=r"pass State\.memory"):
            query(0.0, state.x, state.v)
    with pytest.raises(ValueError, match=r"pass State\.memory"):
        plan.runs(0.0, 0.01, (state.x, state.v), [10])


def test_queries_do_not_depend_on_queries_of_other_states() -> None:
    plan, state = _frictional_plan()
    assert plan.contact is not None
    anchors = np.zeros(plan.contact.anchors_shape)
    anchors[0, :3], anchors[0, 3] = state.x + 1e-5, 1.0
    thickness = np.full(plan.contact.thickness_shape, 0.8 * THICKNESS)
    memories = {}, {ANCHORS_KEY: anchors}, {THICKNESS_KEY: thickness}
    energies = [_frictional_plan()[0].energy(0.0, state.x, state.v, memory) for memory in memories]
    assert len(set(energies)) == len(memories)
    for order in permutations(range(len(memories))):
        for k in order:
            assert plan.energy(0.0, state.x, state.v, memories[k]) == energies[k]
