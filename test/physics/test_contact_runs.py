# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Runs with obstacles: equal in every loop with any number of threads; recorded wrenches are true."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import laws
from support.contact_scenes import SHAPES, THICKNESS, contact, drop, flat_sheet, moving, still

from cloth_sim_ros.physics.accounting.energy_balance import EnergyBalance
from cloth_sim_ros.physics.accounting.work_accumulator import WorkAccumulator
from cloth_sim_ros.physics.contact.obstacles import Obstacle
from cloth_sim_ros.physics.plan.plan import compile

#: Below the sheet: contact begins at once with the downward motion.
BELOW = {
    "plane": still((0.0, 0.0, -THICKNESS)),
    "box": still((0.05, 0.02, -0.1 - THICKNESS), Rotation.from_euler("z", 0.3).as_quat()),
    "sphere": still((0.05, 0.02, -0.2 - THICKNESS)),
    "capsule": still((0.0, 0.02, -0.1 - THICKNESS), Rotation.from_euler("y", np.pi / 2).as_quat()),
    "cylinder": still((0.0, 0.02, -0.2 - THICKNESS), Rotation.from_euler("xz", [np.pi / 2, 0.3]).as_quat()),
}
every_shape = pytest.mark.parametrize("shape", SHAPES)


def turning(shape):
    """Return the path of an obstacle that rises and turns."""
    path = BELOW[shape].copy()
    path[4:7], path[7:10] = [0.1, -0.2, 0.5], [0.0, 0.3, 1.0]
    if shape != "plane":
        path[17:20] = [0.3, -0.4, 1.0]
    return path


@every_shape
@pytest.mark.parametrize("listed", [False, True])
def test_a_run_is_that_of_the_formulas(shape, listed):
    contact_force = contact(shape, paths=[turning(shape)])
    model, places = flat_sheet(5, 6, contact_force, listed=listed, anchors=[0], size=0.3)
    x = np.ascontiguousarray(places.T)
    v = np.zeros_like(x)
    v[2, 1:] = -1.0
    plan = compile(model)
    (run,), _ = plan.runs(0.0, 2e-3, (x, v), [50], record_obstacles=True, memory={})
    expected = laws.leapfrog(model, 0.0, 2e-3, x, v, 50)
    assert run.x == pytest.approx(expected[0], abs=1e-11)
    assert run.v == pytest.approx(expected[1], abs=1e-7)
    assert np.abs(run.obstacle_integrals[0, :3]).max() > 1e-4
    (single_run,), _ = plan.runs(0.0, 2e-3, (x, v), [50], single_precision=True, record_obstacles=True, memory={})
    assert single_run.x == pytest.approx(run.x, abs=3e-6)
    assert single_run.obstacle_integrals == pytest.approx(
        run.obstacle_integrals, rel=2e-2, abs=2e-2 * np.abs(run.obstacle_integrals).max()
    )


@pytest.mark.parametrize("listed", [False, True])
@pytest.mark.parametrize("single_precision", [False, True])
def test_no_bit_depends_on_threads(listed, single_precision):
    shapes = ["sphere", "cylinder", "capsule", "box"]
    paths = np.array([turning(shape) for shape in shapes])
    paths[:, 1:3] += 0.4 * np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
    contact_force = contact(*shapes, paths=paths)
    model, places = flat_sheet(40, 31, contact_force, listed=listed)
    plan = compile(model)
    x = np.ascontiguousarray(places.T)
    x[2] += 0.01
    v = np.zeros_like(x)
    v[2] = -1.0
    runs = [
        plan.runs(
            0.0,
            0.02,
            (x, v),
            [700],
            single_precision=single_precision,
            record_power=True,
            record_obstacles=True,
            threads=threads,
            memory={},
        )[0][0]
        for threads in (1, 2, 3, 8)
    ]
    assert runs[0].encountered_energy > 0.0
    assert np.abs(runs[0].obstacle_integrals[:, :3]).max(axis=1).min() > 0.0
    for run in runs[1:]:
        for reference_run, compared_run in zip(runs[0], run, strict=True):
            assert np.array_equal(reference_run, compared_run)


@pytest.mark.parametrize("listed", [False, True])
def test_obstacles_out_of_reach_change_no_bit_and_no_step(listed):
    distant = Obstacle(name="far", shape="sphere", size=(0.3,))
    nearer = Obstacle(name="nearer", shape="box", size=(0.3, 0.3, 0.3))
    contact_force = contact(distant, nearer, paths=[still((0.0, 0.0, -40.0)), still((0.0, 0.0, -0.5))])
    ends = []
    for forces in ([], [contact_force]):
        model, places = flat_sheet(20, 20, *forces, listed=listed)
        plan, state, integrator = drop(model, places, tolerance=1e-4)
        evaluations = [integrator.advance(plan, state, k / 60.0, 1.0 / 60.0).evaluations for k in range(8)]
        ends.append((evaluations, state.x, state.v))
    assert ends[0][0] == ends[1][0]
    assert np.array_equal(ends[0][1], ends[1][1])
    assert np.array_equal(ends[0][2], ends[1][2])


@every_shape
@pytest.mark.parametrize("listed", [False, True])
def test_obstacle_impulse_equals_the_cloths_momentum_loss(shape, listed):
    contact_force = contact(shape, paths=[turning(shape)])
    model, places = flat_sheet(7, 9, contact_force, listed=listed, gravity=False, drag=False)
    plan = compile(model)
    x, v = np.ascontiguousarray(places.T), np.zeros((3, len(places)))
    v[2] = -1.0
    duration, steps = 5e-3, 4000
    (run,), _ = plan.runs(0.0, duration, (x, v), [steps], record_obstacles=True, memory={})
    momentum_loss = ((v - run.v) * model.masses).sum(axis=1)
    assert run.obstacle_integrals[0, :3] == pytest.approx(momentum_loss, rel=1e-9, abs=1e-12)
    # About its moving position, at second order in the step.
    spun = np.cross(x.T, (v * model.masses).T).sum(axis=0) - np.cross(run.x.T, (run.v * model.masses).T).sum(axis=0)
    moments, start, times = np.zeros(3), (x, v), np.linspace(0.0, duration, 201)
    for a, b in pairwise(times):
        (part,), _ = plan.runs(a, b - a, start, [steps // 200], record_obstacles=True, memory={})
        moments += np.cross(laws.pose(contact_force.paths[0], 0.5 * (a + b))[0], part.obstacle_integrals[0, :3])
        start = part.x, part.v
    assert run.obstacle_integrals[0, 3:6] + moments == pytest.approx(spun, abs=1e-4 * np.abs(spun).max() + 1e-9)


def test_the_balance_of_energy_closes_with_a_moving_obstacle():
    ball = Obstacle(name="ball", shape="sphere", size=(0.15,))
    path = still((0.0, 0.0, -0.16))
    path[4:7], path[17:20] = [0.2, 0.0, 1.5], [0.0, 2.0, 0.0]
    model, places = flat_sheet(15, 15, contact(ball, paths=[path]))
    plan, state, integrator = drop(model, places, tolerance=1e-5)
    balance = EnergyBalance(plan, state)
    for k in range(15):
        integrator.advance(plan, state, k / 60.0, 1.0 / 60.0, balance.accumulator)
        residual = balance.add_advance((k + 1) / 60.0, state)
    assert balance.work > 0.01
    assert abs(residual) < 1e-3 * balance.energy_turnover


@pytest.mark.parametrize("listed", [False, True])
def test_a_table_bears_the_weight_of_a_sheet_that_lies_on_it(listed):
    model, places = flat_sheet(12, 12, contact("plane"), listed=listed)
    places[:, 2] = THICKNESS
    plan, state, integrator = drop(model, places, tolerance=1e-4)
    for k in range(60):
        integrator.advance(plan, state, k / 60.0, 1.0 / 60.0)
    book = WorkAccumulator(plan.gripper_count, obstacle_count=1)
    integrator.advance(plan, state, 1.0, 1.0 / 60.0, book)
    weight = 9.81 * model.mass
    assert book.obstacle_wrenches[0, :3] == pytest.approx([0.0, 0.0, -weight], abs=1e-3 * weight)
    assert book.obstacle_wrenches[0, 3:] == pytest.approx(np.zeros(3), abs=1e-3 * weight)
    # Under a weight of 1 m/s^2 the force is a cube of the depth: 4 (1 - s)^3 = 2 d g / U^2, approximately.
    s = plan.contact.obstacle_gaps(1.0, state.x, memory=state.memory)[0, 1] / THICKNESS
    assert (1.0 - s) ** 3 * (1.0 + 3.0 * s) / s**2 == pytest.approx(2.0 * THICKNESS * 9.81 / 35.0**2, rel=1e-3)


def test_rotated_scene_gives_the_rotated_motion():
    turn = Rotation.from_euler("xyz", [0.3, 1.1, -0.7])
    ends = []
    for rotation in (Rotation.identity(), turn):
        path = still(rotation.apply([0.0, 0.01, -0.1 - THICKNESS]), rotation.as_quat())
        model, places = flat_sheet(9, 9, contact("box", paths=[path]), gravity=False)
        plan = compile(model)
        x = np.ascontiguousarray(rotation.apply(places).T)
        v = np.ascontiguousarray(np.repeat(rotation.apply([[0.3, 0.0, -2.0]]), len(places), axis=0).T)
        (run,), _ = plan.runs(0.0, 0.02, (x, v), [1500], memory={})
        assert run.encountered_energy > 0.0
        ends.append(rotation.inv().apply(run.x.T))
    assert ends[1] == pytest.approx(ends[0], abs=1e-9)


def test_obstacles_follow_random_paths_as_grippers_do():
    # A particle carried by a box that turns about itself stays on its surface.
    path = moving(4) * 0.2
    path[13:17] = moving(4)[13:17]
    contact_force = contact("box", paths=[path])
    assert contact_force.steady() is False
    contact_force.set_paths(np.array([still()]))
    assert contact_force.steady() is True
