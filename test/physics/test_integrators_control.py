# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Error control: tolerances, step limits, controller state and events."""

from __future__ import annotations

import numpy as np
import pytest
from support.problems import PERIOD, Problem, curtain, problem
from support.raw_sheet import RawSheet
from support.reference import Reference, reference
from support.reference_runs import measure

from cloth_sim_ros.physics.accounting.work_accumulator import WorkAccumulator, accumulate
from cloth_sim_ros.physics.control.automatic import INTEGRATORS, Automatic, make_integrator
from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.control.extrapolated import Extrapolated
from cloth_sim_ros.physics.control.leapfrog import Leapfrog
from cloth_sim_ros.physics.integrators.base import ToleranceMissedError, UnstableError
from cloth_sim_ros.physics.integrators.implicit import Implicit
from cloth_sim_ros.physics.model.forces.force import Array, Force
from cloth_sim_ros.physics.model.forces.pair_springs import PairSprings
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.plan.plan import compile
from cloth_sim_ros.physics.state.controller_state import ErrorState, IntegratorChoiceState
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Grasp, SetParameters, Target
from cloth_sim_ros.simulation.simulation import Simulation


@pytest.fixture(scope="module", params=["chain", "mesh"])
def scene(request: pytest.FixtureRequest) -> tuple[Problem, Reference]:
    case = problem(request.param)
    return case, reference(case)


@pytest.mark.parametrize("tolerance", [1e-3, 1e-5, 1e-7])
def test_achieved_error_is_close_below_the_tolerance(scene: tuple[Problem, Reference], tolerance: float) -> None:
    result = measure(*scene, "auto", tolerance, energy=False)
    assert result.error <= tolerance
    assert result.flagged == 0
    if result.binds["accuracy"] > 0.5 * scene[0].frames:
        assert result.error >= 0.01 * tolerance


def test_implicit_run_satisfies_its_tolerance(scene: tuple[Problem, Reference]) -> None:
    if scene[0].name == "mesh":
        assert 1e-5 < measure(*scene, "implicit", 1e-3, energy=False).error <= 1e-3


def test_limiting_factor_is_named() -> None:
    scene = problem("curtain16")
    plan, state = scene.build()
    loose = Extrapolated(tolerance=1e-2).advance(plan, state, 0.0, PERIOD)
    assert loose.limited_by == "stability"
    assert "tolerance 0.01 m" in loose.reason
    short = Extrapolated(tolerance=1e-2).advance(*scene.build(), 0.0, 1e-5)
    assert short.limited_by == "frame"
    fixed = Leapfrog(1e-4).advance(*scene.build(), 0.0, PERIOD)
    assert fixed.limited_by == "step"
    assert fixed.error is None
    chain = problem("chain")
    plan, state = chain.build()
    tight = [Extrapolated(tolerance=1e-8).advance(plan, state, k * PERIOD, PERIOD).limited_by for k in range(3)]
    assert tight[-1] == "accuracy"


def test_controller_state_is_in_the_state_alone() -> None:
    """New objects continue a run from a saved state with the same bits."""
    whole, whole_state = problem("curtain16").build()
    cut, cut_state = problem("curtain16").build()
    integrator = make_integrator("auto", tolerance=1e-6)
    for frame in range(6):
        integrator.advance(whole, whole_state, frame * PERIOD, PERIOD)
        cut_state = State.from_bytes(cut_state.to_bytes())
        make_integrator("auto", tolerance=1e-6).advance(cut, cut_state, frame * PERIOD, PERIOD)
    assert cut_state.digest() == whole_state.digest()


@pytest.mark.parametrize("name", INTEGRATORS)
def test_accumulator_changes_no_bit_and_covers_the_whole_time(name: str) -> None:
    def run(accumulator: WorkAccumulator | None) -> State:
        sheet = RawSheet(resolution=6)
        state = State(sheet.flat(hung=False))
        plan, integrator = sheet.plan(sheet.index[0]), make_integrator(name, tolerance=1e-6)
        for frame in range(4):
            integrator.advance(plan, state, frame * PERIOD, PERIOD, accumulator)
        return state

    accumulator, fine = WorkAccumulator(0, record_power=True), WorkAccumulator(0, record_power=True)
    state_with_accumulator = run(accumulator)
    assert state_with_accumulator.digest() == run(None).digest()
    # Dissipation over the last frame by an independent quadrature at a thousand points of a fine run.
    sheet = RawSheet(resolution=6)
    plan, state = sheet.plan(sheet.index[0]), State(sheet.flat(hung=False))
    for frame in range(4):
        fine.reset()
        for part in range(250):
            Leapfrog().advance(plan, state, frame * PERIOD + part * PERIOD / 250, PERIOD / 250)
            accumulate(fine, plan, 0.0, state.x, state.v, PERIOD / 250, state.memory)
    assert accumulator.dissipation == pytest.approx(fine.dissipation, rel=0.2 if name == "symplectic_euler" else 0.02)


def test_fixed_step_above_the_limit_is_refused() -> None:
    sheet = RawSheet(resolution=6, relative_rest_length=0.5)
    plan, state = sheet.plan(sheet.index[0]), State(sheet.flat(hung=False))
    limit = Leapfrog().step_limit(*plan.spectral_bounds(state.x))
    with pytest.raises(ValueError, match=f"above the stability limit {limit:.6g} s"):
        Leapfrog(1.01 * limit).advance(plan, state, 0.0, PERIOD)
    assert Leapfrog(0.99 * limit).advance(plan, state, 0.0, PERIOD).steps >= PERIOD / limit


def test_fixed_step_shrinks_if_inverted_springs_create_energy() -> None:
    sheet = RawSheet(resolution=8, k_d0=0.0, gravity=(0.0, 0.0, 0.0))
    plan, state = sheet.plan([]), State(sheet.flat(hung=True))
    state.x[:, [27, 36]] = state.x[:, [36, 27]]
    step = 0.5 * Leapfrog().step_limit(*plan.spectral_bounds(state.x))
    before = plan.energy(0.0, state.x, state.v)
    done = [Leapfrog(step).advance(plan, state, 2 * k * PERIOD, 2 * PERIOD) for k in range(6)]
    assert plan.energy(0.0, state.x, state.v) < 1.002 * before
    assert min(advance.step for advance in done) < 0.6 * step
    assert any("made energy" in advance.reason for advance in done)


def test_steps_shrink_with_a_stiffening_sheet() -> None:
    """Border springs stretched by a factor of three become stiff sideways: steps must shrink within the run."""
    sheet = RawSheet(resolution=8, k_d0=0.05, gravity=(0.0, 0.0, 0.0))
    plan, state = sheet.plan(sheet.index[0]), State(sheet.flat(hung=True))
    state.v[2] = 30.0 * state.x[2]
    limits = [make_integrator("auto").advance(plan, state, k * PERIOD, PERIOD).limit for k in range(6)]
    assert min(limits) < 0.9 * limits[0]
    assert np.isfinite(state.x).all()


class _Cliff(Force):
    """Force with a jump at x = 0, for which no step is small enough."""

    name = "cliff"

    def add_force(self, t: float, x: Array, v: Array, f: Array) -> None:
        f[0] += np.where(x[0] > 0.0, 1e6, 0.0)

    def external_power(self, t: float, x: Array, v: Array) -> float:
        return 1e6 * float(np.sum(np.maximum(v[0], 0.0), where=x[0] > 0.0))


@pytest.mark.parametrize("tolerance", [1e-6, 1e-9])
def test_force_jump_is_located_and_its_error_stated(tolerance: float) -> None:
    begin = -0.00741
    plan = compile(Model([1.0], [_Cliff()]))
    state = State([[begin, 0.0, 0.0]], [[1.0, 0.0, 0.0]])
    done = Extrapolated(tolerance=tolerance, work=10.0).advance(plan, state, 0.0, PERIOD)
    time_after_jump = PERIOD + begin
    assert done.error is not None
    assert abs(state.x[0, 0] - (time_after_jump + 0.5e6 * time_after_jump * time_after_jump)) < 2.0 * done.error
    # Halving locates it: equally fine steps everywhere would take a million evaluations.
    assert done.evaluations < 100_000
    assert "pieces" in done.reason
    # No step is small enough, so the remaining error is flagged.
    assert done.flagged == 1
    assert done.error > tolerance * PERIOD


def test_motion_that_is_not_finite_is_refused() -> None:
    plan = compile(Model([1.0, 1.0], [PairSprings([[0, 1]], 1.0, 10.0)]))
    state = State([[0, 0, 0], [1, 0, 0]], [[0, 0, 0], [1e200, 0, 0]])
    with pytest.raises(UnstableError):
        Extrapolated(tolerance=1e-3).advance(plan, state, 0.0, PERIOD)


def test_step_and_tolerance_together_are_refused() -> None:
    for make in (Leapfrog, Implicit):
        with pytest.raises(ValueError, match="both set"):
            make(1e-3, tolerance=1e-3)


def test_events_cause_a_new_estimate() -> None:
    simulation = Simulation(Scene.from_parameters({"cloth.resolution": [8, 8], "tolerance": 1e-3}))
    for _ in range(12):
        simulation.advance()
    assert ErrorState.load(simulation.state).time_until_estimate > 0
    corner = simulation.positions[-1]
    simulation.advance([Target("gripper", corner), Grasp("gripper", True)])
    assert ErrorState.load(simulation.state).estimate_period <= 0.04  # an estimate in this frame resets the period
    simulation.advance([SetParameters({"tolerance": 1e-5})])
    frame = simulation.advance()
    assert frame.tolerance == 1e-5
    assert frame.advance is not None
    assert frame.advance.reason.startswith("auto: explicit steps are affordable")


def test_auto_selects_implicit_steps_for_stiff_sheets() -> None:
    sheet = RawSheet(resolution=12, stiffness=1e6, k_d0=0.2)
    plan, state = sheet.plan(sheet.index[0]), State(sheet.flat(hung=True))
    done = make_integrator("auto", tolerance=1e-3).advance(plan, state, 0.0, PERIOD)
    assert done.integrator == "implicit"
    assert "too stiff for explicit steps" in done.reason
    assert np.abs(state.positions - sheet.flat(hung=True)).max() < 1e-3


@pytest.mark.parametrize("x_position", [0.0, 100.0])
def test_rounding_of_a_resting_sheet_is_not_created_energy(x_position):
    still = {
        "gravity": [0.0, 0.0, 0.0],
        "air.drag": 0.0,
        "material.damping": 0.0,
        "wind.normal_drag": 0.0,
        "tolerance": 0.0,
    }
    values = {"cloth.resolution": [9, 12], "cloth.position": [x_position, 0.0, 1.0], "integrator": "leapfrog", **still}
    simulation = Simulation(Scene.from_parameters(values))
    for _ in range(3):
        done = simulation.advance().advance
        assert (done.rejected, done.limited_by) == (0, "stability")


def test_slower_motion_returns_to_fewer_runs() -> None:
    """The curtain's fall requires two runs per frame for some time; the motion after it does not."""
    scene = curtain(16)
    plan, state = scene.build()
    integrator = make_integrator("auto", tolerance=3.5e-4)
    run_counts = []
    for frame in range(scene.frames):
        integrator.advance(plan, state, frame * PERIOD, PERIOD)
        run_counts.append(ErrorState.load(state).n_runs)
    assert max(run_counts) == 2
    assert run_counts[40:] == [1] * 20


def test_auto_reports_failed_implicit_steps():
    class Stuck:
        def advance(self, *_: object, is_strict: bool) -> None:
            assert is_strict
            raise UnstableError("no way")

    simulation = Simulation(Scene.from_parameters({"cloth.resolution": [4, 4]}))
    automatic = Automatic(tolerance=1e-3)
    vars(automatic)["_implicit"] = Stuck()
    state = simulation.state
    IntegratorChoiceState(is_implicit=1.0, frames_until_comparison=5.0, implicit_cost=1.0, explicit_cost=1.0).store(
        state
    )
    done = automatic.advance(simulation.plan, state, 0.0, 1 / 60)
    assert "found no way" in done.reason
    assert "affordable" not in done.reason


_TABLE = {"obstacles": ["table"], "table.shape": "plane"}


def _loose(**more: object) -> Simulation:
    """Return a small sheet without anchors."""
    values = {"cloth.resolution": [4, 4], "cloth.position": [0.0, 0.0, 0.55], "cloth.anchors": []}
    return Simulation(Scene.from_parameters({**values, **more}))


def test_strict_implicit_steps_raise_instead_of_flagging() -> None:
    """A sheet hits a table edge-on at 10 m/s."""
    implicit, simulation = Implicit(tolerance=1e-3), _loose(**_TABLE)
    simulation.state.v[2] = -10.0
    lenient = implicit.advance(simulation.plan, simulation.state.shallow_copy(), 0.0, PERIOD)
    assert lenient.flagged
    with pytest.raises(ToleranceMissedError) as missed:
        implicit.advance(simulation.plan, simulation.state, 0.0, PERIOD, is_strict=True)
    assert 0 < missed.value.evaluations < lenient.evaluations / 2


@pytest.mark.parametrize("table", [False, True])
def test_auto_halves_the_cost_of_missed_frames_with_contact(*, table: bool) -> None:
    class Missed:
        def advance(self, *_: object, is_strict: bool) -> None:
            assert is_strict
            error = ToleranceMissedError("by far")
            error.evaluations = 1000
            raise error

    simulation, automatic = _loose(**_TABLE if table else {}), Automatic(tolerance=1e-3)
    vars(automatic)["_implicit"] = Missed()
    state = simulation.state
    IntegratorChoiceState(is_implicit=1.0, frames_until_comparison=1.0, explicit_cost=1.0).store(state)
    costs = []
    for frame in range(2 * int(CONSTANTS.comparison_period + 1.0)):
        automatic.advance(simulation.plan, state, frame * PERIOD, PERIOD)
        costs.append(IntegratorChoiceState.load(state).implicit_cost)
    first, second = costs[0], costs[-1]
    assert second == first / 4 if table else first == second == 0.0
    assert (first > 0.0) == table
