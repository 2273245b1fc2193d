# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Particles whose motion a gripper prescribes: exact positions, orders of convergence, wrenches and energy."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest

from cloth_sim_ros.engine.binding import PATH_NUMBERS
from cloth_sim_ros.physics.accounting.energy_balance import EnergyBalance
from cloth_sim_ros.physics.accounting.work_accumulator import WorkAccumulator
from cloth_sim_ros.physics.control.automatic import make_integrator
from cloth_sim_ros.physics.control.fallback import finish_implicitly
from cloth_sim_ros.physics.integrators.base import Integrator
from cloth_sim_ros.physics.integrators.extrapolation_tableau import ExtrapolationTableau, weights
from cloth_sim_ros.physics.integrators.implicit_advance import ImplicitAdvance
from cloth_sim_ros.physics.integrators.stage_matrix import StageMatrix
from cloth_sim_ros.physics.model.forces.drag import Drag
from cloth_sim_ros.physics.model.forces.force import Array, Force
from cloth_sim_ros.physics.model.forces.gravity import Gravity
from cloth_sim_ros.physics.model.forces.grid_springs import GridSprings
from cloth_sim_ros.physics.model.forces.grips import Grips
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.model.parts import GridFamily
from cloth_sim_ros.physics.plan.gripper_path import to_body_frame
from cloth_sim_ros.physics.plan.plan import Plan, compile
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.verify.independent_integrator import dop853
from cloth_sim_ros.verify.reference_integrator import MotionState

FRAME = 1.0 / 60.0
ROWS, COLUMNS, SPACING, MASS = 6, 8, 0.05, 2e-3
GRAVITY = np.array([0.3, -0.2, -9.81])
#: A corner of the sheet.
HELD = np.array([0, 1, COLUMNS, COLUMNS + 1])
#: Step counts of a combination, as multiples of the first.
RATIOS = (1.0, 1.5, 2.0)


def _family(name: str, stiffness: float, reach: float, damping: float) -> GridFamily:
    return GridFamily(name=name, stiffness=stiffness, rest_length=reach * SPACING, damping=damping, border=1.0)


def turning_path(position: np.ndarray) -> np.ndarray:
    """Path that accelerates and turns from a position [m], shape (1, PATH_NUMBERS)."""
    path = np.zeros((1, PATH_NUMBERS))
    path[0, 1:4], path[0, 16] = position, 1.0
    path[0, 4:13] = [0.5, -0.2, 0.8, 3.0, 20.0, -5.0, 100.0, -50.0, 200.0]
    path[0, 17:23] = [1.0, 2.0, -1.0, 20.0, -30.0, 10.0]
    return path


class Carried:
    """A sheet that moves, and whose corner a gripper carries.

    Args:
        listed: its springs are listed in place of a grid.
        path: path of the gripper; by default one that accelerates and turns.
        anchors: anchored particles.
        rows: rows of particles.
        held: particles that the gripper carries.
    """

    def __init__(
        self,
        *,
        listed: bool = False,
        path: np.ndarray | None = None,
        anchors: Any = (),
        rows: int = ROWS,
        held: np.ndarray = HELD,
    ) -> None:
        self.held = held
        families = [_family("right", 30.0, 1.0, 0.02), _family("down", 31.0, 1.0, 0.021)]
        families += [_family("diagonal", 12.0, math.sqrt(2.0), 0.01), _family("right2", 3.0, 2.0, 0.004)]
        springs = GridSprings(rows, COLUMNS, tuple(families))
        self.grips = Grips(1)
        forces = [springs.pair_springs if listed else springs, Gravity(GRAVITY), Drag(0.3), self.grips]
        count = rows * COLUMNS
        self.plan: Plan = compile(Model(np.full(count, MASS), forces, anchors=anchors))
        random = np.random.default_rng(0)
        row, column = np.divmod(np.arange(count), COLUMNS)
        self.x = np.stack([SPACING * column, SPACING * row, 0.0 * row]) + 0.002 * random.standard_normal((3, count))
        self.v = 0.1 * random.standard_normal((3, count))
        self.path = turning_path(self.x[:, 0]) if path is None else path
        self.hold(np.ones(len(held), dtype=bool))

    def hold(self, prescribed: np.ndarray | None) -> None:
        offsets, count = to_body_frame(self.path[0, [1, 2, 3, 13, 14, 15, 16]], self.x[:, self.held]), len(self.held)
        stiffness, damping = np.full(count, 1000.0), np.full(count, 0.5)
        self.grips.set_grips(self.path, np.array([0, count]), self.held, offsets, stiffness, damping, prescribed)

    def points(self, t: float) -> tuple[np.ndarray, np.ndarray]:
        """Positions [m] and velocities [m/s] of the held points, (3, 4) each, by the path of the gripper."""
        x, v = self.x.copy(), self.v.copy()
        self.plan.prescribe(t, x, v)
        return x[:, self.held], v[:, self.held]

    def state(self) -> State:
        return State(self.x.T, self.v.T)

    def combined(self, steps: int, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Positions [m] and gripper's record of a combination of runs."""
        counts = tuple(round(ratio * steps) for ratio in RATIOS[:count])
        runs, result = self.plan.runs(0.0, FRAME, (self.x, self.v), counts, weights=weights(counts))
        assert result is not None
        record = sum(w * run.gripper_integrals[0] for w, run in zip(weights(counts), runs, strict=True))
        return result[0], np.asarray(record)


@pytest.mark.parametrize("listed", [False, True])
@pytest.mark.parametrize("options", [{}, {"single_precision": True}, {"threads": 2}, {"concurrency": 2}])
def test_prescribed_particles_end_at_their_points_exactly(listed: bool, options: dict[str, Any]) -> None:
    sheet = Carried(listed=listed)
    runs, _ = sheet.plan.runs(0.0, FRAME, (sheet.x, sheet.v), (24, 37), **options)
    x, v = sheet.points(FRAME)
    for run in runs:
        assert np.array_equal(run.x[:, HELD], x)
        assert np.array_equal(run.v[:, HELD], v)


def test_points_follow_from_the_pose() -> None:
    sheet = Carried()
    h = 1e-5
    (before, _), (now, velocity), (after, _) = (sheet.points(0.007 + k * h) for k in (-1, 0, 1))
    assert velocity == pytest.approx((after - before) / (2.0 * h), abs=1e-6)
    # Distances within a rigid body.
    start = sheet.x[:, HELD]
    assert np.linalg.norm(now[:, 3] - now[:, 0]) == pytest.approx(np.linalg.norm(start[:, 3] - start[:, 0]), rel=1e-12)


@pytest.mark.parametrize("listed", [False, True])
@pytest.mark.parametrize("runs", [1, 2, 3])
def test_combinations_of_runs_have_their_order(listed: bool, runs: int) -> None:
    sheet = Carried(listed=listed)
    reference, exact_record = sheet.combined(2400, 3)
    errors = [
        (float(np.abs(x - reference).max()), float(np.abs(record - exact_record).max()))
        for x, record in (sheet.combined(steps, runs) for steps in (120, 240))
    ]
    for coarse, fine in zip(*errors, strict=True):
        assert math.log2(coarse / fine) == pytest.approx(runs + 1.0, abs=0.3)


@pytest.mark.parametrize("listed", [False, True])
def test_motion_agrees_with_independent_integrator(listed: bool) -> None:
    sheet = Carried(listed=listed)
    reference = dop853(sheet.plan, 0.0, FRAME, MotionState(sheet.x, sheet.v))
    x, _ = sheet.combined(400, 3)
    assert np.abs(x - reference.x).max() < 1e-10
    assert np.array_equal(reference.x[:, HELD], sheet.points(FRAME)[0])


def test_energy_balance_of_a_run_closes() -> None:
    sheet = Carried()
    counts = (600, 800, 1000, 1200)
    start = sheet.x, sheet.v
    runs, result = sheet.plan.runs(0.0, FRAME, start, counts, weights=weights(counts), record_power=True)
    assert result is not None
    integrals = sum(w * run.integrals for w, run in zip(weights(counts), runs, strict=True))
    _, _, _, _, _, _, work, loss, dissipated, _ = integrals
    gain = sheet.plan.energy(FRAME, result[0], result[1]) - sheet.plan.energy(0.0, *start)
    assert loss > 1e-3
    assert gain - work + loss + dissipated == pytest.approx(0.0, abs=1e-10)


def free_particle(path: np.ndarray, offset: np.ndarray) -> Plan:
    grips = Grips(1)
    plan = compile(Model([MASS], [Gravity(GRAVITY), grips]))
    unit = np.array([1.0])
    grips.set_grips(path, np.array([0, 1]), np.array([0]), offset[None, :], unit, unit, np.array([True]))
    return plan


def test_wrench_of_a_free_particle_is_weight_minus_inertia() -> None:
    path = turning_path(np.array([0.1, 0.2, 0.3]))
    offset = np.array([0.05, -0.02, 0.04])
    plan = free_particle(path, offset)
    x, v = np.zeros((3, 1)), np.zeros((3, 1))
    plan.prescribe(0.0, x, v)
    runs, _ = plan.runs(0.0, FRAME, (x, v), (7,))
    end, end_v = x.copy(), v.copy()
    plan.prescribe(FRAME, end, end_v)
    momentum = MASS * (end_v - v)[:, 0]
    assert runs[0].gripper_integrals[0, :3] == pytest.approx(FRAME * MASS * GRAVITY - momentum, rel=1e-12)
    # The torque about the pose, by quadrature of arm x m (g - a) over the frame.
    h, nodes = 1e-5, np.linspace(0.0, FRAME, 401)
    torques = []
    for t in nodes:
        states = [(np.zeros((3, 1)), np.zeros((3, 1))) for _ in range(3)]
        for k, state in enumerate(states):
            plan.prescribe(t + (k - 1) * h, *state)
        a = (states[2][1] - states[0][1])[:, 0] / (2.0 * h)
        origin = path[0, 1:4] + t * (path[0, 4:7] + t * (path[0, 7:10] + t * path[0, 10:13]))
        torques.append(np.cross(states[1][0][:, 0] - origin, MASS * (GRAVITY - a)))
        rates = plan.grip_wrench_rates(t, states[1][0], states[1][1])[0]
        assert rates[:3] == pytest.approx(MASS * (GRAVITY - a), abs=1e-6)
        assert rates[3:6] == pytest.approx(torques[-1], abs=1e-7)
        assert rates[6] == pytest.approx(-float(rates[:3] @ states[1][1][:, 0]), rel=1e-9)
    fine, _ = plan.runs(0.0, FRAME, (x, v), (400,))
    assert fine[0].gripper_integrals[0, 3:6] == pytest.approx(np.trapezoid(torques, nodes, axis=0), abs=1e-9)


@pytest.mark.parametrize("listed", [False, True])
def test_motion_of_prescribed_particles_is_no_activity(listed: bool) -> None:
    # A rigid sheet would have none at all. Here the whole sheet is held.
    sheet = Carried(listed=listed)
    count = ROWS * COLUMNS
    offsets, ones = to_body_frame(sheet.path[0, [1, 2, 3, 13, 14, 15, 16]], sheet.x), np.ones(count)
    every = np.ones(count, dtype=bool)
    sheet.grips.set_grips(sheet.path, np.array([0, count]), np.arange(count), offsets, ones, ones, every)
    before = sheet.v - 1.0, FRAME
    start = sheet.x, sheet.v
    runs, result = sheet.plan.runs(0.0, FRAME, start, (20,), weights=[1.0], before=before)
    assert result is not None
    assert runs[0].half_difference == 0.0
    assert result[2].activity == 0.0
    assert result[2].change_from_before == 0.0
    assert result[2].omega2 == 0.0


def test_summaries_of_both_paths_leave_prescribed_particles_out() -> None:
    sheet = Carried()
    before = sheet.v - 1.0, FRAME
    arguments = sheet.plan, sheet.state(), 0.0, FRAME, (20, 25, 30)
    engine, python = (ExtrapolationTableau(*arguments, before=before) for _ in range(2))
    # Only the first combination is calculated by the engine.
    python.combine(2)
    assert python.summary(1).activity == pytest.approx(engine.summary(1).activity, rel=1e-12)
    assert python.summary(1).change_from_before == pytest.approx(engine.summary(1).change_from_before, rel=1e-12)


def test_error_of_a_python_force_reaches_wrenches() -> None:
    class Broken(Force):
        """Force that fails."""

        name = "broken"

        def add_force(self, t: float, x: Array, v: Array, f: Array) -> None:
            raise ZeroDivisionError("of the force")

    grips = Grips(1)
    path = turning_path(np.zeros(3))
    grips.set_grips(
        path, np.array([0, 1]), np.array([0]), np.zeros((1, 3)), np.ones(1), np.ones(1), np.ones(1, dtype=bool)
    )
    plan = compile(Model([MASS], [Broken(), grips]))
    with pytest.raises(ZeroDivisionError, match="of the force"):
        plan.grip_wrench_rates(0.0, np.zeros((3, 1)), np.zeros((3, 1)))


def test_closing_is_an_inelastic_impulse() -> None:
    path = np.zeros((1, PATH_NUMBERS))
    path[0, 4], path[0, 16] = 2.0, 1.0
    plan = free_particle(path, np.zeros(3))
    x, v = np.zeros((3, 1)), np.array([[0.5], [0.0], [0.25]])
    runs, _ = plan.runs(0.0, FRAME, (x, v), (3,))
    record = runs[0].gripper_integrals[0]
    assert runs[0].v[:, 0] == pytest.approx([2.0, 0.0, 0.0])
    assert record[:3] == pytest.approx(MASS * (FRAME * GRAVITY - np.array([1.5, 0.0, -0.25])))
    assert record[6] == pytest.approx(MASS * 1.5 * 2.0 - MASS * GRAVITY[0] * 2.0 * FRAME)
    assert record[7] == pytest.approx(0.5 * MASS * (1.5**2 + 0.25**2))


def test_bounds_are_those_of_anchored_particles() -> None:
    held, anchored = Carried(), Carried(anchors=HELD)
    assert held.plan.spectral_bounds(held.x) == anchored.plan.spectral_bounds(held.x)
    held.hold(None)
    assert held.plan.spectral_bounds(held.x)[0] > 1.02 * anchored.plan.spectral_bounds(held.x)[0]
    # All but the border, whose particles have fewer springs.
    inner = np.arange(ROWS * COLUMNS).reshape(ROWS, COLUMNS)[1:-1, 1:-1].ravel()
    carried, bordered = Carried(held=inner), Carried(anchors=inner)
    bounds = carried.plan.spectral_bounds(held.x)
    assert bounds == bordered.plan.spectral_bounds(held.x)
    assert bounds[0] < 0.9 * anchored.plan.spectral_bounds(held.x)[0]


@pytest.mark.parametrize("listed", [False, True])
def test_run_starts_with_the_velocities_of_the_points(listed: bool) -> None:
    sheet = Carried(listed=listed)
    x, v = sheet.x.copy(), sheet.v.copy()
    sheet.plan.prescribe(0.0, x, v)
    assert np.abs(v - sheet.v).max() > 0.1
    ends = [sheet.plan.runs(0.0, FRAME, start, (20,))[0][0].end_state for start in ((sheet.x, sheet.v), (x, v))]
    assert np.array_equal(*ends)


def test_anchored_particles_stay_although_a_gripper_prescribes() -> None:
    sheet = Carried(anchors=[0])
    sheet.v[:, 0] = 0.0
    runs, _ = sheet.plan.runs(0.0, FRAME, (sheet.x, sheet.v), (60,))
    assert np.array_equal(runs[0].x[:, 0], sheet.x[:, 0])
    assert np.array_equal(runs[0].x[:, HELD[1:]], sheet.points(FRAME)[0][:, 1:])


def test_accelerations_of_prescribed_particles_are_zero() -> None:
    sheet = Carried()
    a = np.empty_like(sheet.x)
    sheet.plan.accelerations(0.0, sheet.x, sheet.v, a)
    assert not a[:, HELD].any()
    assert np.abs(np.delete(a, HELD, axis=1)).min() > 0.0
    assert sheet.plan.prescribed_particles().tolist() == HELD.tolist()
    assert np.flatnonzero(~sheet.plan.free_particles()).tolist() == HELD.tolist()


@pytest.mark.parametrize(("name", "order"), [("implicit", 2.0), ("symplectic_euler", 1.0)])
def test_other_integrators_keep_their_order(name: str, order: float) -> None:
    sheet = Carried()
    reference, _ = sheet.combined(1200, 3)
    errors = []
    for steps in (400, 800):
        integrator, state = make_integrator(name, step=FRAME / steps), sheet.state()
        integrator.advance(sheet.plan, state, 0.0, FRAME)
        assert np.array_equal(state.x[:, HELD], sheet.points(FRAME)[0])
        assert np.array_equal(state.v[:, HELD], sheet.points(FRAME)[1])
        errors.append(float(np.abs(state.x - reference).max()))
    assert math.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.3)


@pytest.mark.parametrize(
    ("name", "options", "bound"),
    [
        ("extrapolated", {"tolerance": 1e-6}, 1e-5),
        ("implicit", {"step": FRAME / 800}, 2e-3),
        ("symplectic_euler", {"step": FRAME / 2000}, 2e-2),
    ],
)
def test_integrators_account_for_the_energy(name: str, options: dict[str, float], bound: float) -> None:
    sheet = Carried()
    integrator: Integrator = make_integrator(name, **options)
    state = sheet.state()
    balance = EnergyBalance(sheet.plan, state)
    integrator.advance(sheet.plan, state, 0.0, FRAME, balance.accumulator)
    assert balance.accumulator.wrenches.any()
    residual = balance.add_advance(FRAME, state)
    assert balance.dissipation > 1e-3
    assert abs(residual) < bound * balance.energy_turnover


# Without time for a factorisation, descents use the blocks of single particles.
@pytest.mark.parametrize("max_time", [math.inf, 1e-9])
def test_descent_steps_lead_to_the_points(max_time: float, monkeypatch: pytest.MonkeyPatch) -> None:
    sheet = Carried()
    state = sheet.state()
    accumulator = WorkAccumulator(1, record_power=True)
    # private: only its arguments show where a descent evaluates forces
    correction, distances = ImplicitAdvance._newton_correction, []

    def watched(self: ImplicitAdvance, t: float, x: Array, v: Array, d: float, u: Array) -> Array:
        distances.append(float(np.abs((x + d * u)[:, HELD] - sheet.points(t + 0.5 * d)[0]).max()))
        return correction(self, t, x, v, d, u)

    monkeypatch.setattr(ImplicitAdvance, "_newton_correction", watched)
    # No Newton iteration fits into one evaluation: every step is a descent.
    result = finish_implicitly(
        sheet.plan, state, 0.0, FRAME, accumulator, instead_of="test", max_evaluations=1.0, max_time=max_time
    )
    assert result.flagged
    assert max(distances) < 1e-12
    assert np.array_equal(state.x[:, HELD], sheet.points(FRAME)[0])
    assert np.array_equal(state.v[:, HELD], sheet.points(FRAME)[1])
    exact, _ = sheet.combined(1200, 3)
    assert np.abs(state.x - exact).max() < 0.1 * SPACING
    before = sheet.plan.energy(0.0, sheet.x, sheet.v)
    gain = sheet.plan.energy(FRAME, state.x, state.v) - before - accumulator.work + accumulator.dissipation
    assert gain < 0.05 * before


def test_stage_matrix_does_not_move_prescribed_particles() -> None:
    sheet, d = Carried(), 1e-2
    right = np.random.default_rng(3).normal(size=sheet.x.shape)
    right[:, HELD] = 0.0
    for prescribed, bound in ((HELD, 1e-20), (HELD[:0], math.inf)):
        solution, matrix = right.copy(), StageMatrix(sheet.plan.model)
        matrix.update(0.0, sheet.x, d, {}, prescribed)
        matrix.solve(solution)
        largest = float(np.abs(solution[:, HELD]).max())
        assert largest < bound
    # Without the constraint the solution moves them.
    assert largest > 1.0


@pytest.mark.parametrize(
    ("prescribed", "particles", "message"),
    [
        ([True, True], [3, 3], "two grips prescribe the motion of particle 3; keep one of them"),
        ([True], [3, 4], r"prescribed is \[True\]; give 2 of true and false, one for each grip"),
    ],
)
def test_contradictory_grips_are_refused(prescribed: list[bool], particles: list[int], message: str) -> None:
    sheet = Carried()
    some = np.ones(2)
    flags = np.array(prescribed)
    sheet.grips.set_grips(sheet.path, np.array([0, 2]), np.array(particles), np.zeros((2, 3)), some, some, flags)
    with pytest.raises(ValueError, match=message):
        sheet.plan.spectral_bounds(sheet.x)


def test_spring_and_prescribed_grips_stand_side_by_side() -> None:
    sheet = Carried()
    flags = np.array([True, False, True, False])
    sheet.hold(flags)
    (run,), _ = sheet.plan.runs(0.0, FRAME, (sheet.x, sheet.v), (200,))
    x, _ = sheet.points(FRAME)
    assert np.array_equal(run.x[:, HELD[flags]], x[:, flags])
    distances = np.linalg.norm(run.x[:, HELD] - x, axis=0)
    assert (distances[~flags] > 1e-5).all()
    assert all(a < 1e-12 for a in distances[flags])


# A tall sheet has bands whose copies of rows overlap the held ones.
@pytest.mark.parametrize(("rows", "held"), [(ROWS, HELD), (40, np.arange(18 * COLUMNS, 22 * COLUMNS))])
def test_bits_depend_on_neither_threads_nor_concurrency(rows: int, held: np.ndarray) -> None:
    sheet = Carried(rows=rows, held=held)
    runs = [
        sheet.plan.runs(0.0, FRAME, (sheet.x, sheet.v), (24, 36), threads=threads, concurrency=concurrency)[0]
        for threads, concurrency in itertools.product((1, 2), (1, 2))
    ]
    for repetition in runs[1:]:
        for run, repeated in zip(runs[0], repetition, strict=True):
            assert np.array_equal(run.end_state, repeated.end_state)
            assert np.array_equal(run.gripper_integrals, repeated.gripper_integrals)
            assert run.half_difference == repeated.half_difference
