# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Obstacle features against a cloth's surface: energy, forces, recorded wrenches, bounds."""

import numpy as np
import pytest
from support import laws, self_scenes
from support.alone import blocks, force, gradient, matrix, product
from support.contact_scenes import still
from support.feature_scenes import SMALL, THICKNESS, TIME, energy, facing_scene, world_features

from cloth_sim_ros.physics.accounting.work_accumulator import RECORD_NUMBERS
from cloth_sim_ros.physics.contact.obstacle_features import is_covered_by_particles, obstacle_features
from cloth_sim_ros.physics.contact.obstacles import Obstacle
from cloth_sim_ros.physics.model.forces.contact import Contact, ContactSurface
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.plan.plan import compile

every_shape = pytest.mark.parametrize("shape", SMALL)
each_seed = pytest.mark.parametrize("seed", [0, 1])


def columns(x):
    return np.ascontiguousarray(x.T)


def of_particles(plan, x):
    """Return the energy of the particles' contact."""
    expected, _ = laws.contact(TIME, x, np.zeros_like(x), plan.contact.force, plan.model.masses)
    return expected.energy


@every_shape
@each_seed
def test_the_energy_is_that_of_every_pair(shape, seed):
    plan, triangles, x, masses, path = facing_scene(SMALL[shape], seed)
    expected = energy(SMALL[shape], path, triangles, x, masses)
    assert expected > 1e-4
    whole = expected + of_particles(plan, columns(x))
    assert plan.energies(TIME, columns(x), None, memory={})[1] == pytest.approx(whole, rel=1e-7)


@every_shape
@each_seed
def test_undamped_force_is_minus_the_energy_gradient(shape, seed):
    plan, _, x, _, _ = facing_scene(SMALL[shape], seed, damping=0.0)
    slopes = gradient(lambda places: plan.energies(TIME, places, None, memory={})[1], columns(x), step=1e-8)
    assert np.abs(slopes).max() > 1.0
    assert force(plan, columns(x), t=TIME) == pytest.approx(-slopes, abs=2e-5 * np.abs(slopes).max())


@every_shape
@each_seed
def test_recorded_wrench_is_the_force_on_the_cloth(shape, seed):
    plan, _, x, _, path = facing_scene(SMALL[shape], seed)
    rng = np.random.default_rng(seed)
    v = rng.normal(size=x.shape)
    cloth_force = force(plan, columns(x), columns(v), TIME).T
    wrench = plan.contact.wrench_rates(TIME, columns(x), columns(v), memory={})[0]
    size = np.abs(cloth_force).max()
    assert wrench[:3] == pytest.approx(-cloth_force.sum(axis=0), abs=1e-11 * size)
    position = laws.pose(path, TIME)[0]
    assert wrench[3:6] == pytest.approx(-np.cross(x - position, cloth_force).sum(axis=0), abs=1e-11 * size)
    # The obstacle's work is dissipated, moves the cloth, or is stored: by differences of time.
    h = 1e-8
    ends = [plan.energies(TIME + s * h, columns(x + s * h * v), None, memory={})[1] for s in (1.0, -1.0)]
    grown = (ends[0] - ends[1]) / (2.0 * h)
    terms = np.array([grown, (cloth_force * v).sum(), wrench[6], wrench[7]])
    assert wrench[7] >= 0.0
    assert grown + (cloth_force * v).sum() == pytest.approx(wrench[6] - wrench[7], abs=1e-5 * np.abs(terms).max())
    assert len(wrench) == RECORD_NUMBERS


@every_shape
@each_seed
def test_the_derivative_product_is_that_of_the_force(shape, seed):
    plan, _, x, _, _ = facing_scene(SMALL[shape], seed)
    rng = np.random.default_rng(seed)
    v, dx, dv = rng.normal(size=(3, *x.T.shape))
    x, h = columns(x), 1e-9
    by_place = (force(plan, x + h * dx, v, TIME) - force(plan, x - h * dx, v, TIME)) / (2 * h)
    by_speed = (force(plan, x, v + 1e-5 * dv, TIME) - force(plan, x, v - 1e-5 * dv, TIME)) / 2e-5
    zero = np.zeros_like(x)
    assert product(plan, x, v, dx, zero, TIME) == pytest.approx(by_place, abs=1e-4 * np.abs(by_place).max())
    assert product(plan, x, v, zero, dv, TIME) == pytest.approx(by_speed, abs=1e-5 * np.abs(by_speed).max())


@every_shape
@each_seed
def test_bounds_hold_at_rest(shape, seed):
    path = still((0.3, -0.2, 0.1), np.array([0.5, -0.5, 0.1, 0.7]))
    plan, _, x, _, _ = facing_scene(SMALL[shape], seed, path=path)
    x = columns(x)
    zero = np.zeros_like(x)
    stiff, damped = blocks(plan, x)
    for part, bound in (("x", stiff), ("v", damped)):
        whole = matrix(plan, x, zero, part, TIME)
        whole = 0.5 * (whole + whole.T)
        most = np.linalg.eigvalsh(whole)[-1]
        largest = bound[:3].sum(axis=0).max()
        assert 0.0 < most <= largest * (1.0 + 1e-9)


def test_feature_force_ends_at_half_the_thickness():
    box = SMALL["box"]
    for gap, acts in ((0.499, True), (0.501, False)):
        plan, _, x, _, _ = facing_scene(box, gap=gap, damping=0.0)
        assert (plan.energies(TIME, columns(x), None, memory={})[1] > of_particles(plan, columns(x)) + 1e-15) == acts
    plan, _, x, _, _ = facing_scene(box, anchors=range(16))
    assert plan.energies(TIME, columns(x), None, memory={})[1] == 0.0


def test_point_force_is_independent_of_the_triangulation():
    triangles, rest_positions, x, masses = self_scenes.sheets(0.0, rows=5, columns=5)
    ball = Obstacle(name="ball", shape="sphere", size=(0.005,))
    faces = ContactSurface(triangles, rest_positions, thickness=THICKNESS)
    # Particles are out of its reach at the positions that count, because the gap is 0.4 of the thickness.
    contact_force = Contact([ball], thickness=THICKNESS, damping=0.0, faces=faces)
    plan = compile(Model(masses, [contact_force]))
    s = 0.8
    expected = masses.mean() * 35.0**2 / THICKNESS * (1.0 - s) ** 3 * (1.0 + 3.0 * s) / s**2
    offsets = np.random.default_rng(0).uniform(0.02, 0.06, (60, 2))
    for offset in [*offsets, [0.03, 0.03], [0.04, 0.03], [0.035, 0.03], [0.04, 0.04]]:
        contact_force.set_paths(np.array([still((*offset, -0.005 - 0.5 * s * THICKNESS))]))
        point_force = plan.contact.wrench_rates(0.0, columns(x), np.zeros_like(columns(x)), memory={})[0, :3]
        particles, _ = laws.contact(0.0, columns(x), np.zeros_like(columns(x)), contact_force, masses)
        assert point_force + particles.force.sum(axis=1) == pytest.approx([0.0, 0.0, -expected], abs=1e-9 * expected)


def test_features_are_corners_edges_centres_and_axes_of_shapes():
    box, marble, pin, coin = (
        obstacle_features(SMALL[shape], THICKNESS) for shape in ("box", "sphere", "capsule", "cylinder")
    )
    assert len(box.points) == 8
    lengths = np.linalg.norm(box.points[box.edges[:, 0]] - box.points[box.edges[:, 1]], axis=1)
    assert np.sort(lengths) == pytest.approx(np.repeat([0.02, 0.03, 0.05], 4))
    assert (marble.points.tolist(), len(marble.edges), marble.radius) == ([[0.0, 0.0, 0.0]], 0, 0.006)
    assert (pin.points[:, 2].tolist(), pin.edges.tolist(), pin.radius) == ([-0.025, 0.025], [[0, 1]], 0.004)
    # On the rims, chords inside them by a twentieth of the thickness; and lines along the side.
    assert np.hypot(*coin.points[:, :2].T) == pytest.approx(np.full(len(coin.points), 0.008))
    assert np.abs(coin.points[:, 2]) == pytest.approx(np.full(len(coin.points), 0.002))
    middles = 0.5 * (coin.points[coin.edges[:, 0]] + coin.points[coin.edges[:, 1]])
    inward = 0.008 - np.hypot(*middles[:, :2].T)
    assert -1e-15 < inward.min() <= inward.max() <= 0.05 * THICKNESS
    assert len(coin.edges) == 3 * len(coin.points) // 2
    assert world_features(SMALL["sphere"], still((1.0, 2.0, 3.0)))[0] == pytest.approx(np.array([[1.0, 2.0, 3.0]]))


@pytest.mark.parametrize("radius", [0.02, 0.2, 2.0])
def test_ball_penetration_below_tenth_radius_needs_no_features(radius):
    # Equilateral triangles around the ball, with corners at three quarters of the thickness, stretched by a tenth.
    particle_distance = radius + 0.75 * THICKNESS
    least = {}
    for longest in np.linspace(1e-3, 1.2 * radius, 400):
        inward = (1.1 * longest) ** 2 / 3.0
        least[longest] = (particle_distance * particle_distance - inward) ** 0.5 - 0.9 * radius
        assert is_covered_by_particles(radius, longest, THICKNESS) == (least[longest] >= 0.0)
    assert min(least.values()) < 0.0 < max(least.values())
    # No other triangle of such sides comes nearer.
    rng = np.random.default_rng(0)
    longest = max(length for length, gap in least.items() if gap >= 0.0)
    for _ in range(200):
        direction = rng.normal(size=3) * [1.0, 1.0, 0.0]
        corners = (
            particle_distance * np.array([0.0, 0.0, 1.0])
            + rng.normal(size=(3, 3)) * 0.5 * longest
            + 0.1 * longest * direction
        )
        corners *= np.maximum(particle_distance / np.linalg.norm(corners, axis=1), 1.0)[:, None]
        sides = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).max()
        if sides <= 1.1 * longest:
            assert self_scenes.on_triangle(np.zeros(3), *corners) >= 0.9 * radius
