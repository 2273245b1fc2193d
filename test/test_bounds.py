# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bounds of frequencies and damping rates: the vectorised passes against the terms and numpy's eigenvalues."""

import numpy as np
import pytest
from scipy.spatial import Delaunay

from cloth_sim_ros.events import Grasp, Target
from cloth_sim_ros.physics.kernels import grid_bounds, mesh_bounds
from cloth_sim_ros.physics.stability import Bounds, block_rates
from cloth_sim_ros.scene import Scene
from cloth_sim_ros.simulation import Simulation


@pytest.mark.parametrize(
    "values",
    [
        {},
        {"material.damping": 0.0},
        {"cloth.shear_layout": "alternating", "bending.model": "none"},
        {"cloth.shear_layout": "left", "cloth.resolution": [3, 40]},
        {"material.viscosity": 0.05, "cloth.resolution": [19, 2], "cloth.size": [1.0, 0.1]},
    ],
)
def test_a_grids_blocks_are_the_sum_of_its_terms(values):
    dynamics = Scene.from_parameters({"cloth.resolution": [9, 11], **values}).dynamics()
    x = np.ascontiguousarray(Scene.from_parameters({"cloth.resolution": [9, 11], **values}).initial_positions().T)
    x += 0.03 * np.random.default_rng(1).standard_normal(x.shape)
    x[:, 5] = x[:, 4]  # a spring without a direction
    x[:, 20] = x[:, 21] + 1e-9
    by_terms, fused = np.zeros((2, 6, x.shape[1])), np.zeros((2, 6, x.shape[1]))
    for term in dynamics.model.terms:
        if term.name in dynamics.forces.names:
            term.add_stiffness(x, by_terms[0])
            term.add_damping(x, by_terms[1])
    dynamics.forces.add_bounds(x, *fused)
    assert fused == pytest.approx(by_terms, abs=1e-12 * np.abs(by_terms).max())


@pytest.mark.parametrize(
    "values",
    [
        {},
        {"material.damping": 0.0},
        {"material.damping": 0.0, "air.drag": 0.0, "cloth.resolution": [2, 2]},
        {"cloth.shear_layout": "left", "cloth.resolution": [3, 40]},
    ],
)
@pytest.mark.parametrize("crumpled", [0.0, 0.03])
def test_a_grids_rates_are_those_of_its_terms(values, crumpled):
    scene = Scene.from_parameters({"cloth.resolution": [9, 11], **values})
    dynamics = scene.dynamics()
    x = np.ascontiguousarray(scene.initial_positions().T)
    x += crumpled * np.random.default_rng(1).standard_normal(x.shape)
    # Flat, two of the eigenvalues are equal: they come out to the square root of rounding.
    assert dynamics.rates(x) == pytest.approx(Bounds(dynamics.model).rates(x), rel=1e-12 if crumpled else 5e-8)
    x[1, 3] = np.nan
    assert np.isnan(dynamics.rates(x)).all()


@pytest.mark.parametrize("stretch", [1, 33, 8192])
def test_rates_of_a_grid_that_is_held_are_those_of_its_terms(stretch, monkeypatch):
    monkeypatch.setattr(grid_bounds, "_STRETCH", stretch)
    values = {"cloth.resolution": [9, 11], "grippers": ["a", "b"], "gripper.radius": 0.3, "gripper.stiffness": 1e4}
    simulation = Simulation(Scene.from_parameters(values))
    low = simulation.positions[-1]
    before = simulation.dynamics.rates(simulation.state.x)
    simulation.advance([Target("a", low), Target("b", low), Grasp("a", True), Grasp("b", True)])
    x = simulation.state.x
    assert simulation.dynamics.rates(x)[0] > 1.2 * before[0]
    x += 0.03 * np.random.default_rng(1).standard_normal(x.shape)
    dynamics = simulation.dynamics
    found = dynamics.rates(x)
    assert found == pytest.approx(Bounds(dynamics.model).rates(x), rel=1e-12)
    monkeypatch.setattr(grid_bounds, "_STRETCH", 44)
    assert dynamics.rates(x) == found
    x[1, 40] = np.nan
    assert np.isnan(dynamics.rates(x)).all()


def mesh_file(count=1500):
    """A Delaunay triangulation whose neighbours lie far apart in the file."""
    points = np.random.default_rng(4).uniform(size=(count, 2))
    corners = Delaunay(points).simplices
    a, b, c = (points[corners[:, i]] for i in range(3))
    turned = (b - a)[:, 0] * (c - a)[:, 1] < (b - a)[:, 1] * (c - a)[:, 0]
    corners[turned] = corners[turned][:, ::-1]
    lines = [f"v {x} {y} 0" for x, y in points] + [f"f {i + 1} {j + 1} {k + 1}" for i, j, k in corners]
    return "\n".join(lines).encode()


def held_mesh(values):
    common = {"cloth.mesh": "sheet.obj", "cloth.anchors": ["3"], "bending.model": "none", "grippers": ["a", "b"]}
    simulation = Simulation(Scene.from_parameters({**common, **values}, files={"sheet.obj": mesh_file()}))
    place = simulation.positions[-1]
    simulation.advance([Target("a", place), Target("b", place), Grasp("a", True), Grasp("b", True)])
    assert simulation.grippers.held(0).size
    simulation.state.x += 0.01 * np.random.default_rng(1).standard_normal(simulation.state.x.shape)
    return simulation


@pytest.mark.parametrize("stretch", [256, 512, 8192])
@pytest.mark.parametrize("values", [{}, {"material.damping": 0.0, "air.drag": 0.0}], ids=["damped", "undamped"])
def test_rates_of_a_mesh_in_the_order_of_its_loop_are_those_of_its_terms(values, stretch, monkeypatch):
    monkeypatch.setattr(mesh_bounds, "_STRETCH", stretch)
    simulation = held_mesh(values)
    x = simulation.state.x
    x[:, 5] = x[:, next(b for a, b in simulation.model.term("structural").pairs if a == 5)]
    found = [simulation.dynamics.rates(x) for _ in range(2)]
    assert found[0] == found[1]
    assert found[0] == pytest.approx(Bounds(simulation.model).rates(x), rel=1e-12)
    x[1, 40] = np.nan
    assert np.isnan(simulation.dynamics.rates(x)[0])


def test_a_mesh_keeps_no_lists_that_its_loop_has():
    values = {"cloth.mesh": "sheet.obj", "cloth.anchors": ["3"], "bending.model": "none", "integrator": "extrapolated"}
    simulation = Simulation(Scene.from_parameters(values, files={"sheet.obj": mesh_file()}))
    for _ in range(3):
        simulation.advance()
    springs = simulation.model.term("structural")
    assert "pairs" not in vars(springs)
    assert springs.energy(0.0, simulation.state.x) > 0.0
    assert "pairs" in vars(springs)


def test_a_mesh_with_hinges_has_its_bounds_from_all_terms():
    simulation = held_mesh({"bending.model": "crossed", "material.bending_modulus": 1e-4})
    assert simulation.dynamics.plan.bounds is None
    assert np.isfinite(simulation.dynamics.rates(simulation.state.x)).all()


def test_block_rates_are_the_largest_eigenvalues():
    rng = np.random.default_rng(2)
    roots = rng.standard_normal((400, 3, 3))
    matrices = roots @ roots.transpose(0, 2, 1)
    turns = np.linalg.qr(roots)[0]
    for i, eigenvalues in enumerate([(1, 1, 0), (1, 0, 0), (1, 1, 1), (0, 0, 0), (2, 1, 1), (1e9, 1, 1e-9), (5, 5, 4)]):
        matrices[i] = turns[i] @ np.diag(eigenvalues) @ turns[i].T
    blocks = np.stack([matrices[:, i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))])
    inverse_masses = rng.uniform(0.5, 2.0, 400)
    rates = np.empty(400)
    block_rates(np.ascontiguousarray(blocks).reshape(-1), inverse_masses, rates)
    exact = np.linalg.eigvalsh(matrices)[:, -1] * inverse_masses
    assert rates[7:] == pytest.approx(exact[7:], rel=1e-10)
    # A double root is known to the square root of rounding.
    assert rates[:7] == pytest.approx(exact[:7], rel=5e-8, abs=1e-14)


def test_what_is_not_a_number_stays_none():
    blocks = np.zeros((6, 2))
    blocks[3, 1] = np.nan
    rates = np.empty(2)
    block_rates(blocks.reshape(-1), np.ones(2), rates)
    assert rates[0] == 0.0
    assert np.isnan(rates[1])
