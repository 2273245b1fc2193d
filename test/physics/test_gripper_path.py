# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Gripper paths and the grips on them."""

import math

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from support import laws
from support.alone import alone, force

from cloth_sim_ros.engine.binding import PATH_NUMBERS, check, library
from cloth_sim_ros.physics.control.error import displacement_by_jerk
from cloth_sim_ros.physics.integrators.extrapolation_tableau import ExtrapolationTableau
from cloth_sim_ros.physics.integrators.limit import leapfrog_limit
from cloth_sim_ros.physics.model.forces.grips import Grips
from cloth_sim_ros.physics.model.forces.pair_springs import PairSprings
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.plan.gripper_path import normalized, plan_paths, rotation_matrix, rotation_vector
from cloth_sim_ros.physics.plan.plan import compile
from cloth_sim_ros.physics.state.state import State

T = 1 / 60


def planned(t, *given):
    """Return a frame's path, the twist at its end and its rotation vector."""
    return [part[0] for part in plan_paths(t, T, *(array[None] for array in given))[:3]]


def at(row, t):
    """Return position, velocity, rotation matrix and angular velocity, by the engine."""
    out = np.empty(18)
    check(library().cloth_pose(row.ctypes.data, t, out.ctypes.data))
    return out[:3], out[3:6], out[6:15].reshape(3, 3), out[15:]


def random_pose(rng):
    return np.concatenate([rng.standard_normal(3), Rotation.random(random_state=rng.integers(1 << 30)).as_quat()])


def follow(targets, start):
    """Return rows of consecutive frames through the targets, and the twist at the end."""
    pose, twist, turn, rows = start, np.zeros(6), np.zeros(6), []
    for k, target in enumerate(targets):
        row, twist, turn = planned(k * T, pose, twist, turn, target)
        rows.append(row)
        pose = target
    return rows, twist


@pytest.mark.parametrize("seed", range(5))
def test_velocity_and_spin_are_the_derivatives_of_the_pose(seed):
    rng = np.random.default_rng(seed)
    row = planned(0.5, random_pose(rng), rng.standard_normal(6), rng.standard_normal(6), random_pose(rng))[0]
    h = 1e-7
    for t in 0.5 + T * np.array([0.1, 0.5, 0.9]):
        (p0, _, r0, _), (p1, _, r1, _) = at(row, t - h), at(row, t + h)
        _, velocity, rotation, spin = at(row, t)
        assert velocity == pytest.approx((p1 - p0) / (2 * h), rel=1e-5, abs=1e-4)
        assert spin == pytest.approx(Rotation.from_matrix(r1 @ r0.T).as_rotvec() / (2 * h), rel=1e-5, abs=1e-4)
        assert rotation @ rotation.T == pytest.approx(np.eye(3), abs=1e-14)
        # Angular velocity w: dR/dt R' = [w]x.
        position, speed, turned, turning = laws.pose(row, t)
        for calculated, expected in ((at(row, t)[0], position), (velocity, speed), (rotation, turned)):
            assert calculated == pytest.approx(expected, rel=1e-12, abs=1e-12)
        assert spin == pytest.approx((turning @ turned.T)[[2, 0, 1], [1, 2, 0]], rel=1e-10, abs=1e-10)


@pytest.mark.parametrize("seed", range(5))
def test_path_is_continuous_and_reaches_its_targets(seed):
    rng = np.random.default_rng(seed)
    targets = [random_pose(rng) for _ in range(6)]
    rows, _ = follow(targets[1:], targets[0])
    for k in range(len(rows) - 1):
        end, begin = at(rows[k], (k + 1) * T), at(rows[k + 1], (k + 1) * T)
        for end_array, begin_array in zip(end, begin, strict=True):
            assert end_array == pytest.approx(begin_array, abs=1e-9 * max(1.0, np.abs(end_array).max()))
        assert end[0] == pytest.approx(targets[k + 1][:3], abs=1e-12)
        assert end[2] == pytest.approx(rotation_matrix(targets[k + 1][3:]), abs=1e-12)


def test_a_steady_stream_is_followed_without_ripple():
    step = np.array([0.01, -0.02, 0.005])
    poses = [np.concatenate([k * step, Rotation.from_rotvec([0, 0, 0.03 * k]).as_quat()]) for k in range(8)]
    rows, _ = follow(poses[1:], poses[0])
    for t in 6 * T + T * np.linspace(0, 1, 7):
        _, velocity, _, spin = at(rows[6], t)
        assert velocity == pytest.approx(step / T, rel=1e-9)
        assert spin == pytest.approx([0.0, 0.0, 0.03 / T], abs=1e-9)


def test_jump_arrives_at_rest_without_overshoot():
    start, end = np.array([0.0, 0, 0, 0, 0, 0, 1]), np.array([0.3, 0, 0, 0, 0, 0, 1.0])
    rows, twist = follow([end, end], start)
    path = [at(rows[0], t)[0][0] for t in T * np.linspace(0, 1, 101)]
    assert max(path) <= 0.3
    assert (np.diff(path) >= 0).all()
    assert at(rows[1], 1.5 * T)[0][0] == 0.3
    assert not twist.any()


def test_a_half_turn_takes_the_shortest_way():
    start = np.array([0.0, 0.0, 0.0, 1.0])
    end = -Rotation.from_rotvec([0.2, 0.0, 0.0]).as_quat()  # the same turn by the other quaternion
    assert rotation_vector(start.tolist(), end.tolist()) == pytest.approx([0.2, 0.0, 0.0], abs=1e-15)
    assert rotation_vector(start.tolist(), start.tolist()) == pytest.approx([0.0, 0.0, 0.0])


@pytest.mark.parametrize("bad", [[0, 0, 0, 0], [np.nan, 0, 0, 1], [0, 0, 1], [1e200, 0, 0, 0], [1e-7, 0, 0, 0]])
def test_a_quaternion_without_direction_is_refused(bad):
    with pytest.raises(ValueError, match="no quaternion x, y, z, w of a length from 1e-06 to 1e154; the identity is"):
        normalized(bad)


def test_quaternions_of_extreme_lengths_have_a_direction():
    for length in (1e-6, 1.3e154):
        assert normalized([0.0, 0.0, 0.0, length]).tolist() == [0.0, 0.0, 0.0, 1.0]


@pytest.mark.parametrize("seed", range(3))
def test_grip_work_is_stored_energy_plus_dissipation(seed):
    """d(energy)/dt + dissipation = power of the gripper + power into the particle, the gripper moving and turning."""
    rng = np.random.default_rng(seed)
    held = Grips(1)
    path = planned(0.0, random_pose(rng), rng.standard_normal(6), np.zeros(6), random_pose(rng))[0]
    offsets = rng.standard_normal((2, 3))
    held.set_grips(path[None], np.array([0, 2]), np.array([1, 2]), offsets, np.full(2, 40.0), np.full(2, 3.0))
    plan = alone(held, count=4)
    x, v, t, h = rng.standard_normal((3, 4)), rng.standard_normal((3, 4)), 0.4 * T, 1e-7
    energies = [plan.energies(t + step, x + step * v, None)[1] for step in (h, -h)]
    rate = (energies[0] - energies[1]) / (2 * h)
    f, booked = force(plan, x, v, t), plan.grip_wrench_rates(t, x, v)
    assert rate + plan.dissipation(t, x, v) == pytest.approx(booked[0, 6] - np.sum(f * v), rel=1e-6)
    # Wrench: the reaction to the forces on the particles, its torque about the gripper's pose.
    points = offsets @ at(path, t)[2].T
    assert booked[0, :3] == pytest.approx(-f.sum(axis=1))
    assert booked[0, 3:6] == pytest.approx(np.cross(points, -f[:, [1, 2]].T).sum(axis=0))


def displacement_ratios(held, masses, joint, grip):
    """Return displacements by the errors of runs from rest within half a second after a frame, over their bounds.

    Args:
        held: grips; they grasp the first of particles in a row at the origin.
        masses: of the particles [kg].
        joint: stiffness [N/m] and damping [N s/m] of the joints between neighbours.
        grip: the same of the grip.
    """
    count = len(masses)
    pairs = np.array([(i, i + 1) for i in range(count - 1)]).reshape(-1, 2)
    plan = compile(Model(masses, [PairSprings(pairs, 0.0, *joint), held]))
    row = np.diag(np.full(count, 2.0)) - np.diag(np.ones(count - 1), 1) - np.diag(np.ones(count - 1), -1)
    row[0, 0] -= 1.0
    row[-1, -1] -= 1.0
    first = np.diag(np.arange(count) == 0).astype(float)
    stiffness, damping = ((joint[i] * row + grip[i] * first) / masses[:, None] for i in range(2))
    matrix = np.block([[np.zeros((count, count)), np.eye(count)], [-stiffness, -damping]])
    waves = 4.0 * np.pi / np.sqrt(np.linalg.eigvals(stiffness).real.max())
    times = np.concatenate([np.linspace(0.0, 0.5, 16), np.linspace(0.0, min(0.5, waves), 33)[1:]])
    later = np.array([expm(t * matrix)[:count] for t in times])
    limit = leapfrog_limit(*(np.abs(rates).sum(axis=1).max() for rates in (stiffness, damping)))
    steps, start = max(4, math.ceil(1.1 * T / limit)), State(np.zeros((count, 3)))
    rng = np.random.default_rng(7)
    for k in range(9):
        path = np.zeros((1, PATH_NUMBERS))
        path[0, 16], path[0, 7:10] = 1.0, rng.standard_normal(3)
        # Every third path ends at rest.
        path[0, 10:13] = (
            rng.standard_normal(3) * rng.choice([0.1, 1.0, 10.0]) / T if k % 3 else -2 * path[0, 7:10] / 3 / T
        )
        held.set_grips(path, np.array([0, 1]), np.array([0]), np.zeros((1, 3)), *(np.full(1, rate) for rate in grip))
        ends = [ExtrapolationTableau(plan, start, 0.0, T, (n,)).combine(1) for n in (steps, 64 * steps)]
        errors = np.concatenate([coarse - fine for coarse, fine in zip(*ends, strict=True)], axis=1).T
        bound = displacement_by_jerk(plan.grip_jerk_change(0.0, T, (0.0, 0.0), 0.5), steps)
        yield np.linalg.norm(later @ errors, axis=2).max() / bound


@pytest.mark.parametrize("damping_ratio", [0.0, 0.1, 0.5, 1.0, 2.0])
@pytest.mark.parametrize("omega", [3.0, 30.0, 120.0, 500.0, 2000.0, 5000.0])
def test_jerk_change_bounds_the_displacement_by_a_run(omega, damping_ratio):
    ratio = max(displacement_ratios(Grips(1), np.ones(1), (0.0, 0.0), (omega**2, 2.0 * damping_ratio * omega)))
    # Near the stability limit waves lose their phase, so that errors are smaller.
    assert 0.05 <= ratio <= 1.5


@pytest.mark.parametrize("mass", [0.01, 1.0, 100.0])
@pytest.mark.parametrize("joint", [0.01, 1.0, 100.0])
@pytest.mark.parametrize("omega", [30.0, 500.0])
def test_jerk_change_bounds_displacements_of_neighbours(omega, joint, mass):
    masses, damping = np.array([1.0, mass, mass]), 0.2 * omega
    joints = joint * omega**2, 0.2 * omega * math.sqrt(joint * mass / (1.0 + mass))
    ratio = max(displacement_ratios(Grips(1), masses, joints, (omega**2, damping)))
    assert ratio <= 1.5


def test_jerk_change_pairs_stiffness_with_its_mass():
    path, masses = np.zeros((1, PATH_NUMBERS)), np.array([1.0, 0.01])
    path[0, 16], path[0, 7] = 1.0, 3.0
    held = Grips(1)
    plan = alone(held, masses=masses)
    # Stiffness and damping in proportion to the mass: two particles move as one.
    held.set_grips(path, np.array([0, 2]), np.array([0, 1]), np.zeros((2, 3)), 40.0 * masses, 3.0 * masses)
    both = plan.grip_jerk_change(0.0, T, (0.0, 0.0), 0.5)
    held.set_grips(path, np.array([0, 1]), np.array([0]), np.zeros((1, 3)), np.full(1, 40.0), np.full(1, 3.0))
    assert both == plan.grip_jerk_change(0.0, T, (0.0, 0.0), 0.5)


def test_jerk_changes_of_grippers_add_up_at_a_shared_particle():
    path = np.zeros((2, PATH_NUMBERS))
    # From 0.1 s on: the acceleration by the turn acts at the farther point, 0.5 m from the origin.
    path[:, 0], path[:, 16], path[:, 7], path[:, 22] = 0.1, 1.0, 3.0, 4.0
    held, points = Grips(2), np.array([[0.3, 0.4, 0.0], [0.1, -0.2, 0.0]])
    held.set_grips(path, np.array([0, 2, 2]), np.array([1, 3]), points, np.array([8.0, 1.0]), np.array([3.0, 1.0]))
    plan = compile(Model(np.array([1.0, 2.0, 1.0, 4.0]), [held], anchors=[0]))
    single = T**2 / 8.0 * (6.0 + 0.5 * 8.0) * (4.0 * T + 3.0 * 1.5)
    assert plan.grip_jerk_change(0.105, T, (0.0, 0.0), 0.5) == pytest.approx(single)
    held.set_grips(path, np.array([0, 1, 2]), np.array([1, 1]), points[[0, 0]], np.full(2, 8.0), np.full(2, 3.0))
    assert plan.grip_jerk_change(0.105, T, (0.0, 0.0), 0.5) == pytest.approx(2.0 * single)
    # Of an anchored particle, or of none, there is none.
    held.set_grips(path, np.array([0, 1, 1]), np.array([0]), points[:1], np.ones(1), np.ones(1))
    assert plan.grip_jerk_change(0.105, T, (0.0, 0.0), 0.5) == 0.0
    held.set_grips(path, np.zeros(3, dtype=int), np.empty(0, dtype=int), points[:0], np.empty(0), np.empty(0))
    assert plan.grip_jerk_change(0.105, T, (0.0, 0.0), 0.5) == 0.0


def test_jerk_change_by_a_prescribed_path_is_of_the_sheet():
    path = np.zeros((1, PATH_NUMBERS))
    path[0, 16], path[0, 7] = 1.0, 2.0
    held = Grips(1)
    plan = alone(held, count=2)
    prescribed = np.full(1, 9.0), np.ones(1), np.array([True])
    held.set_grips(path, np.array([0, 1]), np.array([1]), np.zeros((1, 3)), *prescribed)
    omega2, damping, time = 400.0, 30.0, 0.5
    # Waves of w keep an error of velocity for 1/w only.
    fraction = 1.0 / np.sqrt(omega2 * time**2 + 1.0)
    expected = T**2 / 8.0 * fraction * 4.0 * (omega2 * T + 3.0 * damping)
    assert plan.grip_jerk_change(0.0, T, (omega2, damping), time) == pytest.approx(expected)


def test_damping_time_is_that_of_grips_that_are_stiff_enough():
    rng, masses = np.random.default_rng(4), np.array([1.0, 0.5, 2.0, 4.0, 1.0])
    held = Grips(1)
    plan = compile(Model(masses, [held], anchors=[0]))
    assert plan.min_damping_time() == np.inf
    for particles in (rng.integers(0, 5, 9), np.zeros(2, dtype=int)):
        count = len(particles)
        stiffness, damping = rng.choice([0.0, 2.0, 5.0, 30.0], count), rng.uniform(0.1, 2.0, count)
        offsets = np.zeros((count, 3))
        held.set_grips(held.paths, np.array([0, count]), particles, offsets, stiffness, damping)
        rates = stiffness * np.where(particles > 0, 1.0 / masses[particles], 0.0)
        for soft in [0.0, *rates, 1.01 * rates.max()]:
            times = [c / k for k, c, rate in zip(stiffness, damping, rates, strict=True) if rate > soft]
            assert plan.min_damping_time(soft) == min(times, default=np.inf), soft


def test_grips_of_one_particle_add_up_in_any_order():
    rng = np.random.default_rng(9)
    held = Grips(3)
    poses = [random_pose(rng) for _ in range(6)]
    paths = [planned(0.0, poses[g], rng.standard_normal(6), np.zeros(6), poses[g + 3])[0] for g in range(3)]
    particles, starts = np.array([5, 0, 3, 5, 1, 0, 5]), np.array([0, 2, 3, 7])
    stiffness, damping = rng.uniform(10, 50, 7), rng.uniform(0.1, 2.0, 7)
    held.set_grips(np.array(paths), starts, particles, rng.standard_normal((7, 3)), stiffness, damping)
    x, v = rng.standard_normal((3, 6)), rng.standard_normal((3, 6))
    plan, (expected, booked) = alone(held, count=6), laws.grips(0.3 * T, x, v, held)
    assert force(plan, x, v, 0.3 * T) == pytest.approx(expected.force, rel=1e-11)
    assert plan.grip_wrench_rates(0.3 * T, x, v) == pytest.approx(booked, rel=1e-10)
    assert plan.grip_wrench_rates(0.3 * T, x, v, 0.5) == pytest.approx(0.5 * booked, rel=1e-10)


def test_grasped_particles_may_change_and_none_gives_no_force():
    held, x = Grips(1), np.random.default_rng(2).standard_normal((3, 3))
    plan = alone(held, count=3)
    assert not force(plan, x).any()
    single_grip = (held.paths, np.array([0, 1]), np.array([2]), np.zeros((1, 3)), np.array([7.0]), np.array([0.0]))
    held.set_grips(*single_grip)
    assert force(plan, x)[:, 2] == pytest.approx(-7.0 * x[:, 2])
    held.set_grips(
        held.paths, np.zeros(2, dtype=np.int64), np.empty(0, np.int64), np.empty((0, 3)), np.empty(0), np.empty(0)
    )
    assert not force(plan, x).any()
