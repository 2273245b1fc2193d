# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Runs in which corners, edges and small balls meet a coarse cloth between its particles."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from support.contact_scenes import drop, still
from support.feature_scenes import BLOCK, CORNER, CORNER_UP, THICKNESS, coarse_scene, intersected_triangles

from cloth_sim_ros.engine.instruction_set import libraries
from cloth_sim_ros.physics.accounting.energy_balance import EnergyBalance
from cloth_sim_ros.physics.accounting.work_accumulator import WorkAccumulator
from cloth_sim_ros.physics.contact.obstacles import Obstacle
from cloth_sim_ros.physics.state.state import State

FRAME = 1.0 / 60.0
TESTS = Path(__file__).resolve().parent.parent
BALL = Obstacle(name="ball", shape="sphere", size=(0.02,))
PIN = Obstacle(name="pin", shape="capsule", size=(0.01, 0.06))
COIN = Obstacle(name="coin", shape="cylinder", size=(0.03, 0.004))
ON_EDGE = Rotation.from_euler("x", 90.0, degrees=True).as_quat()


def below(obstacle, gap, where=(0.05, 0.03)):
    """Return the path of an obstacle under a cell of a sheet at z = 0, its highest point `gap` below the sheet [m]."""
    high, turn = {
        "block": (CORNER, CORNER_UP),
        "ball": (0.02, (0.0, 0.0, 0.0, 1.0)),
        "pin": (0.04, (0.0, 0.0, 0.0, 1.0)),
        "coin": (0.03, ON_EDGE),
    }[obstacle.name]
    return still((*where, -high - gap), turn)


each_obstacle = pytest.mark.parametrize("obstacle", [BLOCK, BALL, PIN, COIN], ids=lambda one: one.name)


def exact(plan, state, duration):
    """Return the motion of the same equations by DOP853, far below every tolerance of these tests."""
    shape, size = state.x.shape, state.x.size
    a = np.empty(shape)

    def slope(t, y):
        x, v = (np.ascontiguousarray(part.reshape(shape)) for part in (y[:size], y[size:]))
        plan.accelerations(t, x, v, a, memory={})
        return np.concatenate([y[size:], a.ravel()])

    y = np.concatenate([state.x.ravel(), state.v.ravel()])
    done = solve_ivp(slope, (0.0, duration), y, method="DOP853", rtol=1e-10, atol=1e-12)
    return done.y[:size, -1].reshape(shape)


def furthest(x, y):
    """Return the largest distance of a particle between two arrays."""
    return float(np.sqrt(((x - y) ** 2).sum(axis=0)).max())


def run_frames(obstacle, path, frames, velocity=(0.0, 0.0, 0.0), *, tolerance=1e-3, **options):
    """Run a sheet; return plan, state, and whether the obstacle passed through it in any frame."""
    model, places, triangles = coarse_scene(obstacle, paths=[path], **options)
    plan, state, integrator = drop(model, places, velocity, tolerance=tolerance, work=0.0)
    through = False
    for k in range(frames):
        integrator.advance(plan, state, k * FRAME, FRAME)
        through = through or bool(intersected_triangles(obstacle, path, (k + 1) * FRAME, triangles, state.positions))
    return plan, state, through


@each_obstacle
@pytest.mark.parametrize("speed", [2.0, 10.0])
def test_features_do_not_pass_between_particles(obstacle, speed):
    path = below(obstacle, 0.01)
    _, _, through = run_frames(obstacle, path, 8, (0.0, 0.0, -speed))
    assert not through


def test_features_pass_through_without_faces():
    for obstacle in (BLOCK, BALL, PIN, COIN):
        assert run_frames(obstacle, below(obstacle, 0.01), 8, (0.0, 0.0, -2.0), faces=False)[2]


@each_obstacle
def test_hanging_sheet_rests_on_an_obstacle_under_a_cell(obstacle):
    # They stand higher than the sheet would hang.
    path = below(obstacle, 0.003)
    plan, state, through = run_frames(obstacle, path, 40, anchors=[0, 4, 20, 24])
    assert not through
    rates = plan.contact.wrench_rates(40 * FRAME, state.x, state.v, memory=state.memory)[0]
    assert rates[2] < -0.05
    assert plan.contact.obstacle_gaps(40 * FRAME, state.x, memory=state.memory)[0, 0] == 0.0


@each_obstacle
def test_obstacle_driven_up_at_10_m_per_s_does_not_pass_through(obstacle):
    path = below(obstacle, 0.01)
    path[6] = 10.0
    _, state, through = run_frames(obstacle, path, 4)
    assert not through
    assert state.x[2].max() > 0.2


def test_edges_of_a_turning_box_do_not_pass_through():
    path = still((0.03, 0.02, -0.13))
    path[17:20], path[6] = [3.0, 5.0, 1.0], 0.5
    _, _, through = run_frames(BLOCK, path, 16)
    assert not through


def test_balls_under_cells_bear_the_weight():
    places = [(x, y, -0.02 - 0.49 * THICKNESS) for x in (-0.19, 0.19) for y in (-0.19, 0.19)]
    balls = [Obstacle(name=f"ball{k}", shape="sphere", size=(0.02,)) for k in range(4)]
    stiff = {"bending.model": "crossed", "material.bending_modulus": 0.02, "air.drag": 8.0}
    model, at, _ = coarse_scene(*balls, paths=[still(position) for position in places], **stiff)
    plan, state, integrator = drop(model, at, tolerance=1e-4)
    for k in range(90):
        integrator.advance(plan, state, k * FRAME, FRAME)
    book = WorkAccumulator(plan.gripper_count, obstacle_count=4)
    integrator.advance(plan, state, 90 * FRAME, FRAME, book)
    weight = 9.81 * model.mass
    assert plan.contact.obstacle_gaps(91 * FRAME, state.x, memory=state.memory)[:, 0].tolist() == [0.0] * 4
    assert book.obstacle_wrenches[:, 2].sum() == pytest.approx(-weight, rel=1e-3)


@pytest.mark.parametrize("listed", [False, True])
def test_features_out_of_reach_change_no_bit_and_no_step(listed):
    block, table = BLOCK, Obstacle(name="table", shape="box", size=(3.0, 3.0, 0.1))
    paths = [still((0.0, 0.0, -1.5)), still((0.0, 0.0, -0.05 - THICKNESS))]
    ends = []
    for faces in (False, True):
        model, places, _ = coarse_scene(block, table, paths=paths, n=12, faces=faces, listed=listed)
        plan, state, integrator = drop(model, places, tolerance=1e-4)
        evaluations = [integrator.advance(plan, state, k * FRAME, FRAME).evaluations for k in range(8)]
        ends.append((evaluations, state.x, state.v))
    assert ends[0][0] == ends[1][0]
    assert np.array_equal(ends[0][1], ends[1][1])
    assert np.array_equal(ends[0][2], ends[1][2])


def test_particles_alone_keep_out_a_large_ball():
    ball = Obstacle(name="ball", shape="sphere", size=(0.2,))
    for n, needs_no_features in ((5, False), (30, True)):
        model, places, _ = coarse_scene(ball, paths=[still((0.0, 0.0, -0.2 - THICKNESS))], n=n, size=0.6)
        plan, state, integrator = drop(model, places, tolerance=1e-3)
        integrator.advance(plan, state, 0.0, FRAME)
        assert plan.contact.supports_single_precision(FRAME, state.x, state.v, memory=state.memory) == needs_no_features


@pytest.mark.parametrize("listed", [False, True])
def test_no_bit_depends_on_threads_or_earlier_runs(listed):
    path = below(BLOCK, 0.001)
    path[17:20], path[6] = [0.3, -0.4, 1.0], 0.5
    model, places, _ = coarse_scene(BLOCK, paths=[path], n=9, listed=listed)
    x, v = np.ascontiguousarray(places.T), np.zeros((3, len(places)))
    v[2] = -2.0
    plan, second_plan = (drop(model, places)[0] for _ in range(2))
    for k in range(3):
        second_plan.runs(0.001 * k, 0.003, (x + 0.01 * k, -v), [30], memory={})
    runs = [
        used_plan.runs(0.0, 0.01, (x, v), [500], record_power=True, record_obstacles=True, threads=threads, memory={})[
            0
        ][0]
        for used_plan, threads in ((plan, 1), (plan, 3), (second_plan, 2))
    ]
    assert runs[0].self_contact[0] > 0.0
    for run in runs[1:]:
        assert np.array_equal(run.x, runs[0].x)
        assert np.array_equal(run.v, runs[0].v)
        assert np.array_equal(run.obstacle_integrals, runs[0].obstacle_integrals)


def test_energy_balance_closes_with_a_rising_turning_corner():
    path = below(BLOCK, 0.01)
    path[4:7], path[17:20] = [0.1, 0.0, 1.0], [0.0, 1.0, 2.0]
    model, places, _ = coarse_scene(BLOCK, paths=[path])
    plan, state, integrator = drop(model, places, tolerance=1e-5)
    balance = EnergyBalance(plan, state)
    for k in range(6):
        integrator.advance(plan, state, k * FRAME, FRAME, balance.accumulator)
        residual = balance.add_advance((k + 1) * FRAME, state)
    assert balance.work > 0.01
    assert abs(residual) < 1e-3 * balance.energy_turnover


@pytest.mark.parametrize("tolerance", [1e-3, 1e-4, 1e-5])
@pytest.mark.parametrize("obstacle", [BLOCK, BALL], ids=lambda one: one.name)
def test_sheet_falling_on_a_small_obstacle_keeps_tolerance(obstacle, tolerance):
    frames = 5
    model, places, _ = coarse_scene(obstacle, paths=[below(obstacle, 0.004)])
    plan, state, integrator = drop(model, places, (0.0, 0.0, -0.5), tolerance=tolerance)
    end = exact(plan, state, frames * FRAME)
    kick = 1e-8 * np.random.default_rng(0).standard_normal(state.x.shape)
    kicked = exact(plan, State((state.x + kick).T, state.v.T), frames * FRAME)
    growth = furthest(end, kicked) / furthest(kick, np.zeros_like(kick))
    flagged = sum(integrator.advance(plan, state, k * FRAME, FRAME).flagged for k in range(frames))
    assert plan.contact.predict_surface_contact(frames * FRAME, 0.0, state.x, state.v, memory=state.memory)[0] >= 0.0
    assert not flagged
    assert furthest(state.x, end) <= tolerance * max(1.0, growth)


def test_implicit_steps_penetrate_nothing():
    path = below(BLOCK, 0.02)
    model, places, triangles = coarse_scene(BLOCK, paths=[path])
    plan, state, integrator = drop(model, places, (0.0, 0.0, -2.0), integrator="implicit", tolerance=1e-3)
    energy = plan.energy(0.0, state.x, state.v, memory=state.memory)
    for k in range(6):
        integrator.advance(plan, state, k * FRAME, FRAME)
        assert not intersected_triangles(BLOCK, path, (k + 1) * FRAME, triangles, state.positions)
        assert plan.energy(0.0, state.x, state.v, memory=state.memory) <= energy * (1.0 + 1e-3)


#: Runs a coarse sheet onto a corner, a coin and a mesh, and prints the digests.
_BITS = """
import numpy as np, trimesh
from support.contact_scenes import drop, still
from support.feature_scenes import BLOCK, CORNER, CORNER_UP, coarse_scene
from cloth_sim_ros.physics.contact.obstacles import Obstacle

made = trimesh.creation.box((0.05, 0.05, 0.05))
coin = Obstacle(name="coin", shape="cylinder", size=(0.03, 0.004))
brick = Obstacle(name="brick", shape="mesh", vertices=made.vertices, triangles=np.array(made.faces))
paths = [still((0.05, 0.03, -CORNER - 0.001), CORNER_UP), still((-0.05, 0.03, -0.003)), still((0.05, -0.12, -0.026))]
paths[0][17:20] = [0.3, 0.4, 1.0]
model, places, _ = coarse_scene(BLOCK, coin, brick, paths=paths)
plan, state, integrator = drop(model, places, (0.0, 0.0, -1.0), tolerance=1e-3)
for k in range(4):
    integrator.advance(plan, state, k / 60.0, 1.0 / 60.0)
print(state.digest(), plan.contact.wrench_rates(4 / 60.0, state.x, state.v, state.memory).tobytes().hex())
"""


def test_every_instruction_set_gives_the_same_bits():
    digests = {}
    for name in libraries():
        path = os.pathsep.join([str(TESTS), *sys.path])
        environment = {**os.environ, "CLOTH_SIM_ROS_ENGINE": name, "PYTHONPATH": path}
        command = [sys.executable, "-c", _BITS]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        digests[name] = done.stdout
    assert len(digests) > 1
    assert len(set(digests.values())) == 1
