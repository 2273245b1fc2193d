# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Controls: what a plan uploads, and what later changes of arrays do to it."""

import attrs
import numpy as np
import pytest

from cloth_sim_ros.engine.binding import PATH_NUMBERS
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.forces.grips import Grips
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.plan.plan import Plan, compile


def _plan(n: int = 3) -> Plan:
    """Return the plan of n particles, of which a gripper grasps the last one."""
    grips = Grips(1)
    grips.hold(grips.paths, np.array([0, 1]), np.array([n - 1]), np.ones((1, 3)), np.full(1, 30.0), np.ones(1))
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
    grips.hold(paths, grips.starts, grips.particles, grips.offsets, stiffness, np.ones(1))
    paths[:, 1], stiffness[:] = 1.0, 0.0
    assert (_accelerations(plan) == expected).all()
    grips.set_paths(paths)
    paths[:, 1] = 2.0
    assert _accelerations(plan)[0, 2] == expected[0, 2] + 30.0
