# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Step control with obstacles: tolerance, no penetration at any speed, no energy gain."""

from functools import cache

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from support.contact_scenes import SHAPES, THICKNESS, contact, drop, flat_sheet, still
from support.self_runs import CONFIG

from cloth_sim_ros import Scene, Simulation
from cloth_sim_ros.physics.accounting.energy_balance import EnergyBalance
from cloth_sim_ros.physics.accounting.work_accumulator import WorkAccumulator
from cloth_sim_ros.physics.contact.obstacles import Obstacle
from cloth_sim_ros.physics.integrators.base import StepLimitError
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.parameters import parameter_file
from cloth_sim_ros.simulation.gripper_script import GripperScript
from cloth_sim_ros.simulation.script_events import ScriptEvents

FRAME = 1.0 / 60.0
#: Depth of each shape below the origin at which a sheet around the origin first touches it [m].
BELOW = {
    "plane": lambda gap: still((0.0, 0.0, -gap)),
    "box": lambda gap: still((0.13, 0.02, -0.1 - gap)),
    "sphere": lambda gap: still((0.01, 0.02, -0.2 - gap)),
    "capsule": lambda gap: still((0.01, 0.02, -0.1 - gap), (0.5, 0.5, 0.5, 0.5)),
    "cylinder": lambda gap: still((0.01, 0.02, -0.2 - gap), (0.5, 0.5, 0.5, 0.5)),
}
every_shape = pytest.mark.parametrize("shape", SHAPES)


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


def falling(shape, tolerance=None):
    """Return plan, state and integrator of a sheet that falls on an obstacle."""
    model, places = flat_sheet(9, 9, contact(shape, paths=[BELOW[shape](5e-3)]), size=0.4)
    return drop(model, places, tolerance=tolerance)


@cache
def exact_fall(shape, frames):
    """Return the exact final positions of a falling sheet, and the amplification of a small perturbation."""
    plan, state, _ = falling(shape)
    end = exact(plan, state, frames * FRAME)
    kick = 1e-8 * np.random.default_rng(0).standard_normal(state.x.shape)
    kicked = exact(plan, State((state.x + kick).T, state.v.T), frames * FRAME)
    return end, furthest(end, kicked) / furthest(kick, np.zeros_like(kick))


@every_shape
@pytest.mark.parametrize("tolerance", [1e-3, 1e-4, 1e-5, 1e-6])
def test_a_sheet_that_falls_on_an_obstacle_keeps_its_tolerance(shape, tolerance):
    end, growth = exact_fall(shape, 9)
    plan, state, integrator = falling(shape, tolerance)
    flagged = sum(integrator.advance(plan, state, k * FRAME, FRAME).flagged for k in range(9))
    assert not flagged
    assert furthest(state.x, end) <= tolerance * max(1.0, growth)


@every_shape
@pytest.mark.parametrize("listed", [False, True])
@pytest.mark.parametrize("tolerance", [1e-3, None])
def test_impact_at_20_m_per_s_penetrates_nothing(shape, listed, tolerance):
    model, places = flat_sheet(12, 12, contact(shape, paths=[BELOW[shape](0.1)]), size=0.3, listed=listed, drag=False)
    # No work limit: this test is about explicit steps, and so few particles are cheap with any step.
    plan, state, integrator = drop(model, places, (0.0, 0.0, -20.0), tolerance=tolerance, work=0.0)
    balance = EnergyBalance(plan, state)
    energy = plan.energy(0.0, state.x, state.v, memory=state.memory)
    for k in range(6):
        done = integrator.advance(plan, state, k * FRAME, FRAME, balance.accumulator)
        assert done.integrator != "implicit"
        _, gap = plan.contact.obstacle_gaps((k + 1) * FRAME, state.x, memory=state.memory)[0]
        assert gap > 0.0
        balance.add_advance((k + 1) * FRAME, state)
        now = plan.energy(0.0, state.x, state.v, memory=state.memory)
        assert now <= energy * (1.0 + 2e-3)
        energy = min(energy, now)
    assert balance.dissipation > 0.05 * energy


def test_particle_stops_where_its_energy_is_used_up():
    # Undamped: b(s) = (w / U)^2; it leaves as fast as it came.
    model, _ = flat_sheet(2, 2, contact("plane", damping=0.0), gravity=False, drag=False)
    for speed in (0.5, 20.0):
        places = np.array([[x, y, 0.01] for x in (0.0, 1.0) for y in (0.0, 1.0)])
        plan, state, integrator = drop(model, places, (0.0, 0.0, -speed), tolerance=1e-6)
        least, k = np.inf, 0
        step = 2e-6 if speed > 1.0 else 2e-5
        while state.v[2, 0] < 0.0 or state.x[2, 0] < THICKNESS:
            integrator.advance(plan, state, k * step, step)
            least, k = min(least, state.x[2, 0]), k + 1
        s = least / THICKNESS
        assert (1.0 - s) ** 4 / s == pytest.approx((speed / 35.0) ** 2, rel=0.02)
        assert state.v[2] == pytest.approx(np.full(4, speed), rel=1e-4)


@pytest.mark.parametrize("tolerance", [1e-3, None])
def test_obstacle_at_10_m_per_s_penetrates_nothing(tolerance):
    ball = Obstacle(name="ball", shape="sphere", size=(0.3,))
    path = still((0.0, 0.0, -0.35))
    path[6] = 10.0
    contact_force = contact(ball, paths=[path])
    model, places = flat_sheet(12, 12, contact_force, size=0.5)
    plan, state, integrator = drop(model, places, tolerance=tolerance)
    balance = EnergyBalance(plan, state)
    for k in range(6):
        integrator.advance(plan, state, k * FRAME, FRAME, balance.accumulator)
        gaps = plan.contact.obstacle_gaps((k + 1) * FRAME, state.x, memory=state.memory)
        assert gaps[0, 1] > 0.0
        residual = balance.add_advance((k + 1) * FRAME, state)
        # The recorded gap is as coarse as the steps, which without a tolerance are as long as stability allows.
        assert residual <= (1e-2 if tolerance else 3e-2) * balance.energy_turnover
    assert state.x[2].max() > 0.5


def test_thin_obstacle_stops_particles_that_cross_it_in_a_step():
    # A free sheet's steps of 0.5 ms would carry it 10 mm at 20 m/s, over a plate of 1 mm.
    plate = Obstacle(name="plate", shape="box", size=(3.0, 3.0, 1e-3))
    model, places = flat_sheet(8, 8, contact(plate, paths=[still((0.0, 0.0, -0.117))]), size=0.3)
    for tolerance in (1e-3, None):
        plan, state, integrator = drop(model, places, (0.0, 0.0, -20.0), tolerance=tolerance)
        for k in range(4):
            integrator.advance(plan, state, k * FRAME, FRAME)
            assert state.x[2].min() > -0.117


def test_accelerating_particle_is_predicted():
    # It starts at rest out of reach, and springs throw it at 15 m/s within the frame.
    model, places = flat_sheet(10, 10, contact("plane", paths=[still((0.0, 0.0, -0.12))]), size=0.3)
    places[:, 2] = 0.3 * np.sin(20.0 * places[:, 0])
    places[:, 2] -= places[:, 2].min() - 0.01 + 0.12
    plan, state, integrator = drop(model, places, tolerance=1e-3)
    fastest = 0.0
    for k in range(12):
        integrator.advance(plan, state, k * FRAME, FRAME)
        fastest = max(fastest, float(np.abs(state.v).max()))
        assert plan.contact.obstacle_gaps(0.0, state.x, memory=state.memory)[0, 1] > 0.0
    assert fastest > 5.0


@pytest.mark.parametrize("integrator", ["leapfrog", "symplectic_euler"])
def test_fixed_step_above_contact_limit_is_reduced_or_refused(integrator):
    model, places = flat_sheet(8, 8, contact("plane"), size=0.3)
    places[:, 2] = 0.02
    plan, state, steps = drop(model, places, (0.0, 0.0, -10.0), integrator=integrator, step=2e-4)
    with pytest.raises(StepLimitError):
        steps.advance(plan, state, 0.0, FRAME)
    plan, state, steps = drop(model, places, integrator=integrator, step=1e-5)
    for k in range(10):
        assert steps.advance(plan, state, k * FRAME, FRAME).step <= 1e-5
    # It would have fallen to -0.11 m by now.
    assert 0.0 < state.x[2].min() < 0.02


def test_implicit_steps_penetrate_nothing():
    model, places = flat_sheet(8, 8, contact("sphere", paths=[BELOW["sphere"](0.02)]), size=0.3)
    plan, state, integrator = drop(model, places, (0.0, 0.0, -3.0), integrator="implicit", tolerance=1e-3)
    energy = plan.energy(0.0, state.x, state.v, memory=state.memory)
    for k in range(6):
        integrator.advance(plan, state, k * FRAME, FRAME)
        assert plan.contact.obstacle_gaps(0.0, state.x, memory=state.memory)[0, 1] > 0.0
        assert plan.energy(0.0, state.x, state.v, memory=state.memory) <= energy * (1.0 + 1e-3)


def test_restored_state_has_the_same_min_gap_and_steps():
    model, places = flat_sheet(10, 10, contact("box", paths=[BELOW["box"](0.004)]), size=0.4)
    plan, state, integrator = drop(model, places, tolerance=1e-4)
    for k in range(4):
        integrator.advance(plan, state, k * FRAME, FRAME)
    again = State.from_bytes(state.to_bytes())
    book = WorkAccumulator(plan.gripper_count, obstacle_count=1)
    for compared_state in (state, again):
        done = integrator.advance(plan, compared_state, 4 * FRAME, FRAME, book)
    assert done.steps > 0
    assert state.digest() == again.digest()


def test_cloth_held_between_pads_needs_no_estimate_in_each_frame() -> None:
    # Contact alone shortens the steps, so that pieces are halved before an attempt. That is no rough motion.
    values = parameter_file.read(CONFIG / "pinch.yaml")
    simulation = Simulation(Scene.from_parameters(values))
    events = ScriptEvents([GripperScript.from_file(CONFIG / "pinch_grasp.yaml")], simulation.scene.period)
    advances = [simulation.advance(events.at(frame)).advance for frame in range(290)]
    held = [advance for advance in advances[270:] if advance is not None]
    assert all(advance.steps > 200 for advance in held)
    assert sum(advance.evaluations > 1.5 * advance.steps for advance in held) <= 7
