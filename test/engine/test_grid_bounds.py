# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Spectral bounds of a sheet's panels, added mass and quadratic hinges by rows: the bits of those from lists."""

from __future__ import annotations

import numpy as np
import pytest
from support.alone import of_blocks

from cloth_sim_ros.physics.model.forces.added_mass import AddedMass
from cloth_sim_ros.physics.model.forces.air_panels import AirPanels
from cloth_sim_ros.physics.model.forces.force import Force
from cloth_sim_ros.physics.model.forces.grid_springs import GridSprings
from cloth_sim_ros.physics.model.forces.quadratic import QuadraticHinges
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.model.parts import GridFamily
from cloth_sim_ros.physics.model.sheets.bending import grid_hinge_weights
from cloth_sim_ros.physics.model.sheets.surface import grid_cells, grid_hinges
from cloth_sim_ros.physics.plan.plan import compile
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Grasp, Target
from cloth_sim_ros.simulation.simulation import Simulation

SPACING, MASS, WIND = 0.05, 2e-3, (3.0, -20.0, 0.5)
SHAPES = [(2, 2), (2, 9), (9, 2), (3, 3), (7, 38), (8, 40), (19, 16)]
FORCES = ["mass", "mass drag", "hinges mass", "drag hinges mass", "mass hinges drag"]


class NoForce(Force):
    """A force in numpy without effect; a plan that has one takes its bounds from lists."""

    name = "none"

    def add_force(self, t, x, v, f):
        pass


def sheet(shape, names="mass", *, left_out=0.0, light=0.0, order=None):
    """A creased sheet whose forces are in the given order, and its positions; `order` of the cells' corners."""
    rows, columns = shape
    random = np.random.default_rng(5)
    cells = grid_cells(rows, columns)
    cells = cells[(random.random(len(cells)) >= left_out) | (np.arange(len(cells)) == 0)]
    if order is not None:
        cells = cells[:, order]
    hinges = grid_hinges(rows, columns)
    weights = grid_hinge_weights(hinges, columns=columns, spacing=(SPACING, SPACING))
    families = [
        GridFamily(name=name, stiffness=3.0, rest_length=reach * SPACING, damping=2e-3)
        for name, reach in (("right", 1.0), ("down", 1.0), ("diagonal", 2.0**0.5), ("antidiagonal", 2.0**0.5))
    ]
    forces = {
        "mass": AddedMass(cells, density=0.5, wind=WIND),
        "drag": AirPanels(cells, normal=0.3, tangential=0.05, wind=WIND),
        "hinges": QuadraticHinges(hinges, weights, random.uniform(0.5e-3, 2e-3, len(hinges)), 3e-3),
    }
    masses = MASS * np.where(random.random(rows * columns) < light, 0.1, 1.0)
    x = np.zeros((3, rows, columns))
    x[0], x[1] = SPACING * np.arange(columns), -SPACING * np.arange(rows)[:, None]
    x = x.reshape(3, -1) + random.uniform(-0.2, 0.2, (3, rows * columns)) * SPACING
    springs = GridSprings(rows, columns, families)
    return Model(masses, [springs, *(forces[name] for name in names.split())], anchors=[0]), np.ascontiguousarray(x)


def both_bounds(model, x):
    """Bounds by rows, and from lists."""
    with_numpy = Model(model.masses, [*model.forces, NoForce()], anchors=model.anchors)
    return [compile(of).detailed_spectral_bounds(x) for of in (model, with_numpy)]


@pytest.mark.parametrize("names", FORCES)
@pytest.mark.parametrize("left_out", [0.0, 0.2])
@pytest.mark.parametrize("shape", SHAPES)
def test_bounds_by_rows_have_the_bits_of_lists(shape, left_out, names):
    rows, lists = both_bounds(*sheet(shape, names, left_out=left_out))
    assert rows == lists and rows[0] > 0.0 and rows[1] > 0.0


@pytest.mark.parametrize("names", FORCES)
def test_refined_bounds_by_rows_have_the_bits_of_lists(names):
    model, x = sheet((19, 16), names, light=0.03)
    rows, lists = both_bounds(model, x)
    assert rows == lists
    uniform = sheet((19, 16), names)[0]
    assert rows[0] > compile(uniform).spectral_bounds(x)[0], "light particles count"


@pytest.mark.parametrize("order", [[1, 2, 3, 0], [3, 2, 1, 0]])
def test_bounds_of_cells_in_another_order_are_close(order):
    rows, rotated = (compile(sheet((7, 38), "mass drag", order=of)[0]) for of in (None, order))
    x = sheet((7, 38))[1]
    assert rows.spectral_bounds(x) == pytest.approx(rotated.spectral_bounds(x), rel=1e-12)


def test_bounds_by_rows_include_grips():
    values = {"cloth.resolution": [9, 11], "grippers": ["a"], "gripper.radius": 0.2, "gripper.stiffness": 1e4}
    values |= {"air.added_mass": 0.07, "wind.velocity": [0.0, 3.0, 0.0]}
    simulation = Simulation(Scene.from_parameters(values))
    x = simulation.state.x.copy()
    before = simulation.plan.spectral_bounds(x)
    simulation.advance([Target("a", simulation.positions[-1]), Grasp("a", True)])
    bounds = simulation.plan.spectral_bounds(x)
    assert bounds[0] > 1.2 * before[0]
    assert bounds == pytest.approx(of_blocks(simulation.plan, x), rel=1e-9)


def test_panel_whose_corners_coincide_has_finite_bounds():
    model, x = sheet((7, 38))
    for particle in (3, 41, 42):
        x[:, particle] = x[:, 4]
    for bounds in both_bounds(model, x):
        assert np.isfinite(bounds).all()
