# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Displacement that velocity errors cause later, against closed forms and eigenvectors."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cloth_sim_ros import Gravity, Model, PairSprings, Scene, Simulation
from cloth_sim_ros.physics.integrators.extrapolation_tableau import step_counts
from cloth_sim_ros.physics.plan.plan import compile
from cloth_sim_ros.simulation.events import Grasp, Target

TIME = 0.5


def test_free_particle_keeps_its_velocity_error() -> None:
    plan = compile(Model([0.1], [Gravity()]))
    errors = np.array([[3e-6], [0.0], [4e-6]])
    assert plan.velocity_displacement(0.0, np.zeros((3, 1)), errors, TIME)[0] == pytest.approx(TIME * 5e-6, rel=1e-9)


def test_joints_displace_by_their_modes() -> None:
    masses, stiffness = np.array([1.0, 0.017, 0.5, 0.2]), (2400.0, 0.8, 35.0)
    pairs = [[0, 1], [1, 2], [2, 3]]
    plan = compile(Model(masses, [PairSprings(pairs, 0.0, stiffness)], anchors=[0]))
    matrix = np.zeros((4, 4))
    for (i, k), value in zip(pairs, stiffness, strict=True):
        matrix[np.ix_([i, k], [i, k])] += value * np.array([[1.0, -1.0], [-1.0, 1.0]])
    root_masses = np.sqrt(masses[1:])
    frequencies2, modes = np.linalg.eigh(matrix[1:, 1:] / np.outer(root_masses, root_masses))
    errors = np.zeros((3, 4))
    errors[1, 1:] = 1e-5, -2e-5, 3e-5
    shares = (modes.T @ (root_masses * errors[1, 1:])) / np.sqrt(frequencies2 + 1.0 / TIME**2)
    expected = np.abs(modes @ shares / root_masses).max()
    positions = np.random.default_rng(1).normal(size=(3, 4))
    assert plan.velocity_displacement(0.0, positions, errors, TIME)[0] == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(("extent", "frequency"), [(100.0, 1e3), (10.0, 1e4)])
def test_distant_particle_does_not_stiffen_a_slack_spring(extent: float, frequency: float) -> None:
    # Across a spring at its rest length nothing holds the particle. A difference of forces over 1e-5 of the extent
    # would find a stiffness.
    spring = PairSprings([[0, 1]], 0.1, 0.1 * frequency * frequency)
    plan = compile(Model([1.0, 1.0, 1.0], [spring], anchors=[0]))
    positions, errors = np.array([[0.0, 0.1, extent], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]), np.zeros((3, 3))
    errors[1, 1] = 1e-7
    assert plan.velocity_displacement(0.0, positions, errors, TIME)[0] == pytest.approx(TIME * 1e-7, rel=0.05)


def test_errors_that_are_not_finite_displace_without_bound() -> None:
    plan = compile(Model([0.1], [Gravity()]))
    assert plan.velocity_displacement(0.0, np.zeros((3, 1)), np.full((3, 1), np.nan), TIME)[0] == math.inf
    assert plan.velocity_displacement(0.0, np.zeros((3, 1)), np.zeros((3, 1)), TIME)[0] == 0.0


def test_coprime_step_counts_share_no_divisor() -> None:
    counts = step_counts(24, coprime=True)
    assert all(math.gcd(n, m) == 1 for i, n in enumerate(counts) for m in counts[:i])
    assert counts[0] == 24


def test_grips_do_not_reduce_the_displacement() -> None:
    # What a stiff gripper holds keeps its velocity when it is released.
    simulation = Simulation(Scene.from_parameters({"cloth.resolution": [6, 6]}))
    x = simulation.state.x.copy()
    errors = 1e-6 * np.random.default_rng(1).normal(size=x.shape) * (simulation.model.inverse_masses > 0.0)
    free = simulation.plan.velocity_displacement(0.0, x, errors, TIME)
    simulation.advance([Target("gripper", tuple(x[:, -1].tolist())), Grasp("gripper", True)])
    assert simulation.plan.grips is not None
    assert simulation.plan.grips.particles.size > 0
    assert simulation.plan.velocity_displacement(0.0, x, errors, TIME) == free
