# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rules of step control, each on a motion with a known solution."""

from __future__ import annotations

import math
from types import SimpleNamespace
from unittest import mock

import attrs
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from cloth_sim_ros import Gravity, Model, PairSprings, Scene, Simulation, State, simulate
from cloth_sim_ros.engine.binding import PATH_NUMBERS
from cloth_sim_ros.physics.control.automatic import make_integrator
from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.control.error import ErrorRule
from cloth_sim_ros.physics.control.fallback import FALLBACK_EVALUATIONS, finish_implicitly
from cloth_sim_ros.physics.control.leapfrog import Leapfrog
from cloth_sim_ros.physics.control.multirate import MAX_RATIO
from cloth_sim_ros.physics.control.stability import LIMIT_FRACTIONS, MAX_UNDAMPED_STEPS, StabilityRule
from cloth_sim_ros.physics.control.work_budget import WorkBudget
from cloth_sim_ros.physics.integrators.extrapolation_tableau import coefficient_of, step_counts, weights
from cloth_sim_ros.physics.integrators.limit import steps_for
from cloth_sim_ros.physics.integrators.stage_matrix import StageMatrix
from cloth_sim_ros.physics.model.forces.force import Force
from cloth_sim_ros.physics.model.forces.grips import Grips
from cloth_sim_ros.physics.plan.plan import compile
from cloth_sim_ros.physics.state.controller_state import (
    SECOND_DIFFERENCES_KEY,
    ErrorState,
    FallbackState,
    StabilityState,
)
from cloth_sim_ros.simulation.events import Grasp, Target

#: Allowed growth of an undamped wave per step.
UNDAMPED_GROWTH = 1e-5
TOLERANCES = [1e-3, 1e-5, 1e-7, 1e-9]


def critical() -> tuple[Model, State]:
    """Return a critically damped mass on a spring, released at a stretch of a fifth."""
    stiffness, mass = 100.0, 0.1
    spring = PairSprings([[0, 1]], 1.0, stiffness, 2.0 * math.sqrt(stiffness * mass))
    return Model([mass, mass], [spring], anchors=[0]), State([[0.0, 0.0, 0.0], [1.2, 0.0, 0.0]])


def taut() -> tuple[Model, State]:
    """Return an undamped chain of seven particles, stretched by a tenth, with a transverse impulse."""
    springs = PairSprings(np.stack([np.arange(6), np.arange(1, 7)], axis=1), 0.1, 200.0, 0.0)
    positions, velocities = np.zeros((7, 3)), np.zeros((7, 3))
    positions[:, 0] = 0.11 * np.arange(7)
    velocities[3, 2], velocities[2, 0] = 0.5, 0.2
    return Model(np.full(7, 0.01), [springs, Gravity()], anchors=[0, 6]), State(positions, velocities)


def reference_end(model: Model, state: State) -> np.ndarray:
    """Return positions after one second by an independent method, shape (3, n)."""
    plan, shape = compile(model), state.x.shape

    def slope(t: float, y: np.ndarray) -> np.ndarray:
        x, v = y.reshape(2, *shape)
        a = np.empty(shape)
        plan.accelerations(t, np.ascontiguousarray(x), np.ascontiguousarray(v), a)
        return np.concatenate([v.ravel(), a.ravel()])

    start = np.concatenate([state.x.ravel(), state.v.ravel()])
    solution = solve_ivp(slope, (0.0, 1.0), start, method="DOP853", rtol=1e-12, atol=1e-13)
    return solution.y[: state.x.size, -1].reshape(shape)


@pytest.mark.parametrize("make_system", [critical, taut])
def test_small_systems_satisfy_every_tolerance(make_system) -> None:
    reference, previous_error = reference_end(*make_system()), math.inf
    for tolerance in TOLERANCES:
        model, state = make_system()
        motion = simulate(model, state, 1.0, tolerance=tolerance)
        error = np.abs(state.x - reference).max()
        assert error < tolerance
        assert error <= max(previous_error, 0.1 * tolerance)
        assert not any(advance.flagged for advance in motion.advances)
        previous_error = error


def violent_sheet(work_limit: float = 3.0) -> Simulation:
    """Return a sheet with hinges that become stiff when folded."""
    values = {"work_limit": work_limit, "material.stretch_modulus": 5e3, "cloth.resolution": [9, 9]}
    values |= {"bending.model": "crossed", "material.bending_modulus": 1e-5, "gripper.max_speed": 0.0}
    return Simulation(Scene.from_parameters(values))


def test_frame_work_stays_below_limit_and_excess_is_flagged(monkeypatch: pytest.MonkeyPatch) -> None:
    simulation, rng, flagged, costs = violent_sheet(0.5), np.random.default_rng(2), [], []
    plan, run = simulation.plan, simulation.plan.runs

    def watched(t, duration, start, steps, *, multirate=1, **options):  # type: ignore[no-untyped-def]
        costs.append(sum(steps) * plan.multirate_step_cost(multirate))
        return run(t, duration, start, steps, multirate=multirate, **options)

    monkeypatch.setattr(plan, "runs", watched)
    monkeypatch.setattr(plan, "concurrent_runs", lambda *_: 1)  # runs that are never requested do not count
    max_cost = simulation.scene.work_limit * simulation.scene.period * 1e9 / plan.model.particle_count
    simulation.advance([Target("gripper", simulation.positions[-1]), Grasp("gripper", True)])
    for _ in range(40):
        costs.clear()
        done = simulation.advance([Target("gripper", simulation.positions[-1] + rng.normal(size=3) * 0.3)]).advance
        assert sum(costs) <= max_cost
        assert done.evaluations <= max_cost / plan.multirate_step_cost(MAX_RATIO)
        if done.flagged:
            flagged.append((done.limited_by, done.reason))
    assert np.isfinite(simulation.positions).all()
    assert flagged
    assert all(bound == "work" and "work limit" in reason for bound, reason in flagged)


@pytest.mark.parametrize("most", [0.0, 64.0, 80.0, 110.0])
def test_implicit_finish_stays_within_remaining_work(most: float) -> None:
    simulation = violent_sheet()
    free = simulation.model.inverse_masses > 0.0
    for seed in range(3):
        start = simulation.state.copy()
        start.x = start.x + np.random.default_rng(seed).normal(size=start.x.shape) * free
        ends = {most: start.copy(), math.inf: start.copy()}
        evaluations = {
            limit: finish_implicitly(
                simulation.plan, state, 0.0, 1 / 60, None, instead_of="extrapolated", max_evaluations=limit
            ).evaluations
            for limit, state in ends.items()
        }
        # Eight steps of eight descent iterations are the minimum that finishes a frame.
        assert evaluations[most] <= max(most, 64.0) < evaluations[math.inf]
        assert np.isfinite(ends[most].x).all()


def test_implicit_finish_of_a_large_sheet_factorises_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    simulation = violent_sheet()
    plan, start = simulation.plan, simulation.state.copy()
    free = simulation.model.inverse_masses > 0.0
    start.x = start.x + 0.5 * np.random.default_rng(0).normal(size=start.x.shape) * free
    energy = plan.energy(0.0, start.x, start.v)

    def refuse(*_: object) -> None:
        raise AssertionError("the matrix is factorised")

    monkeypatch.setattr(StageMatrix, "update", refuse)
    end = start.copy()
    result = finish_implicitly(
        plan, end, 0.0, 1 / 60, None, instead_of="extrapolated", max_evaluations=1e4, max_time=1e-9
    )
    assert result.flagged > 0
    assert np.isfinite(end.x).all()
    # The sheet is crumpled: most of its energy is that of springs, and damping takes it away.
    assert 0.0 < plan.energy(0.0, end.x, end.v) < 0.5 * energy


def test_jerk_between_estimates_is_detected() -> None:
    """A mass falls freely, without any error, until its slack spring becomes taut."""
    spring = PairSprings([[0, 1]], 0.5, 40.0, 0.05)
    model, state = Model([0.1, 0.1], [spring, Gravity()], anchors=[0]), State([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]])
    reference = reference_end(model, State(state.positions))
    simulate(model, state, 1.0, tolerance=1e-6)
    assert np.abs(state.x - reference).max() < 1e-6


class _Floor(Force):
    """Stiff floor at z = 0, with a jump of stiffness."""

    name = "floor"

    def add_force(self, t: float, x: np.ndarray, v: np.ndarray, f: np.ndarray) -> None:
        f[2] -= 1e6 * np.minimum(x[2], 0.0)

    def energy(self, t: float, x: np.ndarray) -> float:
        return 0.5e6 * float(np.sum(np.minimum(x[2], 0.0) ** 2))

    def add_stiffness(self, x: np.ndarray, blocks: np.ndarray) -> None:
        blocks[2] += 1e6 * (x[2] < 0.0)


def bounce_height(height: float) -> float:
    """Return the height [m] of a particle one second after its release at a height [m] above that floor."""
    g, w, fall = 9.81, 1e3, math.sqrt(2.0 * height / 9.81)
    # Half an oscillation about -g/w^2, entered and left at the speed of the fall.
    contact_time = 2.0 / w * (math.pi - math.atan2(fall * w, 1.0))
    elapsed = (1.0 - fall - contact_time) % (2.0 * fall + contact_time)
    return g * fall * elapsed - 0.5 * g * elapsed * elapsed


def test_impact_costs_fine_steps_only_around_it() -> None:
    plan, state = compile(Model([1.0], [Gravity(), _Floor()])), State([[0.0, 0.0, 0.3]])
    integrator = make_integrator("extrapolated", tolerance=1e-4)
    advances = [integrator.advance(plan, state, k / 60, 1 / 60) for k in range(60)]
    growth = max(1.0, abs(bounce_height(0.3 + 1e-6) - bounce_height(0.3)) / 1e-6)
    assert abs(state.x[2, 0] - bounce_height(0.3)) < 1e-4 * growth
    assert not any(advance.flagged for advance in advances)
    # Two of 60 frames contain an impact. Equally fine steps in all of both would take millions of evaluations.
    assert sum(result.evaluations for result in advances) < 30_000


def test_undamped_combinations_are_divided_into_parts() -> None:
    model, state = taut()
    plan, counts = compile(model), []
    run = plan.runs

    def watched(t, duration, start, steps, **options):  # type: ignore[no-untyped-def]
        counts.append(list(steps[: len(options["weights"] or ())]))
        return run(t, duration, start, steps, **options)

    plan.runs = watched  # type: ignore[method-assign]
    integrator = make_integrator("extrapolated", tolerance=1e-7)
    for frame in range(4):
        integrator.advance(plan, state, frame / 60, 1 / 60)
    combined = [steps for steps in counts if len(steps) > 1]
    assert combined
    assert all(steps[0] <= 6 for steps in combined)


def test_constants_are_described() -> None:
    import attrs

    fields = attrs.fields(type(CONSTANTS))
    assert all(field.metadata["meaning"] for field in fields)


@pytest.mark.parametrize("columns", [1, 2, 3, 4])
def test_undamped_wave_growth_of_short_combinations_is_bounded(columns: int) -> None:
    """Check the eigenvalues of the stability function of a combination for every wave of the sheet.

    Frames of four steps and more are divided into parts of four to six.
    """
    for first in range(4, MAX_UNDAMPED_STEPS + 1):
        counts = step_counts(first, columns)
        for fraction in np.linspace(0.02, 1.0, 50):
            phase = 2.0 * CONSTANTS.stability_safety * LIMIT_FRACTIONS[0.0][columns - 1] * fraction * first
            combination = np.zeros((2, 2))
            for weight, count in zip(weights(counts), counts, strict=True):
                z = phase / count
                step = np.array([[1.0 - z * z / 2.0, z * (1.0 - z * z / 4.0)], [-z, 1.0 - z * z / 2.0]])
                combination += weight * np.linalg.matrix_power(step, count)
            growth = math.log(np.abs(np.linalg.eigvals(combination)).max()) / first
            assert growth < UNDAMPED_GROWTH, (first, fraction, growth)


@pytest.mark.parametrize("columns", [2, 3, 4])
def test_combinations_by_the_rule_amplify_no_damped_wave(columns: int) -> None:
    """Check the eigenvalues of combinations over the rule's pieces, for waves of a sheet whose springs are alike."""
    for damping_time in np.geomspace(1e-3, 1.0, 7):
        stability = StabilityState(omega2=4.0, damping=4.0 * damping_time)
        plan = SimpleNamespace(damps_waves=True, min_damping_time=lambda _, c=damping_time: c)
        rule = StabilityRule(plan, stability, np.zeros((3, 1)))  # type: ignore[arg-type]
        max_step = CONSTANTS.stability_safety * rule.sheet_limit
        for count in (4, 12, 40, 120):
            length = count * max_step
            # Units of time and stiffness are arbitrary; a frame is never divided because of its length.
            with mock.patch.object(CONSTANTS, "max_interval", length):
                steps = steps_for(length, max_step / rule.min_refinement(columns, length))
                pieces = rule.n_pieces(columns, steps, length)
            piece = length / pieces
            counts = step_counts(math.ceil(steps / pieces), columns)
            for omega2 in np.linspace(0.1, 2.0, 40) ** 2:
                combination = sum(
                    weight * damped_run(omega2, damping_time * omega2, piece, n)
                    for weight, n in zip(weights(counts), counts, strict=True)
                )
                growth = math.log(np.abs(np.linalg.eigvals(combination)).max()) / counts[0]
                assert growth < UNDAMPED_GROWTH, (damping_time, count, omega2)


def damped_run(omega2: float, damping: float, length: float, n: int) -> np.ndarray:
    """Return the matrix by which a run of n steps changes position and velocity of a damped wave."""
    h, motion = length / n, np.zeros((4, 2))
    # Rows: position, velocity, predicted velocity, acceleration of the step before.
    motion[:2] = np.eye(2)
    motion[3] = -omega2 * motion[0] - damping * motion[1]
    motion[2], motion[0] = motion[1] + h / 2.0 * motion[3], motion[0] + h / 2.0 * motion[1]
    for step in range(n):
        acceleration = -omega2 * motion[0] - damping * motion[2]
        motion[1] = motion[1] + h * acceleration
        motion[2] = motion[1] + h / 4.0 * (acceleration + motion[3])
        motion[3], motion[0] = acceleration, motion[0] + (h if step < n - 1 else h / 2.0) * motion[1]
    return motion[:2]


def test_soft_undamped_grip_does_not_shorten_steps() -> None:
    stiffness, grips, path = 1e5, Grips(1), np.zeros((1, PATH_NUMBERS))
    spring = PairSprings([[0, 1]], 1.0, stiffness, 2.0 * math.sqrt(stiffness))
    plan, x = compile(Model([1.0, 1.0], [spring, grips], anchors=[0])), np.eye(3)[:, :2].copy()
    path[0, 16] = 1.0
    for fraction, is_shorter in ((0.01, False), (0.1, True)):
        grip = np.array([fraction * stiffness]), np.zeros(1)
        grips.set_grips(path, np.array([0, 1]), np.array([1]), np.zeros((1, 3)), *grip)
        rule = StabilityRule(plan, StabilityState(), x)
        assert (rule.min_refinement(3, 1.0 / 60.0) > 1.0) == is_shorter


def test_changed_frame_length_causes_a_new_estimate() -> None:
    model, state = taut()
    plan, integrator = compile(model), make_integrator("extrapolated", tolerance=1e-4)
    for frame in range(3):
        integrator.advance(plan, state, frame / 60, 1 / 60)
    error_state = ErrorState.load(state)
    assert error_state.time_until_estimate > 0.0
    error_state.time_until_estimate = error_state.estimate_period = 50.0
    error_state.store(state)
    integrator.advance(plan, state, 0.05, 1 / 30)
    assert ErrorState.load(state).estimate_period < 50.0
    assert ErrorState.load(state).duration == 1 / 30


def test_tolerance_below_rounding_is_flagged_and_ends() -> None:
    model, state = critical()
    state.x += 1e4
    result = make_integrator("extrapolated", tolerance=1e-12).advance(compile(model), state, 0.0, 1 / 60)
    assert result.flagged == 1
    assert "finer than rounding" in result.reason
    assert result.evaluations < 10_000


def test_rounding_of_fast_particle_requires_no_finer_steps() -> None:
    # Each step rounds the velocity of the falling particle alike, so that finer steps have larger errors.
    springs = PairSprings([[0, 1], [1, 2]], 0.0, [2.8, 730.0], [0.0, 0.0])
    model = Model([1.0, 1.0, 0.01, 1.0], [springs, Gravity()], anchors=[0])
    positions = [[0.0, 0.0, 0.0], [0.01, 0.0, -3.5], [0.01, 0.4, -3.5], [3.0, 0.0, -4.7]]
    state = State(positions, [[0.0, 0.0, 0.0]] * 3 + [[0.0, 0.0, -50.0]])
    advances = simulate(model, state, 0.04, save_at=1e-3 * np.arange(1, 41), tolerance=1e-9).advances
    assert sum(advance.evaluations for advance in advances) < 100 * len(advances)


@pytest.mark.parametrize(("excess", "scale"), [(27.0, 3.0), (1.0, 1.0), (1 / 8, 1 / 2)])
def test_step_below_rounding_balances_rounding_and_order(excess: float, scale: float) -> None:
    model, state = critical()
    stability, memory = StabilityRule(compile(model), StabilityState(), state.x), ErrorState(duration=0.01)
    rule = ErrorRule(memory, 1e-6, 4, state, stability, lambda _: 0.0)
    floor = rule.rounding_floor(1, 6, 0.0)
    n_runs, refinement = rule.choose_runs([excess * floor], 10.0, 1e-3 * floor, 0.01, 6)
    assert (n_runs, refinement) == (1, pytest.approx(10.0 * scale))
    assert rule.choose_runs([excess * floor], 10.0, -1e-9, 0.01, 6) == (n_runs, refinement)
    # An error within its budget, here 1.7 times its target, does not allow longer steps than it needs.
    error = excess * floor
    assert rule.choose_runs([error], 10.0, 0.6 * error, 0.01, 6)[1] >= 10.0


def test_doubled_activity_is_not_predicted() -> None:
    model, state = critical()
    memory = ErrorState(error=1e-12, activity=1e-3, step=1e-3, coefficient=1e-6, duration=0.01)
    rule = ErrorRule(memory, 1e-6, 4, state, StabilityRule(compile(model), StabilityState(), state.x), lambda _: 0.0)
    assert rule.predict((10,), 0.01, (0.0, 0.0), 1.9e-3, 0.0)[0] == pytest.approx(1.9**3 * 1e-12)
    assert rule.predict((10,), 0.01, (0.0, 0.0), 2.1e-3, 0.0)[0] == math.inf
    # A single run has an error of second order; a run of a few steps has no order.
    assert rule.predict((20,), 0.01, (0.0, 0.0), 1e-3, 0.0)[0] == pytest.approx(1e-12 / 4)
    assert rule.predict((5,), 0.01, (0.0, 0.0), 1e-3, 0.0)[0] == math.inf


def test_activity_beyond_the_estimated_error_is_not_predicted() -> None:
    # An oscillator with this activity [m/s] errs by 0.01 s * activity / (6 * 10^2) in ten steps: 1e-6 m.
    activity, (model, state) = 0.06, critical()
    stability = StabilityRule(compile(model), StabilityState(), state.x)

    def predict(budget: float, error: float) -> float:
        memory = ErrorState(error=error, activity=activity, step=1e-3, coefficient=1e-6, duration=0.01)
        rule = ErrorRule(memory, budget, 4, state, stability, lambda _: 0.0)
        return rule.predict((10,), 0.01, (0.0, 0.0), activity)[0]

    assert predict(1.9e-6, 0.4e-6) == math.inf
    assert predict(1.9e-6, 0.6e-6) < math.inf
    assert predict(2.1e-6, 0.0) < math.inf


def test_change_that_another_particle_hides_is_not_predicted() -> None:
    # Second differences are 1e-3 m at the first particle, as in the last estimate. At the second they were 0 then.
    (model, state), known = critical(), np.array([[1e-3, 0.0], [0.0, 0.0]])
    stability = StabilityRule(compile(model), StabilityState(), state.x)
    state.memory[SECOND_DIFFERENCES_KEY] = known
    coefficients = {"coefficient": 1e-9, "lower_order_coefficient": coefficient_of((10,), 0.01)}
    errors = {"n_runs": 2.0, "error": 1e-9, "lower_order_error": 1e-3, **coefficients}

    def predict(hidden: float | None) -> float:
        memory = ErrorState(**errors, step=1e-3, activity=1.0, duration=0.01)
        rule = ErrorRule(memory, 2e-6, 4, state, stability, lambda _: 0.0)
        differences = None if hidden is None else np.array([[1e-3, hidden], [0, 0]])
        return rule.predict((10, 12), 0.01, (1e-3, 0.0), 1.0, 0.0, 0.0, lambda: differences)[0]

    # A gain of 0.03 leaves more than the target of a micrometre of 4e-5 m, and less of 3e-5 m.
    assert predict(4e-5) == math.inf
    assert predict(3e-5) < math.inf
    # Without pieces before, the largest change is compared.
    assert predict(None) < math.inf
    errors["lower_order_error"] = 4e-4
    assert predict(None) == math.inf


def test_single_run_without_damping_is_confirmed_by_further_runs() -> None:
    model, state = taut()
    undamped, omega2 = StabilityRule(compile(model), StabilityState(), state.x), 1e6
    undamped.memory.omega2 = omega2
    longest = 1.9 / math.sqrt(omega2)
    assert [undamped.count_confirming_runs(n, n * longest) for n in (10, 40, 64, 65, 300)] == [0, 1, 1, 2, 2]
    # Phases of shorter steps do not differ by a turn.
    assert undamped.count_confirming_runs(40, 20 * longest) == 0
    # Damping removes the waves of other models.
    model, state = critical()
    damped = StabilityRule(compile(model), StabilityState(), state.x)
    assert damped.count_confirming_runs(40, 40 * 1.9 / math.sqrt(damped.memory.omega2)) == 0


def test_confirmed_single_run_of_the_leapfrog_stays_single() -> None:
    # Two runs would suffice for the slow joint. The stiff one, which rests, requires thirty steps.
    springs = PairSprings([[0, 1], [0, 2]], 0.0, [(1.8 * 30 * 60.0) ** 2, 25.0], 0.0)
    model, state = Model([1.0] * 3, [springs], anchors=[0]), State([[0.0] * 3, [0.0] * 3, [1.0, 0.0, 0.0]])
    plan, integrator = compile(model), Leapfrog(tolerance=1e-6)
    for frame in range(3):
        assert "order 2," in integrator.advance(plan, state, frame / 60, 1 / 60).reason


def test_piece_of_a_frame_has_two_steps_at_least() -> None:
    # The activity of free fall is not the whole change of velocity, so few frames have an estimate.
    state = State(np.zeros((1, 3)))
    integrator, plan = make_integrator("auto", tolerance=1e-6), compile(Model([1.0], [Gravity()]))
    advances = [integrator.advance(plan, state, k / 12.0, 1.0 / 12.0) for k in range(24)]
    assert sum(advance.evaluations < 10 for advance in advances) > 12


def test_doubled_jerk_change_is_predicted_if_it_displaces_little() -> None:
    model, state = critical()
    stability = StabilityRule(compile(model), StabilityState(), state.x)
    jerk_change = 6e-4  # displaces 0.5 s * 6e-4 m/s / (3 * 10^2) = 1e-6 m
    memory = ErrorState(error=1e-12, activity=1e-3, step=1e-3, coefficient=1e-6, duration=0.01)

    def predict(budget: float, earlier: float) -> float:
        rule = ErrorRule(attrs.evolve(memory, jerk_change=earlier), budget, 4, state, stability, lambda _: 0.0)
        return rule.predict((10,), 0.01, (0.0, 0.0), 1e-3, jerk_change)[0]

    assert predict(1.9e-6, 0.4 * jerk_change) == math.inf
    assert predict(1.9e-6, 0.6 * jerk_change) < math.inf
    assert predict(2.1e-6, 0.0) < math.inf


def test_work_of_collapsed_hinges_stays_limited_after_a_fallback() -> None:
    # A shared edge of crossed springs shrinks in an impact, and its stiffness grows without bound. The frame after the
    # fallback took its short steps for the longest stable ones: its limit grew with them.
    size = {"cloth.size": [0.4, 0.4], "cloth.resolution": [15, 15], "cloth.position": [0.0, 0.0, 0.3]}
    ball = {"obstacles": ["ball"], "ball.shape": "sphere", "ball.size": [0.1], "ball.friction": [0.0]}
    material = {"material.fabric": "denim", "bending.model": "crossed", "cloth.shear_layout": "alternating"}
    values = {**size, **ball, **material, "cloth.anchors": [""], "grippers": [""], "tolerance": 1e-3}
    simulation = Simulation(Scene.from_parameters({**values, "cloth.orientation": [0.0, 0.0, 0.0, 1.0]}))
    advances = [simulation.advance([]).advance for _ in range(23)]
    assert any(advance.integrator == "implicit" for advance in advances)
    assert max(advance.evaluations for advance in advances) < 40_000


def test_fallback_keeps_the_longest_stable_step() -> None:
    model, state = critical()
    StabilityState(omega2=1e12, max_step=1e-3).store(state)
    finish_implicitly(compile(model), state, 0.0, 1 / 60, None, instead_of="leapfrog", max_evaluations=1000)
    assert StabilityState.load(state) == StabilityState(max_step=1e-3)


def test_each_fallback_halves_the_work_cap() -> None:
    plan = compile(critical()[0])
    # The cap excludes the reserve of the fallback, which is at most half of the work.
    budgets = [WorkBudget(plan, 10.0, 1 / 60, 1e-3, fallback_count) for fallback_count in (0.0, 1.0, 2.0)]
    whole = budgets[0].max_evaluations
    assert [budget.cap + FALLBACK_EVALUATIONS for budget in budgets] == [whole, whole / 2, whole / 4]
    little = WorkBudget(plan, 10.0 * FALLBACK_EVALUATIONS / whole, 1 / 60, 1e-3)
    assert little.cap == pytest.approx(FALLBACK_EVALUATIONS / 2)
    simulation, rng, fallback_counts = violent_sheet(0.05), np.random.default_rng(2), []
    simulation.advance([Target("gripper", simulation.positions[-1]), Grasp("gripper", True)])
    for _ in range(40):
        done = simulation.advance([Target("gripper", simulation.positions[-1] + rng.normal(size=3) * 0.3)]).advance
        fallback_counts.append((done.integrator, FallbackState.load(simulation.state).fallback_count))
    assert ("implicit", 1.0) in fallback_counts
    assert all(count == 0.0 for name, count in fallback_counts if name != "implicit")
