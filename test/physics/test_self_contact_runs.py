# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Runs with self-contact: equal in every loop, with any list of pairs, without intersections."""

import numpy as np
import pytest
from support import self_scenes as own
from support.bounded_loops import rounds_until
from support.contact_scenes import drop, still
from support.self_scenes import folded
from test_contact_control import exact, furthest

from cloth_sim_ros.physics.accounting.energy_balance import EnergyBalance
from cloth_sim_ros.physics.contact.obstacles import Obstacle
from cloth_sim_ros.physics.model.forces.force import Force
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.plan.plan import compile
from cloth_sim_ros.physics.state.state import State

FRAME = 1.0 / 60.0
THICKNESS = 4e-3
TABLE = {"obstacles": [Obstacle(name="table", shape="plane")], "paths": [still((0.0, 0.0, -3e-3))]}
both_loops = pytest.mark.parametrize("listed", [False, True])


def start(model, places, velocities, **options):
    """Return the plan, the state and the integrator of a sheet at positions with velocities (n, 3)."""
    plan, _, integrator = drop(model, places, **options)
    return plan, State(places, velocities), integrator


def arrays(places, velocities):
    return np.ascontiguousarray(places.T), np.ascontiguousarray(velocities.T)


@both_loops
def test_a_run_is_that_of_the_forces(listed):
    model, places, velocities = folded(10, radius=0.035, listed=listed, gravity=False, drag=False)
    places[velocities[:, 2] < 0.0, 2] = 0.9 * THICKNESS
    plan, (x, v) = compile(model), arrays(places, velocities)
    (run,), _ = plan.runs(0.0, 2e-3, (x, v), [100], memory={})
    a, before, last, h = np.empty_like(x), None, None, 2e-5
    y, w = x, v
    plan.accelerations(0.0, y, w, a, memory={})
    before = last = a.copy()
    for _ in range(100):
        y = y + 0.5 * h * w
        plan.accelerations(0.0, y, w + 0.25 * h * (last + before), a, memory={})
        w = w + h * a
        y, last, before = y + 0.5 * h * w, a.copy(), last
    assert run.min_gap < THICKNESS
    assert run.self_contact[0] > 0.0
    assert run.x == pytest.approx(y, abs=1e-12)
    assert run.v == pytest.approx(w, abs=1e-9)


@both_loops
def test_no_bit_depends_on_pair_searches_or_threads(listed):
    model, places, velocities = folded(12, listed=listed, **TABLE)
    plan, state, integrator = start(model, places, velocities, tolerance=1e-3)
    for _ in rounds_until(lambda: plan.contact.self_gaps(state.x)[0]):
        integrator.advance(plan, state, 0.0, 5e-3)
    start_at, ends = (state.x, state.v), []
    for keeps, threads in ((True, 1), (False, 1), (True, 2), (True, 8)):
        plan = compile(model)
        plan.contact.reuse_pairs(keeps)
        (run,), _ = plan.runs(0.0, 5e-3, start_at, [400], threads=threads, memory={})
        (run,), _ = plan.runs(5e-3, 5e-3, (run.x, run.v), [400], threads=threads, memory={})
        ends.append(run)
    assert 0.0 < ends[0].min_gap < THICKNESS
    for run in ends[1:]:
        assert np.array_equal(ends[0].x, run.x)
        assert np.array_equal(ends[0].v, run.v)
        assert ends[0].min_gap == run.min_gap
        assert ends[0].self_contact == run.self_contact


@both_loops
def test_run_with_steps_too_long_for_contact_has_no_result(listed):
    # A layer of 4 mm, twice, at 20 m/s: in 0.4 ms it is 8 mm further.
    model, places, velocities = folded(10, radius=0.035, speed=20.0, listed=listed, gravity=False, drag=False)
    places[velocities[:, 2] < 0.0, 2] = 5e-3
    plan, (x, v) = compile(model), arrays(places, velocities)
    (run,), (_, _, summary) = plan.runs(0.0, 1.6e-3, (x, v), [4], weights=[1.0], memory={})
    assert np.isnan(run.x).all()
    assert not summary.is_finite
    (fine,), (_, _, summary) = plan.runs(0.0, 1.6e-3, (x, v), [400], weights=[1.0], memory={})
    assert summary.is_finite
    assert 0.0 < fine.min_gap < THICKNESS


@pytest.mark.parametrize("rise", [5e-3, 9e-3])
def test_particle_on_the_other_side_after_a_step_fails_the_run(rise):
    # A layer that is 5 or 9 mm above another one and 16 mm lower a step later, beyond the reach of any force.
    triangles, rest_positions, x, masses = own.sheets(0.0, rise, shift=(0.003, 0.004))
    plan = compile(own.alone(triangles, rest_positions, masses, THICKNESS))
    v = np.zeros_like(x)
    v[25:, 2] = -20.0
    (run,), _ = plan.runs(0.0, 1.6e-3, arrays(x, v), [2], memory={})
    assert np.isnan(run.x).all()
    v[25:, 2] = 20.0
    (run,), _ = plan.runs(0.0, 1.6e-3, arrays(x, v), [2], memory={})
    assert run.x[2, 25:] == pytest.approx(np.full(25, rise + 0.032), abs=1e-12)


@pytest.mark.parametrize("tolerance", [1e-3, 1e-4, 1e-5])
def test_a_sheet_that_falls_on_itself_keeps_its_tolerance(tolerance):
    model, places, velocities = folded(12, **TABLE)
    plan, state, integrator = start(model, places, velocities, tolerance=tolerance)
    end = exact(plan, state, 8 * FRAME)
    kick = 1e-8 * np.random.default_rng(0).standard_normal(state.x.shape)
    kicked = exact(plan, State((state.x + kick).T, state.v.T), 8 * FRAME)
    growth = furthest(end, kicked) / furthest(kick, np.zeros_like(kick))
    flagged, met = 0, 0
    for k in range(8):
        flagged += integrator.advance(plan, state, k * FRAME, FRAME).flagged
        met += plan.contact.self_gaps(state.x)[0]
    assert met > 10
    assert not flagged
    assert furthest(state.x, end) <= tolerance * max(1.0, growth)


@both_loops
@pytest.mark.parametrize("tolerance", [1e-3, None])
def test_layers_meeting_at_20_m_per_s_do_not_intersect(listed, tolerance):
    model, places, velocities = folded(12, radius=0.03, speed=20.0, listed=listed, drag=False)
    plan, state, integrator = start(model, places, velocities, tolerance=tolerance, work=0.0)
    energy, least = plan.energy(0.0, state.x, state.v, memory=state.memory), np.inf
    balance = EnergyBalance(plan, state)
    for k in range(4):
        before = state.x.copy()
        done = integrator.advance(plan, state, k * FRAME, FRAME, balance.accumulator)
        assert done.integrator != "implicit"
        least = min(least, plan.contact.self_gaps(state.x)[1])
        assert least > 0.0
        now = plan.energy(0.0, state.x, state.v, memory=state.memory)
        assert now <= energy * (1.0 + 2e-3)
        energy = min(energy, now)
        assert not np.array_equal(before, state.x)
    assert least < THICKNESS


def test_energy_balance_includes_contact_dissipation():
    model, places, velocities = folded(12, drag=False)
    plan, state, integrator = start(model, places, velocities, tolerance=1e-5)
    balance = EnergyBalance(plan, state)
    for k in range(6):
        integrator.advance(plan, state, k * FRAME, FRAME, balance.accumulator)
        residual = balance.add_advance((k + 1) * FRAME, state)
    assert residual <= 1e-3 * balance.energy_turnover
    # In addition to the threads' own damping.
    assert balance.dissipation > 0.0


def test_implicit_steps_penetrate_nothing():
    model, places, velocities = folded(10, radius=0.035, speed=2.0)
    plan, state, integrator = start(model, places, velocities, integrator="implicit", tolerance=1e-3)
    energy, met = plan.energy(0.0, state.x, state.v, memory=state.memory), 0
    for k in range(8):
        start_at = state.x.copy()
        integrator.advance(plan, state, k * FRAME, FRAME)
        assert np.isfinite(state.x).all()
        assert not np.array_equal(start_at, state.x)
        met += plan.contact.self_gaps(state.x)[0]
        assert plan.energy(0.0, state.x, state.v, memory=state.memory) <= energy * (1.0 + 1e-3)
    assert met > 0


def test_straight_paths_through_the_cloth_are_detected():
    triangles, rest_positions, x, masses = own.sheets(0.0, 3e-3, shift=(0.003, 0.004))
    plan = compile(own.alone(triangles, rest_positions, masses, THICKNESS))
    ends = {}
    for rise in (-2e-3, -4e-3, 30e-3):
        end = x.copy()
        end[25:, 2] += rise
        ends[rise] = plan.contact.ccd_surface_hits(
            0.0, 0.0, np.ascontiguousarray(x.T), np.ascontiguousarray(end.T), memory={}
        )
    assert ends == {-2e-3: False, -4e-3: True, 30e-3: False}
    # Edges that cross far from any particle.
    rods = np.array([[0, 1, 2], [3, 4, 5]])
    places = np.array([[-1, 0, 0], [1, 0, 0], [0, 9, 0], [0, -1, 0.1], [0, 1, 0.1], [0, 0, 9]], dtype=float)
    plan = compile(own.alone(rods, places, np.ones(6), 0.05))
    end = places.copy()
    end[3:, 2] -= 0.2
    assert plan.contact.ccd_surface_hits(
        0.0, 0.0, np.ascontiguousarray(places.T), np.ascontiguousarray(end.T), memory={}
    )


@pytest.mark.parametrize(("speed", "is_predicted"), [(1.0, False), (6.0, False), (6.3, True)])
def test_edges_are_predicted_if_particles_may_not_stop_layers(speed, is_predicted):
    # Two edges that cross far from any particle, 0.1 m apart; they keep 25 mm.
    rods = np.array([[0, 1, 2], [3, 4, 5]])
    places = np.array([[-1, 0, 0], [1, 0, 0], [0, 0, -9], [0, -1, 0.1], [0, 1, 0.1], [0, 0, 9]], dtype=float)
    velocities = np.zeros_like(places)
    velocities[3:, 2] = -speed
    plan = compile(own.alone(rods, places, np.ones(6), 0.05))
    x, v = arrays(places, velocities)
    omega2, damping = plan.contact.predict_surface_contact(0.0, 0.2, x, v, memory={})
    assert (omega2 > 0.0) == (damping > 0.0) == is_predicted
    # The run resolves them either way, and they do not pass.
    (run,), _ = plan.runs(0.0, 0.12 / speed, (x, v), [4000], memory={})
    assert run.self_contact[0] > 0.0
    assert 0.0 < run.min_gap < 0.025
    assert not plan.contact.ccd_surface_hits(0.0, 0.0, x, run.x, memory={})


@both_loops
@pytest.mark.parametrize("speed", [0.02, 10.0])
def test_frame_without_near_pairs_skips_contact_with_same_bits(listed, speed):
    # At 0.02 m/s no contact is possible, and runs skip it. At 10 m/s it is possible.
    model, places, _ = folded(8, radius=0.06, thickness=3e-3, listed=listed, gravity=False)
    velocities = np.zeros_like(places)
    velocities[:, 0] = speed * np.sin(20.0 * places[:, 1])
    plain, _, _ = folded(8, radius=0.06, thickness=3e-3, listed=listed, gravity=False)
    without = Model(plain.masses, [force for force in plain.forces if force.name != "contact"])
    ends = []
    for compared_model in (model, without):
        plan = compile(compared_model)
        (run,), _ = plan.runs(0.0, 5e-3, arrays(places, velocities), [60], memory={})
        ends.append(run)
    plan = compile(model)
    assert plan.contact.is_clear_of_itself(5e-3, *arrays(places, velocities)) == (speed < 1.0)
    assert ends[0].min_gap > 1.0
    assert ends[0].self_contact == (0.0, 0.0)
    assert np.array_equal(ends[0].x, ends[1].x)
    assert np.array_equal(ends[0].v, ends[1].v)


class Push(Force):
    """A Python force that accelerates some particles downwards."""

    name = "push"

    def __init__(self, who, masses, acceleration):
        self._weights = np.where(who, masses * acceleration, 0.0)

    def add_force(self, t, x, v, f):
        f[2] -= self._weights


def test_frame_faster_than_assumed_is_repeated_with_contact():
    # At rest, 60 mm apart; the upper half is thrown down within the frame.
    model, places, velocities = folded(10, radius=0.03, size=0.25, gravity=False, drag=False)
    push = Push(velocities[:, 2] < 0.0, model.masses, 4000.0)
    plan = compile(Model(model.masses, [*model.forces, push]))
    start_at = arrays(places, np.zeros_like(places))
    assert plan.contact.is_clear_of_itself(6e-3, *start_at)
    (run,), _ = plan.runs(0.0, 6e-3, start_at, [3000], memory={})
    assert 0.0 < run.min_gap < THICKNESS
    assert run.self_contact[0] > 0.0
