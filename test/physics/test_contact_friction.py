# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Friction: Coulomb's cone, anchors that stay fixed inside it, and their use in runs and states."""

import attrs
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import laws
from support.alone import alone, force, product
from support.contact_scenes import SHAPES, THICKNESS, contact, drop, flat_sheet, moving, points_near, still

from cloth_sim_ros.physics.accounting.energy_balance import EnergyBalance
from cloth_sim_ros.physics.contact.obstacles import Obstacle
from cloth_sim_ros.physics.model.forces.gravity import Gravity
from cloth_sim_ros.physics.plan.plan import compile
from cloth_sim_ros.physics.state.controller_state import ANCHORS_KEY
from cloth_sim_ros.physics.state.state import State

FRAME = 1.0 / 60.0
COUNT = 40
every_shape = pytest.mark.parametrize("shape", SHAPES)


def about(shape, rough=(0.6, 0.4), frequency=2000.0, seed=0):
    """Return one moving obstacle with friction, particles in contact, and anchors near them: none, sticking and
    sliding.
    """
    rng = np.random.default_rng(seed)
    path = moving(seed)
    obstacle = attrs.evolve(SHAPES[shape], friction=rough)
    contact_force = contact(obstacle, paths=[path])
    contact_force.frequency = frequency
    x = points_near(obstacle, path, 0.3, COUNT, rng, deepest=0.6, farthest=0.97)
    masses = rng.uniform(0.5, 2.0, COUNT)
    plan = alone(contact_force, masses=masses)
    position, velocity, rotation, turning = laws.pose(path, 0.3)
    # Relative to the obstacle: from slower than static friction allows to faster than kinetic friction.
    v = 10.0 ** rng.uniform(-3.0, -0.5, COUNT) * rng.normal(size=x.shape)
    v += velocity[:, None] + turning @ (rotation.T @ (x - position[:, None]))
    anchors = np.zeros((1, 4, COUNT))
    anchors[0, 3] = rng.integers(0, 3, COUNT)
    anchors[0, :3] = rotation.T @ (x - position[:, None]) + 10.0 ** rng.uniform(-6, -2, COUNT) * rng.normal(
        size=x.shape
    )
    anchors[0, :3] *= anchors[0, 3] > 0.0
    return contact_force, plan, masses, x, v, anchors


def by_formulas(contact_force, masses, x, v, anchors):
    """Return forces (3, n), dragged anchors, and the dissipated power, contact by contact from the formulas."""
    plain, _ = laws.contact(0.3, x, v, contact_force, masses)
    total, dragged, dissipation = plain.force.copy(), anchors.copy(), plain.dissipation
    position, velocity, rotation, turning = laws.pose(contact_force.paths[0], 0.3)
    for i in range(x.shape[1]):
        arm = x[:, i] - position
        local_position = rotation.T @ arm
        _, normals = contact_force.obstacles[0].distance(local_position[None])
        normal = rotation @ normals[0]
        bond = anchors[0, 3, i]
        anchor_offset = rotation @ (local_position - anchors[0, :3, i]) if bond else np.zeros(3)
        slip = v[:, i] - velocity - turning @ local_position
        pressure = plain.force[:, i] @ normal / masses[i]
        acceleration, stretch, slides = laws.friction(
            anchor_offset, normal, slip, pressure, contact_force.obstacles[0].friction, contact_force.frequency
        )
        total[:, i] += masses[i] * acceleration
        dissipation -= masses[i] * (
            acceleration @ slip + (0.0 if slides else contact_force.frequency**2 * stretch @ slip)
        )
        if slides:
            dragged[0, :3, i] = local_position - rotation.T @ stretch
        elif not bond:
            dragged[0, :3, i] = local_position
        dragged[0, 3, i] = 2.0 if slides else 1.0
    return total, dragged, dissipation


@every_shape
def test_forces_and_anchors_are_those_of_the_formulas(shape):
    contact_force, plan, masses, x, v, anchors = about(shape)
    expected, dragged, dissipation = by_formulas(contact_force, masses, x, v, anchors)
    memory = {ANCHORS_KEY: anchors}
    plain, _ = laws.contact(0.3, x, v, contact_force, masses)
    assert np.abs(expected - plain.force).max() > 10.0
    scale = np.abs(expected).max()
    assert force(plan, x, v, 0.3, memory) == pytest.approx(expected, rel=1e-8, abs=1e-9 * scale)
    assert plan.contact.wrench_rates(0.3, x, v, memory)[0, :3] == pytest.approx(
        -expected.sum(axis=1), abs=1e-9 * scale * COUNT
    )
    assert plan.dissipation(0.3, x, v, memory) == pytest.approx(dissipation, rel=1e-8)
    new_anchors = plan.contact.combine_anchors(0.3, x, v, anchors[None], [1.0], memory)
    assert new_anchors == pytest.approx(dragged, abs=1e-12)
    # Inside the cone not a bit moves.
    stays = (dragged[0] == anchors[0]).all(axis=0)
    assert stays.any()
    assert np.array_equal(new_anchors[0][:, stays], anchors[0][:, stays])


@every_shape
def test_derivative_product_includes_friction(shape):
    _, plan, _, x, v, _ = about(shape, frequency=300.0)
    rng = np.random.default_rng(2)
    dx, dv, zero = rng.normal(size=x.shape), rng.normal(size=x.shape), np.zeros_like(x)
    by_speed = (force(plan, x, v + 1e-6 * dv, 0.3) - force(plan, x, v - 1e-6 * dv, 0.3)) / 2e-6
    by_place = (force(plan, x + 1e-9 * dx, v, 0.3) - force(plan, x - 1e-9 * dx, v, 0.3)) / 2e-9
    assert product(plan, x, v, zero, dv, 0.3) == pytest.approx(by_speed, abs=1e-4 * np.abs(by_speed).max())
    assert product(plan, x, v, dx, zero, 0.3) == pytest.approx(by_place, abs=1e-3 * np.abs(by_place).max())


def on_a_slope(rough, degrees, frames, *, count=6, listed=False, tolerance=1e-4, integrator="auto"):
    """Return mean positions (frames, 3) along a slope of a sheet that starts at rest, its plan and its state."""
    turn = Rotation.from_euler("y", degrees, degrees=True)
    slope = Obstacle(name="slope", shape="plane", friction=rough)
    contact_force = contact(slope, paths=[still(orientation=turn.as_quat())])
    model, places = flat_sheet(count, count, contact_force, size=0.3, drag=False, listed=listed)
    plan, state, steps = drop(
        model, turn.apply(places + np.array([0.0, 0.0, 0.98 * THICKNESS])), tolerance=tolerance, integrator=integrator
    )
    means = []
    for k in range(frames):
        steps.advance(plan, state, k * FRAME, FRAME)
        means.append(turn.inv().apply(state.positions).mean(axis=0))
    return np.array(means), plan, state


@pytest.mark.parametrize("listed", [False, True])
@pytest.mark.parametrize("mu", [0.1, 0.5, 1.0])
def test_sheet_slips_within_0_1_degree_of_the_friction_angle(mu, listed):
    steep = np.degrees(np.arctan(mu))
    below, _, state = on_a_slope((mu, mu), steep - 0.1, 60, listed=listed)
    # It settles first; then it moves by less than a nanometre, and no anchor changes a bit.
    assert np.abs(below[-1] - below[-30]).max() < 1e-9
    assert (state.memory[ANCHORS_KEY][0, 3] == 1.0).all()
    above, _, state = on_a_slope((mu, mu), steep + 0.1, 60, listed=listed)
    assert above[-1, 0] - above[0, 0] > 1e-3
    assert (state.memory[ANCHORS_KEY][0, 3] == 2.0).all()


@pytest.mark.parametrize("mu", [0.1, 0.5, 1.0])
def test_sliding_sheet_accelerates_by_kinetic_friction(mu):
    steep = np.degrees(np.arctan(mu)) + 5.0
    means, _, _ = on_a_slope((mu, 0.8 * mu), steep, 45)
    angle = np.radians(steep)
    expected = 9.81 * (np.sin(angle) - 0.8 * mu * np.cos(angle))
    acceleration = (means[-1, 0] - 2.0 * means[-16, 0] + means[-31, 0]) / (15 * FRAME) ** 2
    assert acceleration == pytest.approx(expected, rel=1e-2)


def test_anchors_keep_their_bits_while_a_sheet_sticks():
    # Before it is at rest the normal force oscillates, and with it the cone: this test needs a state of rest.
    _, plan, state = on_a_slope((0.5, 0.5), 20.0, 60)
    first_anchors = state.memory[ANCHORS_KEY].copy()
    _, _, steps = drop(plan.model, state.positions, tolerance=1e-4)
    for k in range(60):
        steps.advance(plan, state, 1.0 + k * FRAME, FRAME)
        assert np.array_equal(state.memory[ANCHORS_KEY], first_anchors)
    assert np.abs(state.v).max() < 1e-9


@pytest.mark.parametrize("integrator", ["leapfrog", "implicit", "symplectic_euler"])
def test_every_integrator_holds_a_sheet_on_a_slope(integrator):
    tolerance = None if integrator == "symplectic_euler" else 1e-4
    means, _, state = on_a_slope((0.5, 0.5), 20.0, 40, tolerance=tolerance, integrator=integrator)
    # Implicit steps are as long as a frame, and anchors follow after each of them: the sheet comes to rest more slowly.
    assert np.abs(means[-1] - means[-15]).max() < (1e-5 if integrator == "implicit" else 1e-6)
    assert (state.memory[ANCHORS_KEY][0, 3] == 1.0).all()


@pytest.mark.parametrize("shape", ["plane", "cylinder"])
def test_sliding_converges_with_second_order(shape):
    """A particle on a turntable, its contact oscillating under its weight: half steps give a quarter of the error."""
    obstacle = attrs.evolve(SHAPES[shape], friction=(0.5, 0.3))
    path = still((0.0, 0.0, 0.0 if shape == "plane" else -0.5 * obstacle.size[1]))
    path[17:20] = [0.0, 0.0, 20.0]
    plan = alone(contact(obstacle, paths=[path]), Gravity([0.0, 0.0, -9.81]), count=1)
    x, v = np.array([[0.05], [0.0], [0.97 * THICKNESS]]), np.array([[0.5], [0.2], [0.0]])
    counts = [100, 200, 400, 12800]
    ends = [run.x for run in plan.runs(0.0, 0.05, (x, v), counts, record_obstacles=True, memory={})[0]]
    errors = np.array([np.linalg.norm(end - ends[-1]) for end in ends[:-1]])
    assert (errors[:-1] > 3.4 * errors[1:]).all()


def test_friction_takes_energy_and_the_balance_closes():
    table = Obstacle(name="table", shape="plane", friction=(0.5, 0.3))
    model, places = flat_sheet(10, 10, contact(table), size=0.3, drag=False)
    places[:, 2] = 0.98 * THICKNESS
    plan, state, integrator = drop(model, places, (1.0, 0.3, 0.0), tolerance=1e-5)
    balance = EnergyBalance(plan, state)
    energy = plan.energy(0.0, state.x, state.v, memory=state.memory)
    for k in range(30):
        integrator.advance(plan, state, k * FRAME, FRAME, balance.accumulator)
        residual = balance.add_advance((k + 1) * FRAME, state)
        now = plan.energy(0.0, state.x, state.v, memory=state.memory)
        assert now <= energy * (1.0 + 1e-6)
        assert abs(residual) < 1e-3 * balance.energy_turnover
        energy = now
    assert np.abs(state.v).max() < 1e-3
    # 1.044 m/s come to rest within v^2 / (2 mu g).
    displacement = np.linalg.norm(state.x[:2].mean(axis=1))
    assert displacement == pytest.approx((1.0 + 0.09) / (2.0 * 0.3 * 9.81), rel=1e-2)


def test_a_sheet_is_carried_by_a_table_that_speeds_up_gently():
    table = Obstacle(name="table", shape="plane", friction=(0.5, 0.5))
    path = still()
    contact_force = contact(table, paths=[path])
    model, places = flat_sheet(8, 8, contact_force, size=0.3, drag=False)
    places[:, 2] = 0.98 * THICKNESS
    plan, state, integrator = drop(model, places, tolerance=1e-4)
    for k in range(40):
        integrator.advance(plan, state, k * FRAME, FRAME)
    # 2 m/s^2 are less than mu g: x = t^2 from t = 40 frames on.
    path[0], path[7] = 40 * FRAME, 1.0
    contact_force.set_paths(path[None])
    start = state.x.copy()
    for k in range(40, 70):
        integrator.advance(plan, state, k * FRAME, FRAME)
    gone = state.x[0] - start[0]
    assert gone == pytest.approx(np.full(64, (30 * FRAME) ** 2), abs=1e-5)
    assert (state.memory[ANCHORS_KEY][0, 3] == 1.0).all()


@pytest.mark.parametrize("listed", [False, True])
def test_no_bit_depends_on_threads(listed):
    ball = attrs.evolve(SHAPES["sphere"], friction=(0.5, 0.3))
    path = still((0.05, 0.02, -0.2 - THICKNESS))
    path[4:7], path[17:20] = [0.1, -0.2, 0.5], [0.3, -0.4, 1.0]
    model, places = flat_sheet(40, 31, contact(ball, paths=[path]), listed=listed)
    plan = compile(model)
    x, v = np.ascontiguousarray(places.T), np.zeros((3, len(places)))
    v[2] = -1.0
    runs = [
        plan.runs(0.0, 0.02, (x, v), [700], record_obstacles=True, threads=threads, memory={})[0][0]
        for threads in (1, 2, 3, 8)
    ]
    assert np.count_nonzero(runs[0].anchors[0, 3]) > 3
    for run in runs[1:]:
        for reference_run, compared_run in zip(runs[0], run, strict=True):
            assert np.array_equal(reference_run, compared_run)


def test_state_restored_from_bytes_continues_with_the_same_bits():
    ball = attrs.evolve(SHAPES["sphere"], friction=(0.5, 0.3))
    contact_force = contact(ball, paths=[still((0.03, 0.02, -0.2 - 1.5 * THICKNESS))])
    model, places = flat_sheet(9, 9, contact_force, size=0.4)
    plan, state, integrator = drop(model, places, tolerance=1e-4)
    for k in range(8):
        integrator.advance(plan, state, k * FRAME, FRAME)
    assert state.memory[ANCHORS_KEY].any()
    again = State.from_bytes(state.to_bytes())
    second_plan = compile(model)
    for k in range(8, 11):
        integrator.advance(plan, state, k * FRAME, FRAME)
        integrator.advance(second_plan, again, k * FRAME, FRAME)
        assert state.digest() == again.digest()


def test_coming_to_rest_does_not_shorten_steps():
    # Anchors are dragged along: the energy of their springs is that of the end's anchors.
    rough = attrs.evolve(SHAPES["plane"], friction=(0.5, 0.5))
    model, places = flat_sheet(6, 6, contact(rough), size=0.2, drag=False)
    places[:, 2] = 0.975 * THICKNESS
    plan, state, integrator = drop(model, places, (1.0, 0.0, 0.0), tolerance=None)
    steps = [integrator.advance(plan, state, k * FRAME, FRAME).steps for k in range(16)]
    assert np.abs(state.v).max() < 1e-2
    assert max(steps) < 2 * min(steps)


@every_shape
def test_friction_changes_where_particles_slid_or_vibrate(shape):
    contact_force, plan, _, x, _, anchors = about(shape, seed=5)
    path, rng = contact_force.paths[0], np.random.default_rng(6)
    position, _, rotation, _ = laws.pose(path, 0.3)
    later_position, velocity, later_rotation, turning = laws.pose(path, 0.3 + FRAME)
    local = rotation.T @ (x - position[:, None])
    # The particles move with the obstacle. Half of the anchors slide, and all particles vibrate at the end.
    ends = anchors.copy()
    ends[0, :3, ::2] += 1e-6 * rng.standard_normal((3, COUNT // 2))
    ends[0, 3] = rng.integers(0, 3, COUNT)
    memory = {ANCHORS_KEY: anchors}
    arm = later_rotation @ local
    vibration = 0.01 * rng.standard_normal(x.shape)
    v = velocity[:, None] + turning @ local + vibration
    states = x, later_position[:, None] + arm, np.ascontiguousarray(v)
    changes, vibrations = plan.contact.friction_change(0.3, FRAME, states, ends, memory)
    expected, expected_vibrations = np.zeros_like(x), np.zeros_like(x)
    for i in np.flatnonzero((anchors[0, 3] > 0.0) & (ends[0, 3] > 0.0)):
        _, normals = contact_force.obstacles[0].distance(local[None, :, i])
        moved, normal = ends[0, :3, i] - anchors[0, :3, i], later_rotation @ normals[0]
        if i % 2 == 0:
            expected[:, i] = 2000.0**2 * later_rotation @ (moved - (moved @ normals[0]) * normals[0])
            if ends[0, 3, i] == 1.0:
                offset = local[:, i] - ends[0, :3, i]
                expected_vibrations[:, i] = 2000.0 * later_rotation @ (offset - (offset @ normals[0]) * normals[0])
        else:
            expected_vibrations[:, i] = vibration[:, i] - (vibration[:, i] @ normal) * normal
    assert min(np.count_nonzero(array.any(axis=0)) for array in (expected, expected_vibrations)) > 3
    assert changes == pytest.approx(expected, rel=1e-6, abs=1e-6)
    assert vibrations == pytest.approx(expected_vibrations, abs=1e-6)


@every_shape
def test_stretch_difference_of_springs_that_stick(shape):
    contact_force, plan, _, x, _, anchors = about(shape, seed=5)
    rng, path = np.random.default_rng(6), contact_force.paths[0]
    position, _, rotation, _ = laws.pose(path, 0.3)
    y, moved_anchors = x + 1e-7 * rng.standard_normal(x.shape), anchors.copy()
    moved_anchors[0, :3] += 1e-6 * rng.standard_normal((3, COUNT))
    moved_anchors[0, 3] = rng.integers(0, 3, COUNT)
    ends = [(x, {ANCHORS_KEY: anchors}), (y, {ANCHORS_KEY: moved_anchors})]
    differences = plan.contact.stretch_difference(0.3, ends)
    expected = np.zeros_like(x)
    for i in range(COUNT):
        stretches = []
        for places, memory in ends:
            offset = rotation.T @ (places[:, i] - position) - memory[ANCHORS_KEY][0, :3, i]
            _, normals = contact_force.obstacles[0].distance((rotation.T @ (places[:, i] - position))[None])
            stretches.append(rotation @ (offset - (offset @ normals[0]) * normals[0]))
        bonds = {anchors[0, 3, i], moved_anchors[0, 3, i]}
        if 1.0 in bonds and 0.0 not in bonds:
            expected[:, i] = stretches[1] - stretches[0]
    assert np.count_nonzero(expected.any(axis=0)) > 3
    assert differences == pytest.approx(expected, abs=1e-10)
