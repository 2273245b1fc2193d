# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The reference that errors are told by: equations of its own, the same as the engine's, and an exact solution."""

import attrs
import numpy as np
import pytest
from support.problems import MORE_PROBLEMS, PROBLEMS, chain, problem
from support.reference import RightSide, reference
from support.right_side import IndependentRightSide

from cloth_sim_ros.physics.model.forces.air_panels import AirPanels
from cloth_sim_ros.physics.model.forces.pair_springs import PairSprings
from cloth_sim_ros.physics.model.model import Model


@pytest.mark.parametrize("name", [*PROBLEMS, *MORE_PROBLEMS])
def test_its_equations_are_the_engines(name):
    plan, state = problem(name).build()
    random = np.random.default_rng(3)
    y = np.concatenate([state.x.ravel(), state.v.ravel()])
    y += 0.01 * random.standard_normal(y.size) * np.tile(plan.model.inverse_masses > 0.0, 6)
    independent, engines = IndependentRightSide(plan.model), RightSide(plan)
    for t in (0.0, 0.3):
        expected = engines(t, y)
        assert independent(t, y) == pytest.approx(expected, abs=1e-12 * np.abs(expected).max())


def test_it_meets_an_exact_solution():
    scene = attrs.evolve(chain(), frames=6)
    assert scene.exact is not None
    solved = reference(attrs.evolve(scene, exact=None))
    assert solved.error < 1e-10
    for frame, t in enumerate(solved.times, 1):
        assert solved.deviation(frame, scene.exact(t)) < 1e-10


def test_what_it_does_not_know_is_refused():
    springs = PairSprings([[0, 1]], 1.0, 1.0)
    with pytest.raises(ValueError, match="does not know the force 'air'"):
        IndependentRightSide(Model(np.ones(3), [springs, AirPanels([[0, 1, 2]], normal=1.0, tangential=1.0)]))
    with pytest.raises(ValueError, match="no joints"):
        IndependentRightSide(Model(np.ones(2), [PairSprings([[0, 1]], 0.0, 1.0)]))
