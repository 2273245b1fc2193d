# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Extrapolation tableau: weights, and equal bits for any order of computation."""

from __future__ import annotations

import numpy as np
import pytest

from cloth_sim_ros import Model, PairSprings, State
from cloth_sim_ros.physics.integrators.extrapolation_tableau import ExtrapolationTableau, step_counts, weights
from cloth_sim_ros.physics.model.sheets.surface import grid_triangles
from cloth_sim_ros.physics.plan.plan import compile
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.simulation import Simulation

N_SIDE = 18
SCENES = {
    "grid": {"cloth.resolution": [N_SIDE, N_SIDE]},
    "mesh": {"cloth.mesh": "sheet.obj", "cloth.anchors": ["0", "17"], "bending.model": "none"},
}
every_scene = pytest.mark.parametrize("values", SCENES.values(), ids=SCENES.keys())


def sheet_file():
    line = np.linspace(-0.5, 0.5, N_SIDE)
    points = [f"v {x} {y} 0" for y in line for x in line]
    faces = [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in grid_triangles(N_SIDE, N_SIDE, "alternating")]
    return "\n".join([*points, *faces]).encode()


def started(values):
    scene = Scene.from_parameters(values, files={"sheet.obj": sheet_file()})
    simulation = Simulation(scene)
    rng = np.random.default_rng(2)
    free = simulation.model.inverse_masses > 0
    simulation.state.x[:, free] += 5e-3 * rng.standard_normal((3, int(free.sum())))
    simulation.state.v[:, free] += 0.3 * rng.standard_normal((3, int(free.sum())))
    return simulation


def tableau(simulation, **options) -> ExtrapolationTableau:
    return ExtrapolationTableau(simulation.plan, simulation.state, 0.0, 1 / 60, step_counts(60, 4), **options)


@pytest.mark.parametrize("first", [1, 2, 7, 40, 1001])
@pytest.mark.parametrize("n_runs", [1, 2, 3, 4, 5])
def test_weights_preserve_constants_and_cancel_step_powers(first, n_runs):
    counts = step_counts(first, n_runs)
    assert len(set(counts)) == n_runs and sorted(counts) == list(counts)
    run_weights = weights(counts)
    size = sum(abs(weight) for weight in run_weights)
    assert sum(run_weights) == pytest.approx(1.0, abs=1e-15 * size)
    for power in range(2, n_runs + 1):
        terms = [weight * (first / count) ** power for weight, count in zip(run_weights, counts, strict=True)]
        assert sum(terms) == pytest.approx(0.0, abs=1e-15 * size)


@every_scene
def test_runs_on_demand_equal_runs_in_one_call(values):
    simulation = started(values)
    together, on_demand = tableau(simulation), tableau(simulation)
    combination = together.combine(4)
    for n_runs in (1, 2, 3, 4):
        on_demand.combine(n_runs)
    assert np.array_equal(combination, on_demand.combine(4))
    assert together.summary(4) == on_demand.summary(4)
    assert together.summary(2) == on_demand.summary(2)
    assert [together.difference(k) for k in (1, 2, 3)] == [on_demand.difference(k) for k in (1, 2, 3)]
    assert together.evaluations == on_demand.evaluations >= sum(step_counts(60, 4)) + 4


@every_scene
@pytest.mark.parametrize("expected_runs", [0, 2, 3, 9])
def test_prefetched_runs_change_no_result(values, expected_runs, monkeypatch):
    simulation = started(values)
    by_turns = tableau(simulation)
    monkeypatch.setattr(simulation.plan, "concurrent_runs", lambda *_: 2)
    at_once = tableau(simulation, expected_runs=expected_runs)
    for runs in (1, 2, 4):
        assert np.array_equal(at_once.combine(runs), by_turns.combine(runs))
        assert at_once.summary(runs) == by_turns.summary(runs)
        # A prefetched run is counted only after its request.
        assert at_once.evaluations == by_turns.evaluations == sum(step_counts(60, 4)[:runs]) + runs
    assert at_once.difference(1) == by_turns.difference(1)


def test_brief_expected_runs_share_an_engine_call(monkeypatch):
    plan, state = compile(Model([0.1, 0.1], [PairSprings([[0, 1]], 1.0, 1.0, 0.1)])), State([[0, 0, 0], [0, 0, 1.5]])
    calculate, calls = plan.runs, []

    def seen(t, duration, start, steps, **options):
        calls.append(tuple(steps))
        return calculate(t, duration, start, steps, **options)

    monkeypatch.setattr(plan, "runs", seen)
    monkeypatch.setattr(plan, "concurrent_runs", lambda *_: 1)
    brief, long = step_counts(1), step_counts(int(plan.evaluations_per_call))
    for counts in (brief, long):
        runs = ExtrapolationTableau(plan, state, 0.0, 1 / 60, counts, expected_runs=2)
        runs.combine(1)
        assert runs.evaluations == counts[0] + 1
        runs.combine(2)
        assert runs.evaluations == sum(counts[:2]) + 2
    assert calls == [brief[:2], long[:1], long[1:2]]


@every_scene
def test_motion_is_equal_on_one_and_two_threads(values, monkeypatch):
    motions = []
    for threads in (1, 2):
        monkeypatch.setattr("cloth_sim_ros.physics.plan.plan.available_threads", lambda threads=threads: threads)
        concurrencies = []
        simulation = started({**values, "tolerance": 1e-5})
        one_or_two = simulation.plan.concurrent_runs

        def seen(*run, concurrencies=concurrencies, one_or_two=one_or_two):
            concurrencies.append(one_or_two(*run))
            return concurrencies[-1]

        monkeypatch.setattr(simulation.plan, "concurrent_runs", seen)
        frames = [simulation.advance().advance for _ in range(8)]
        assert set(concurrencies) == {threads}
        motions.append((simulation.state.digest(), frames))
    assert any(frame.rejected for frame in motions[0][1])
    assert motions[0] == motions[1]


@every_scene
def test_runs_leave_the_start_state_unchanged(values):
    simulation = started(values)
    state_before = simulation.state.x.copy(), simulation.state.v.copy()
    tableau(simulation).combine(3)
    assert np.array_equal(simulation.state.x, state_before[0])
    assert np.array_equal(simulation.state.v, state_before[1])


@every_scene
def test_summary_equals_direct_computation(values):
    simulation = started(values)
    runs = tableau(simulation)
    summary, (x, v) = runs.summary(2), runs.combine(2)
    assert summary.is_finite
    assert summary.turn == simulation.plan.turn_in_step(simulation.state.x, x, runs.counts[0])
    assert (summary.omega2, summary.damping) == simulation.plan.spectral_bounds(x)
    distances = np.linalg.norm(x - runs.combine(1)[0], axis=0), np.linalg.norm(v - runs.combine(1)[1], axis=0)
    assert runs.change(1) == pytest.approx((distances[0].max(), distances[1].max()), rel=1e-12)


@every_scene
def test_velocity_error_counts_with_its_later_displacement(values):
    simulation = started(values)
    runs = tableau(simulation)
    dv = runs.combine(2)[1] - runs.combine(1)[1]
    displacement, evaluations = simulation.plan.velocity_displacement(0.0, runs.combine(2)[0], dv, 0.5)
    assert evaluations > 1
    assert runs.difference(1) == pytest.approx(runs.change(1)[0] + displacement, rel=1e-12)


@every_scene
def test_approximate_difference_scales_the_last_displacement(values):
    runs = tableau(started(values))
    displacement = runs.difference(1) - runs.change(1)[0]
    assert runs.approximate_difference(1) == pytest.approx(runs.difference(1), rel=1e-12)
    runs.combine(3)
    evaluations, (distance, velocity_change) = runs.evaluations, runs.change(2)
    expected = distance + displacement * velocity_change / runs.change(1)[1]
    assert runs.approximate_difference(2) == pytest.approx(expected, rel=1e-9)
    assert runs.evaluations == evaluations


@every_scene
@pytest.mark.parametrize("n_runs", [1, 3])
def test_summary_reports_motion_that_is_not_finite(values, n_runs):
    simulation = started(values)
    simulation.state.v[1, 20] = 1e200
    assert not tableau(simulation).summary(n_runs).is_finite


@every_scene
def test_single_precision_changes_runs_by_rounding(values):
    simulation = started(values)
    single, double = tableau(simulation, single_precision=True), tableau(simulation)
    away = np.abs(single.combine(1)[0] - double.combine(1)[0]).max()
    assert 0.0 < away < 1e-5
    # The error is that of the steps; rounding is multiplied by the weight of the second run.
    bound = 4.0 * weights(step_counts(60, 2))[1] * away
    assert single.change(1)[0] == pytest.approx(double.change(1)[0], abs=bound)


@every_scene
@pytest.mark.parametrize("single_precision", [False, True])
@pytest.mark.parametrize("steps", [1, 2, 5, 8])
def test_activity_is_the_difference_of_both_halves(values, steps, single_precision):
    simulation = started(values)
    plan, state, step = simulation.plan, simulation.state, 1e-4
    first = steps // 2

    def velocities(count):
        return plan.runs(0.0, count * step, (state.x, state.v), [count], single_precision=single_precision)[0][0].v

    end, middle = velocities(steps), velocities(first) if first else state.v
    halves = (end - middle) / (steps - first), (middle - state.v) / max(first, 1)
    difference = (halves[0] - halves[1]) * (0.5 * steps if first else 1.0)
    for threads in (1, 2):
        run = plan.runs(
            0.0, steps * step, (state.x, state.v), [steps], single_precision=single_precision, threads=threads
        )[0][0]
        assert run.half_difference == pytest.approx(np.linalg.norm(difference, axis=0).max(), rel=1e-5)
        assert run.jerk_change == 0.0
    before = state.v + np.random.default_rng(2).normal(size=state.v.shape), 0.7 * steps * step
    from_before = end - state.v - (state.v - before[0]) / 0.7
    jerk_change = np.linalg.norm(difference - from_before / 3.4, axis=0).max() if first else 0.0
    for threads in (1, 2):
        run = plan.runs(
            0.0,
            steps * step,
            (state.x, state.v),
            [steps],
            single_precision=single_precision,
            threads=threads,
            before=before,
        )[0][0]
        assert run.jerk_change == pytest.approx(jerk_change, rel=1e-5)


@pytest.mark.parametrize(
    ("start", "end", "steps", "angle"),
    [
        # Past each other at 0.1 m, in 10 steps of 0.2 m.
        ((-1.0, 0.1, 0.0), (1.0, 0.1, 0.0), 10, 2.0),
        # Still 1 m apart, less half a step of 0.1 m.
        ((-2.0, 0.0, 0.0), (-1.0, 0.0, 0.0), 5, 0.2 / 0.9),
        # 1 m apart at the start, less half a step of 0.1 m.
        ((0.0, 1.0, 0.0), (0.0, 2.0, 0.0), 5, 0.2 / 0.9),
        ((0.0, 1.0, 0.0), (0.0, 1.0, 0.0), 5, 0.0),
    ],
)
def test_turn_in_step_is_the_angle_at_the_closest_approach(start, end, steps, angle):
    model = Model([1.0, 1.0], [PairSprings([[0, 1]], 0.5, 1.0)])
    positions = [np.array([np.zeros(3), point]).T.copy() for point in (start, end)]
    assert compile(model).turn_in_step(*positions, steps) == pytest.approx(angle, rel=1e-12)


def test_turn_in_step_of_a_sheet_is_that_of_its_springs():
    simulation = started({"cloth.resolution": [7, 6], "cloth.shear_layout": "alternating"})
    springs = [force for force in simulation.model.forces if hasattr(force, "pair_springs")]
    model = Model(simulation.model.masses, [force.pair_springs for force in springs])
    x = simulation.state.x + 0.3 * simulation.state.v
    turn = simulation.plan.turn_in_step(simulation.state.x, x, 3)
    assert turn == pytest.approx(compile(model).turn_in_step(simulation.state.x, x, 3), rel=1e-12)
    assert turn > 0.1


@every_scene
def test_change_from_the_interval_before(values):
    simulation = started(values)
    v0 = simulation.state.v
    runs = tableau(simulation)
    change = runs.combine(2)[1] - v0
    size = np.linalg.norm(change, axis=0).max()
    assert runs.summary(2).change_from_before == 0.0
    # In half the time before, the velocities changed by 3/2 of the present change.
    before = v0 - 1.5 * change, 0.5 * runs.duration
    for n_first in (1, 2):  # the combination of the first call is the engine's
        runs = tableau(simulation, before=before)
        runs.combine(n_first)
        assert runs.summary(2).change_from_before == pytest.approx(0.5 * size, rel=1e-12)
