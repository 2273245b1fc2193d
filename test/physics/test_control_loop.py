# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Loop of step control: what calm frames cost, what a refused frame leaves, and where pieces of a frame end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cloth_sim_ros import Gravity, Model, PairSprings, Scene, Simulation, State
from cloth_sim_ros.physics.control.automatic import make_integrator
from cloth_sim_ros.physics.control.controller import Controller
from cloth_sim_ros.physics.control.error import ErrorRule
from cloth_sim_ros.physics.control.error_estimate import ErrorEstimate
from cloth_sim_ros.physics.control.extrapolated import Extrapolated
from cloth_sim_ros.physics.control.force_jump import missed_velocity_changes
from cloth_sim_ros.physics.control.frame_division import FrameDivision
from cloth_sim_ros.physics.control.frame_totals import FrameTotals, Piece
from cloth_sim_ros.physics.control.stability import StabilityRule
from cloth_sim_ros.physics.control.work_budget import WorkBudget
from cloth_sim_ros.physics.integrators.base import UnstableError
from cloth_sim_ros.physics.integrators.extrapolation_tableau import coefficient_of
from cloth_sim_ros.physics.model.forces.force import Array, Force
from cloth_sim_ros.physics.plan.plan import compile
from cloth_sim_ros.physics.state.controller_state import EnergyState, ErrorState, StabilityState

PERIOD = 1.0 / 60.0


@pytest.mark.parametrize(
    "values",
    [
        {},
        {"tolerance": 1e-4},
        {"bending.model": "altitude", "material.bending_modulus": 1e-5},
        {"obstacles": ["it"], "it.shape": "sphere", "it.size": [0.1], "it.position": [3.0, 0.0, 0.0]},
    ],
)
def test_calm_frames_take_one_run(values: dict[str, Any]) -> None:
    simulation = Simulation(Scene.from_parameters({"cloth.resolution": (12, 12), **values}))
    for _ in range(90):
        simulation.advance()
    frames = [simulation.advance().advance for _ in range(60)]
    # One evaluation more than steps starts a run; an error estimate takes a further run.
    assert sum(frame.evaluations == frame.steps + 1 for frame in frames) > 40
    assert all(frame.rejected == 0 for frame in frames)


def test_thrown_spring_costs_short_steps_near_its_anchor_only() -> None:
    plan = compile(Model([1.0, 1.0], [PairSprings([[0, 1]], 0.098785, 8.17743)], anchors=[0]))
    start, velocity = [[0.0, 0.0, 0.0], [-3.53828, 6.19e-5, 0.0]], [[0.0, 0.0, 0.0], [4.5679, 0.0, 0.0]]
    state, integrator = State(start, velocity), make_integrator("auto", tolerance=1e-4, work=10.0)
    frames = [integrator.advance(plan, state, k / 43, 1 / 43) for k in range(64)]
    # It passes the anchor several times. Without steps that grow again within a frame it needs a million evaluations.
    assert max(frame.evaluations for frame in frames) < 20000
    assert sum(frame.evaluations for frame in frames) < 40000


def test_impact_after_single_precision_takes_more_runs() -> None:
    values = {"cloth.resolution": [7, 7], "cloth.size": [0.3, 0.3], "cloth.orientation": [0.0, 0.0, 0.0, 1.0]}
    values |= {"cloth.position": [0.01, 0.0, 0.11], "cloth.anchors": [""], "tolerance": 1e-3, "grippers": [""]}
    values |= {"obstacles": ["ball"], "ball.shape": "sphere", "ball.size": [0.1]}
    simulation = Simulation(Scene.from_parameters(values))
    frames = [simulation.advance().advance for _ in range(3)]
    assert "by 2 runs" in frames[2].reason
    # Steps short enough for a single run need 1,900 evaluations.
    assert frames[2].evaluations < 900


def test_error_of_another_number_of_runs_is_estimated_again() -> None:
    state = State([[0.0, 0.0, 0.0]])
    stability = StabilityRule(compile(Model([1.0], [])), StabilityState(), state.x)
    rule = ErrorRule(ErrorState(duration=0.01, n_runs=3.0), 1e-6, 8, state, stability, lambda _: 0.0)
    frame = FrameTotals()
    frame.runs, frame.errors, frame.changes = ((6, 8, 10), 0.01), [1e-9, 1e-9, 1e-9], [(0.0, 0.0)] * 3
    frame.error = frame.predicted_error = 1e-9
    frame.activity = 1.0
    rule.record_estimate(frame, 3, 3, 1.0, is_raised=False)
    assert rule.memory.time_until_estimate > 0.0
    # That of a single run may have been small by chance.
    rule.record_estimate(frame, 3, 1, 1.0, is_raised=False)
    assert rule.memory.time_until_estimate == 0.0


def test_error_that_fell_by_chance_is_raised_and_not_trusted() -> None:
    state, length = State([[0.0, 0.0, 0.0]]), 0.01
    stability = StabilityRule(compile(Model([1.0], [])), StabilityState(), state.x)
    # Equal steps and activity, and an error of an eighth of the last one.
    counts, last = (12, 15), 4e-7
    memory = ErrorState(duration=length, error=last, activity=1.0, estimate_period=4.0 * length, step=length / 12)
    memory.coefficient, memory.refinement = coefficient_of(counts[:1], length), 2.0
    rule, frame = ErrorRule(memory, 1e-6, 2, state, stability, lambda _: 0.0), FrameTotals()
    frame.runs, frame.errors, frame.changes = (counts, length), [last / 8.0, last / 8.0], [(0.0, 0.0)] * 2
    frame.error, frame.predicted_error, frame.activity, frame.n_pieces = last / 8.0, last, 1.0, 1
    rule.learn(frame, 1, 2.0, length)
    assert rule.memory.error == pytest.approx(last / 2.0)
    assert rule.memory.refinement > 1.0
    # A frame without an estimate follows, not a longer period.
    assert rule.memory.estimate_period == length


class _Wall(Force):
    """Force that is not finite beyond x = 0."""

    name = "wall"

    def add_force(self, t: float, x: Array, v: Array, f: Array) -> None:
        f[0] += np.where(x[0] > 0.0, np.nan, 0.0)


@pytest.mark.parametrize("tolerance", [None, 1e-4])
def test_refused_frame_leaves_the_motion_at_its_start(tolerance: float | None) -> None:
    plan, state = compile(Model([1.0], [_Wall()])), State([[-0.5 * PERIOD, 0.0, 0.0]], [[1.0, 0.0, 0.0]])
    integrator, before = make_integrator("extrapolated", tolerance=tolerance), state.shallow_copy()
    with pytest.raises(UnstableError, match="not finite"):
        integrator.advance(plan, state, 0.0, PERIOD)
    assert state.x is before.x
    assert state.v is before.v


def test_exception_of_a_force_leaves_the_motion_at_its_start() -> None:
    class Broken(Force):
        """Force that fails in the second half of a frame."""

        name = "broken"

        def add_force(self, t: float, x: Array, v: Array, f: Array) -> None:
            if t > 0.5 * PERIOD:
                raise ArithmeticError("no force")

    # An undamped combination of runs has several pieces in the frame.
    spring = PairSprings([[0, 1]], 1.0, 1e5, 0.0)
    plan = compile(Model([0.1, 0.1], [spring, Broken()], anchors=[0]))
    state = State([[0.0, 0.0, 0.0], [1.001, 0.0, 0.0]])
    before = state.shallow_copy()
    with pytest.raises(ArithmeticError, match="no force"):
        Extrapolated(step=2e-4).advance(plan, state, 0.0, PERIOD)
    assert state.x is before.x
    assert state.v is before.v


def test_pieces_of_a_rough_frame_cover_it_exactly() -> None:
    """A particle that a spring stops at a moment within a frame, against the closed form."""
    stiffness, mass, speed, slack = 4.0e3, 0.1, 2.0, 0.75

    class Buffer(Force):
        """One-sided spring beyond x = 0."""

        name = "buffer"

        def add_force(self, t: float, x: Array, v: Array, f: Array) -> None:
            f[0] -= stiffness * np.maximum(x[0], 0.0)

        def energy(self, t: float, x: Array) -> float:
            return 0.5 * stiffness * float(np.sum(np.maximum(x[0], 0.0) ** 2))

        def add_stiffness(self, x: Array, blocks: Array) -> None:
            blocks[0] += stiffness * (x[0] > 0.0)

    plan = compile(Model([mass], [Buffer()]))
    state = State([[-slack * PERIOD * speed, 0.0, 0.0]], [[speed, 0.0, 0.0]])
    advance = make_integrator("extrapolated", tolerance=1e-7).advance(plan, state, 0.0, PERIOD)
    omega, left = (stiffness / mass) ** 0.5, (1.0 - slack) * PERIOD
    assert "pieces" in advance.reason
    assert advance.flagged == 0
    assert abs(state.x[0, 0] - speed / omega * np.sin(omega * left)) < 1e-7 * PERIOD
    assert abs(state.v[0, 0] - speed * np.cos(omega * left)) < 2.0 * 1e-7 * PERIOD


def test_undamped_frames_end_exactly_too() -> None:
    """A frame of many equal pieces: an undamped oscillation in a combination of runs, against the closed form."""
    spring = PairSprings([[0, 1]], 1.0, 100.0, 0.0)
    plan = compile(Model([0.1, 0.1], [spring, Gravity((0.0, 0.0, 0.0))], anchors=[0]))
    state, integrator = State([[0.0, 0.0, 0.0], [1.1, 0.0, 0.0]]), make_integrator("extrapolated", tolerance=1e-8)
    for k in range(30):
        integrator.advance(plan, state, k * PERIOD, PERIOD)
    omega = (100.0 / 0.1) ** 0.5
    assert abs(state.x[0, 1] - 1.0 - 0.1 * np.cos(omega * 30 * PERIOD)) < 1e-8


def test_pieces_below_the_resolution_of_time_move() -> None:
    """Short pieces of a late frame start at the same rounded time; the force does not depend on time."""

    def advance(t: float) -> Array:
        plan = compile(Model([1.0, 1.0], [PairSprings([[0, 1]], 0.5, 4.5, 0.0)], anchors=[0]))
        state = State([[0.0, 0.0, 0.0], [-0.02, 1e-4, 0.0]], [[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
        make_integrator("extrapolated", tolerance=1e-9).advance(plan, state, t, PERIOD)
        return state.positions

    assert np.array_equal(advance(0.0), advance(1e12))


def test_short_advances_stay_explicit_within_a_work_limit() -> None:
    """One step costs less than the implicit steps that would finish the frame, however short it is."""
    plan, state = compile(Model([1.0], [Gravity()])), State([[0.0, 0.0, 0.0]], [[1.0, 0.0, 0.0]])
    advance = make_integrator("extrapolated", tolerance=1e-3, work=10.0).advance(plan, state, 0.0, 1e-9)
    assert advance.integrator == "extrapolated"
    assert advance.flagged == 0


def test_fixed_steps_without_damping_have_short_pieces() -> None:
    plan = compile(Model([0.1, 0.1], [PairSprings([[0, 1]], 1.0, 1e5, 0.0)], anchors=[0]))
    state, step = State([[0.0, 0.0, 0.0], [1.001, 0.0, 0.0]]), 0.1 * 2.0 / 1e3
    advance = make_integrator("extrapolated", step=step).advance(plan, state, 0.0, 1.0 / 30.0)
    # Each run of a piece takes one evaluation more than steps.
    n_pieces = (advance.evaluations - advance.steps) / 4
    assert advance.rejected == 0
    assert round(1.0 / 30.0 / advance.step) <= 6 * n_pieces


def test_attempts_without_a_tolerance_count_over_a_frame() -> None:
    """Energy that no step conserves ends the frame by implicit steps, and not by ever shorter steps."""
    plan = compile(Model([0.1, 0.1], [PairSprings([[0, 1]], 1.0, 1e5, 0.0)], anchors=[0]))
    state, integrator = State([[0.0, 0.0, 0.0], [1.001, 0.0, 0.0]]), Extrapolated(step=1e-3, n_runs=2)
    for k in range(40):
        assert integrator.advance(plan, state, k / 30.0, 1.0 / 30.0).rejected <= 13


def test_estimates_of_small_sheets_share_an_engine_call() -> None:
    values = {"cloth.resolution": [4, 4], "material.stretch_modulus": 100.0, "cloth.anchors": ["top_left"]}
    simulation = Simulation(Scene.from_parameters({**values, "grippers": [""], "bending.model": "none"}))
    plan, estimated_calls = simulation.plan, []
    calculate, steps_of_calls = plan.runs, []

    def seen(t: float, duration: float, start: tuple[Array, Array], steps: Any, **options: Any) -> Any:
        steps_of_calls.append(tuple(steps))
        return calculate(t, duration, start, steps, **options)

    plan.runs = seen  # type: ignore[method-assign]
    for _ in range(60):
        before = ErrorState.load(simulation.state)
        steps_of_calls.clear()
        simulation.advance()
        if before.time_until_estimate == 0.0 and before.n_runs == 1.0 < before.refinement:
            estimated_calls.append([len(steps) for steps in steps_of_calls])
    # The third run shows whether two combined runs are cheaper.
    assert [3] in estimated_calls and [2, 1] not in estimated_calls


def _controller(work: float = 0.0) -> Controller:
    plan = compile(Model([0.1, 0.1], [PairSprings([[0, 1]], 1.0, 1e5, 0.0)], anchors=[0]))
    state = State([[0.0, 0.0, 0.0], [1.001, 0.0, 0.0]])
    return Controller(Extrapolated(tolerance=1e-6, work=work), plan, state, 0.0, PERIOD)


def test_missed_piece_stays_in_the_report_of_its_frame() -> None:
    """A later piece whose clamped steps fit the work limit does not hide that an earlier one had too little."""
    controller = _controller(work=10.0)
    controller.exhausted, controller.refinement = True, 1e7
    assert controller.choose_piece(0.0) is not None
    assert controller.refinement < 1e7
    assert controller.exhausted


def test_nanosecond_piece_gets_no_finer_steps() -> None:
    controller = _controller()
    piece = controller.choose_piece(0.0)
    assert piece is not None
    # private: the estimate of the piece, and its error [m]
    tableau = controller.tableau(0.0, piece, None, None)
    controller._estimate = ErrorEstimate(
        tableau, piece, controller._error, controller.work, chosen_runs=1, allowed=1e-9, errors=[1.0]
    )
    assert controller.reject_inaccurate(piece)
    assert not controller.reject_inaccurate(piece._replace(length=1e-10))


def test_piece_rejected_for_its_energy_leaves_no_energy_behind() -> None:
    controller = _controller()
    piece = controller.choose_piece(0.0)
    assert piece is not None
    tableau = controller.tableau(0.0, piece, None, None)
    assert not controller.check_energy(tableau)
    controller.reject_energy(piece)
    # private: what the frame would store
    assert controller._energy.memory == EnergyState()


def test_an_estimate_measures_one_displacement(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each displacement takes up to nine force evaluations; errors of other numbers of runs are scaled from it."""
    values = {"cloth.resolution": [8, 8], "material.damping": 0.5, "tolerance": 1e-6, "grippers": [""]}
    simulation = Simulation(Scene.from_parameters(values))
    plan, measured = simulation.plan, []
    measure = plan.velocity_displacement

    def counted(*arguments: Any) -> tuple[float, int]:
        measured.append(arguments)
        return measure(*arguments)

    monkeypatch.setattr(plan, "velocity_displacement", counted)
    calls = []
    for _ in range(60):
        measured.clear()
        advance = simulation.advance().advance
        if advance.rejected == 0 and advance.evaluations > advance.steps + 4:
            calls.append(len(measured))
    assert len(calls) > 5
    assert sorted(calls)[len(calls) // 2] == 1


# The lengths of the pieces add up to the second duration, and not to the first.
@pytest.mark.parametrize("duration", [0.23, 1.0 / 3.0])
def test_divided_frame_ends_exactly(duration: float) -> None:
    state = State([[0.0, 0.0, 0.0]])
    plan = compile(Model([1.0], []))
    stability, work = StabilityRule(plan, StabilityState.load(state), state.x), WorkBudget(plan, 0.0, duration, 1.0)
    division = FrameDivision(plan, state, 0.0, duration, stability, work, has_tolerance=True)
    division.restart(is_rough=False)
    pieces = [Piece(duration / 7.0, 10, 1, duration, pieces_left) for pieces_left in (7, 6)]
    division.accept(pieces[0])
    # The second piece alone is halved, then halved again.
    division.isolate(pieces[1])
    division.halve(pieces[1].length)
    assert division.rest_of_stretch == pytest.approx(0.5 * duration / 7.0)
    division.halve(division.rest_of_stretch)
    for factor in (0.25, 0.25, 0.5, 5.0):
        length = division.rest_of_stretch
        assert length == pytest.approx(factor * duration / 7.0)
        division.accept(Piece(length, 10, 1, duration, 1))
    assert division.elapsed == duration
    assert division.rest_of_stretch == 0.0


def _estimate(
    errors: Sequence[float], accurate: Mapping[int, float], *, approximate: Sequence[int] = (), **options: Any
) -> ErrorEstimate:
    """Return an estimate with errors [m], those of some numbers of runs approximate; accurate ones can be measured."""
    tableau: Any = SimpleNamespace(difference=accurate.__getitem__, evaluations=0)
    rule: Any = SimpleNamespace(rounding_floor=lambda *_: 1e-15, target=lambda _: 0.0, max_runs=4)
    work: Any = SimpleNamespace(add=lambda *_: None, weight=1.0)
    options = {"chosen_runs": 1, "allowed": 1e-9, **options}
    estimate = ErrorEstimate(tableau, Piece(PERIOD, 10, 1, PERIOD, 1), rule, work, **options)
    for n_runs, error in enumerate(errors, start=1):
        estimate.append(error, is_approximate=n_runs in approximate)
    return estimate


@pytest.mark.parametrize(("accurate", "expected"), [(4e-9, [4e-9, 4e-9]), (1e-10, [1e-9, 1e-10])])
def test_approximate_error_is_measured_before_it_raises_another(accurate: float, expected: list[float]) -> None:
    estimate = _estimate([1e-9, 3e-9], {2: accurate}, approximate=[2])
    estimate.confirm()
    assert estimate.errors == expected
    assert not estimate.approximate


class KinkedPlan:
    """Accelerations [m/s^2] that rise with the time after a kink [s], raised to a power."""

    contact = None

    def __init__(self, kink: float, power: int) -> None:
        self.kink, self.power = kink, power

    def accelerations(self, t: float, x: Array, v: Array, out: Array, memory: dict[str, Array]) -> None:
        out[:] = (t - self.kink) ** self.power if t > self.kink else 0.0


@pytest.mark.parametrize("power", [0, 1, 2])
def test_kink_anywhere_in_the_last_half_step_shows(power: int) -> None:
    state = State(np.zeros((1, 3)))
    for elapsed in np.linspace(0.02, 1.0, 50):
        plan: Any = KinkedPlan(1.0 - elapsed, power)
        missed = elapsed ** (power + 1) / (power + 1)
        assert np.abs(missed_velocity_changes(plan, state, 1.0, 1.0)[0]).max() >= missed / 7.0


def test_raised_error_stays_where_it_is_measured_afterwards() -> None:
    errors, accurate = [1e-4, 4e-8, 3e-9, 1e-5], {1: 1e-4, 2: 4e-8, 3: 3.15e-9}
    estimate = _estimate(errors, accurate, approximate=[1, 2, 3], chosen_runs=4, allowed=1e-8)
    estimate.confirm()
    assert estimate.errors[1:] == [1e-5, 1e-5, 1e-5]
    assert estimate.sufficient_runs() == 4


def test_accurate_error_decides_where_an_approximate_one_fits() -> None:
    estimate = _estimate([3e-9, 1e-10], {2: 2e-9}, approximate=[2])
    # private: the number of runs by the approximate error
    assert estimate._first_fitting() == 2
    assert estimate.sufficient_runs() == 1
    assert not estimate.approximate
    assert estimate.errors == [3e-9, 2e-9]


def test_no_accepted_error_is_approximate(monkeypatch: pytest.MonkeyPatch) -> None:
    accept, changed = Controller.accept, []

    def accept_measured(controller: Controller, *arguments: Any) -> float:
        if controller.estimates_error:
            # private: the estimate of the piece
            assert controller.n_runs not in controller._estimate.approximate
            changed.append(controller.n_runs)
        return accept(controller, *arguments)

    monkeypatch.setattr(Controller, "accept", accept_measured)
    for tolerance in (1e-3, 1e-5, 1e-6):
        values = {"cloth.resolution": [2, 2], "material.damping": 0.05, "tolerance": tolerance, "grippers": [""]}
        simulation = Simulation(Scene.from_parameters({**values, "material.stretch_modulus": 20.0}))
        for _ in range(60):
            simulation.advance()
    assert len(set(changed)) > 2


def test_attempt_that_cannot_get_finer_is_abandoned(monkeypatch: pytest.MonkeyPatch) -> None:
    # The joint pulls two corners together through the cloth, and the work limit allows no finer steps.
    values = {"cloth.resolution": [8, 4], "cloth.size": [0.35, 0.26], "cloth.anchors": [""], "cloth.joints": ["0-3"]}
    values |= {"contact.self": True, "contact.thickness": 0.015, "grippers": [""]}
    simulation, reject, attempts = Simulation(Scene.from_parameters(values)), Controller.reject_unstable, []

    def count(controller: Controller, *arguments: Any) -> None:
        attempts.append(controller)
        assert len(attempts) < 20000, "the same attempt is repeated"
        reject(controller, *arguments)

    monkeypatch.setattr(Controller, "reject_unstable", count)
    before = simulation.state.digest()
    with pytest.raises(UnstableError):
        simulation.advance()
    assert simulation.state.digest() == before


@pytest.mark.parametrize(("refinement", "expected"), [(1.0, False), (2.2, False), (2.6, True)])
def test_further_run_needs_a_gain_of_work(refinement: float, expected: bool) -> None:
    state = State([[0.0, 0.0, 0.0]])
    plan = compile(Model([1.0], [Gravity([0.0, 0.0, -9.81])]))
    stability = StabilityRule(plan, StabilityState.load(state), state.x)
    rule = ErrorRule(ErrorState(duration=PERIOD), 1e-6, 4, state, stability, lambda _: 0.0)
    # With its share of estimates a run takes 1.08 runs by the longest steps, a combination of two 2.35.
    assert rule.may_gain(2, 1, refinement, PERIOD) is expected


def test_largest_estimate_counts_if_runs_may_coincide() -> None:
    estimate = _estimate([1.0, 1.5, 0.1], {}, may_coincide=True)
    estimate.confirm()
    assert estimate.errors[0] == 1.5
