# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Spectral bounds of whole cloths: equal in every loop, and above the true eigenvalues."""

import numpy as np
import pytest
from scipy.spatial import Delaunay
from support.alone import blocks, full, matrix, of_blocks

from cloth_sim_ros.engine.binding import check, library
from cloth_sim_ros.physics.model.forces.force import Force
from cloth_sim_ros.physics.model.forces.grid_springs import GridSprings
from cloth_sim_ros.physics.model.forces.pair_springs import PairSprings
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.plan.plan import compile
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Grasp, Target
from cloth_sim_ros.simulation.simulation import Simulation

#: Root of single precision's rounding: small against the 4 % margin of the step limit.
SINGLE = 3e-4
SHEETS = [
    {},
    {"material.damping": 0.0},
    {"material.damping": 0.0, "air.drag": 0.0, "wind.normal_drag": 0.0, "cloth.resolution": [2, 2]},
    {"cloth.shear_layout": "alternating", "bending.model": "none"},
    {"cloth.shear_layout": "alternating", "wind.normal_drag": 0.0},
    {"cloth.shear_layout": "left", "cloth.resolution": [3, 40]},
    {"material.viscosity": 0.05, "cloth.resolution": [19, 2], "cloth.size": [1.0, 0.1]},
]


def listed(model):
    """Return the model with a sheet's springs as lists."""
    forces = [force.pair_springs if isinstance(force, GridSprings) else force for force in model.forces]
    return compile(Model(model.masses, forces, anchors=model.anchors))


def true_rates(plan, x):
    """Return the true largest squared frequency and damping rate; anchored particles do not count."""
    inverse, still = np.tile(np.sqrt(plan.model.inverse_masses), 3), np.zeros_like(x)
    wholes = [matrix(plan, x, still, part) for part in "xv"]
    return [np.linalg.eigvalsh(inverse[:, None] * 0.5 * (whole + whole.T) * inverse)[-1] for whole in wholes]


@pytest.mark.parametrize("values", SHEETS)
@pytest.mark.parametrize("crumpled", [0.0, 0.03])
def test_sheet_bounds_are_those_of_its_springs_one_by_one(values, crumpled):
    scene = Scene.from_parameters({"cloth.resolution": [9, 11], **values})
    plan = scene.plan()
    x = np.ascontiguousarray(scene.initial_positions().T)
    x += crumpled * np.random.default_rng(1).standard_normal(x.shape)
    if crumpled and x.shape[1] > 30:
        x[:, 5] = x[:, 4]  # a spring without a direction
    single = listed(plan.model)
    # A sheet's bounds are calculated in single precision. Two nearly equal eigenvalues are accurate to its root.
    assert plan.spectral_bounds(x) == pytest.approx(of_blocks(single, x), rel=SINGLE)
    x[:, 3] = x[:, 2] + 1e-9  # as good as none
    for grid_blocks, single_blocks in zip(blocks(plan, x), blocks(single, x), strict=True):
        assert grid_blocks == pytest.approx(single_blocks, abs=1e-12 * np.abs(single_blocks).max())
    assert np.isfinite(plan.spectral_bounds(x)).all()
    x[1, 3] = np.nan
    for checked_plan in (plan, single):
        assert np.isnan(checked_plan.spectral_bounds(x)[0])


@pytest.mark.parametrize("values", SHEETS)
@pytest.mark.parametrize("crumpled", [0.0, 0.01])
def test_spectral_bounds_are_tight_upper_bounds(values, crumpled):
    scene = Scene.from_parameters({"cloth.resolution": [6, 5], **values})
    plan = scene.plan()
    x = np.ascontiguousarray(scene.initial_positions().T)
    x += crumpled * np.random.default_rng(1).standard_normal(x.shape)
    for true, rate, sharper in zip(
        true_rates(plan, x), plan.spectral_bounds(x), listed(plan.model).spectral_bounds(x), strict=True
    ):
        assert true <= sharper * (1.0 + SINGLE) <= rate * (1.0 + SINGLE) ** 2
        # Next to anchors, and at compressed or crossing springs, the bound is looser than within a flat sheet.
        assert rate <= 4.0 * true + 1e-9


def test_bounds_of_a_grasped_sheet_add_springs_and_grips():
    values = {"cloth.resolution": [9, 11], "grippers": ["a", "b"], "gripper.radius": 0.3, "gripper.stiffness": 1e4}
    simulation = Simulation(Scene.from_parameters(values))
    low = simulation.positions[-1]
    before = simulation.plan.spectral_bounds(simulation.state.x)
    simulation.advance([Target("a", low), Target("b", low), Grasp("a", True), Grasp("b", True)])
    x = simulation.state.x
    assert simulation.plan.spectral_bounds(x)[0] > 1.2 * before[0]
    x += 0.03 * np.random.default_rng(1).standard_normal(x.shape)
    bounds = simulation.plan.spectral_bounds(x)
    largest = [
        max(np.linalg.eigvalsh(full(bound[:, [p]]))[-1] * inverse for p, inverse in enumerate(inverses))
        for bound, inverses in zip(blocks(simulation.plan, x), [simulation.model.inverse_masses] * 2, strict=True)
    ]
    assert bounds == pytest.approx(largest, rel=SINGLE), "both grippers count where both hold"


def mesh_file(count=1500):
    """Return a Delaunay triangulation whose neighbours lie far apart in the file."""
    points = np.random.default_rng(4).uniform(size=(count, 2))
    corners = Delaunay(points).simplices
    a, b, c = (points[corners[:, i]] for i in range(3))
    turned = (b - a)[:, 0] * (c - a)[:, 1] < (b - a)[:, 1] * (c - a)[:, 0]
    corners[turned] = corners[turned][:, ::-1]
    lines = [f"v {x} {y} 0" for x, y in points] + [f"f {i + 1} {j + 1} {k + 1}" for i, j, k in corners]
    return "\n".join(lines).encode()


@pytest.mark.parametrize(
    "values",
    [
        {},
        {"material.damping": 0.0, "air.drag": 0.0, "wind.normal_drag": 0.0},
        {"bending.model": "crossed", "material.bending_modulus": 1e-4},
    ],
    ids=["damped", "undamped", "hinges"],
)
def test_bounds_of_a_grasped_mesh_are_below_its_largest_block(values):
    common = {"cloth.mesh": "sheet.obj", "cloth.anchors": ["3"], "bending.model": "none", "grippers": ["a", "b"]}
    simulation = Simulation(Scene.from_parameters({**common, **values}, files={"sheet.obj": mesh_file()}))
    position = simulation.positions[-1]
    simulation.advance([Target("a", position), Target("b", position), Grasp("a", True), Grasp("b", True)])
    assert simulation.grippers.grasped_particles(0).size
    x = simulation.state.x
    x += 0.01 * np.random.default_rng(1).standard_normal(x.shape)
    if not values.get("bending.model"):
        x[:, 5] = x[:, next(b for a, b in simulation.model.force("structural").pairs if a == 5)]
    for rate, even in zip(simulation.plan.spectral_bounds(x), of_blocks(simulation.plan, x), strict=True):
        assert 0.5 * even <= rate <= even * (1.0 + 1e-12)
    x[1, 40] = np.nan
    assert np.isnan(simulation.plan.spectral_bounds(x)[0])


@pytest.mark.parametrize("bending", ["none", "crossed", "altitude", "quadratic", "shape_operator"])
@pytest.mark.parametrize("crumpled", [0.0, 0.01])
@pytest.mark.parametrize("scale", [1e-6, 1e-3])
def test_bounds_of_an_irregular_mesh_are_tight_upper_bounds(bending, crumpled, scale):
    values = {"cloth.mesh": "sheet.obj", "cloth.anchors": ["3"], "bending.model": bending}
    if bending != "none":
        values["material.bending_modulus"] = scale
    plan = (scene := Scene.from_parameters(values, files={"sheet.obj": mesh_file(120)})).plan()
    x = np.ascontiguousarray(scene.initial_positions().T)
    x += crumpled * np.random.default_rng(1).standard_normal(x.shape)
    for true, rate, even in zip(true_rates(plan, x), plan.spectral_bounds(x), of_blocks(plan, x), strict=True):
        assert true <= rate * (1.0 + 1e-9)
        assert rate <= even * (1.0 + 1e-12)
        if not crumpled:
            # A light particle in a sliver of the mesh is an outlier: equal weights are wrong by up to a factor of two.
            assert rate <= 1.25 * true


def test_light_particle_distributes_its_bound_to_heavy_ones():
    # A star: a light particle on springs k to heavy ones moves as if they stood still, w^2 = 2 k / m.
    angles = np.pi / 2.0 * np.arange(4)
    x = np.concatenate([np.zeros((3, 1)), [np.cos(angles), np.sin(angles), 0.0 * angles]], axis=1)
    springs = PairSprings([[0, i] for i in range(1, 5)], 1.0, 100.0, 2.0)
    plan = compile(Model([1e-3, 1.0, 1.0, 1.0, 1.0], [springs]))
    omega2, damping = plan.spectral_bounds(x)
    assert of_blocks(plan, x) == pytest.approx([4e5, 8e3])
    assert 2e5 < omega2 < 2.4e5
    assert 4e3 < damping < 4.8e3


class Tether(Force):
    """A Python force: isotropic springs of stiffness k and damping c from every particle to the origin."""

    name = "tether"
    damped = True

    def __init__(self, k, c):
        self.k, self.c = k, c

    def add_force(self, t, x, v, f):
        f -= self.k * x + self.c * v

    def add_stiffness(self, x, bound):
        bound[:3] += self.k

    def add_damping(self, x, bound):
        bound[:3] += self.c


def test_bounds_of_a_python_force_add_to_those_of_the_engine():
    scene = Scene.from_parameters({"cloth.resolution": [5, 4]})
    model = scene.model()
    x = np.ascontiguousarray(scene.initial_positions().T) + 0.02 * np.random.default_rng(3).standard_normal((3, 20))
    both = compile(Model(model.masses, [*model.forces, Tether(3e4, 7.0)], anchors=model.anchors))
    alone = scene.plan()
    for both_blocks, engine_blocks, added in zip(blocks(both, x), blocks(alone, x), (3e4, 7.0), strict=True):
        assert both_blocks[:3] == pytest.approx(engine_blocks[:3] + added, rel=1e-14)
        assert both_blocks[3:] == pytest.approx(engine_blocks[3:], rel=1e-14)
    # An isotropic part shifts all eigenvalues alike.
    expected = [
        max((np.linalg.eigvalsh(full(b[:, [p]]))[-1] + added) * model.inverse_masses[p] for p in range(20))
        for b, added in zip(blocks(alone, x), (3e4, 7.0), strict=True)
    ]
    assert both.spectral_bounds(x) == pytest.approx(expected, rel=1e-10)


def eigenvalues(bound):
    largest = np.empty(bound.shape[1])
    check(library().cloth_eigenvalues(np.ascontiguousarray(bound).ctypes.data, bound.shape[1], largest.ctypes.data))
    return largest


def test_largest_eigenvalues_are_those_of_numpy():
    rng = np.random.default_rng(2)
    roots = rng.standard_normal((401, 3, 3))
    matrices = roots @ roots.transpose(0, 2, 1)
    turns = np.linalg.qr(roots)[0]
    for i, diagonal in enumerate([(1, 1, 0), (1, 0, 0), (1, 1, 1), (0, 0, 0), (2, 1, 1), (1e9, 1, 1e-9), (5, 5, 4)]):
        matrices[i] = turns[i] @ np.diag(diagonal) @ turns[i].T
    bound = np.stack([matrices[:, i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))])
    calculated, exact = eigenvalues(bound), np.linalg.eigvalsh(matrices)[:, -1]
    assert calculated[7:] == pytest.approx(exact[7:], rel=1e-10)
    # A double root is known to the square root of rounding.
    assert calculated[:7] == pytest.approx(exact[:7], rel=5e-8, abs=1e-14)


def test_nan_blocks_give_nan_eigenvalues():
    bound = np.zeros((6, 2))
    bound[3, 1] = np.nan
    calculated = eigenvalues(bound)
    assert calculated[0] == 0.0
    assert np.isnan(calculated[1])
