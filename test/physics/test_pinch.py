# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pinching: jaws that a drive closes on a sheet, and their grip by friction."""

import numpy as np
import pytest
from support import laws
from support.contact_scenes import THICKNESS, contact, still
from support.pinch_scenes import COLUMNS, FRAME, HELD, MASS, SPACING, close, grasped_sheet, gravity, hanging, make_jaw

from cloth_sim_ros.physics.accounting.energy_balance import EnergyBalance
from cloth_sim_ros.physics.accounting.work_accumulator import WorkAccumulator
from cloth_sim_ros.physics.contact.obstacles import Obstacle
from cloth_sim_ros.physics.control.automatic import make_integrator
from cloth_sim_ros.physics.plan.plan import compile
from cloth_sim_ros.physics.state.controller_state import ANCHORS_KEY, JAWS_KEY
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.verify.independent_integrator import dop853
from cloth_sim_ros.verify.reference_integrator import MotionState

grids_and_lists = pytest.mark.parametrize("listed", [False, True])


def advance(plan, state, integrator, frames, first=0, book=None):
    """Advance by frames; return the report of the last one."""
    for k in range(first, first + frames):
        done = integrator.advance(plan, state, k * FRAME, FRAME, book)
    return done


@grids_and_lists
def test_jaws_close_at_their_speed_until_their_force(listed):
    jaw = make_jaw(0.7, speed=0.08)
    plan, state, integrator, force = hanging(jaw, listed=listed)
    close(force)
    advance(plan, state, integrator, 4)
    half_opening, jaw_speed = state.memory[JAWS_KEY][0]
    assert jaw_speed == pytest.approx(-0.08, rel=1e-6)
    # It reaches that speed within a millisecond or two.
    assert half_opening == pytest.approx(0.01 - 4 * FRAME * 0.08, abs=0.08 * 2e-3)
    book = WorkAccumulator(plan.gripper_count, obstacle_count=2)
    advance(plan, state, integrator, 30, 4, book)
    half_opening, jaw_speed = state.memory[JAWS_KEY][0]
    assert abs(jaw_speed) < 1e-12
    assert 0.5 * THICKNESS < half_opening < THICKNESS
    # Force of the cloth on each jaw, outward.
    assert book.obstacle_wrenches[:, 1] == pytest.approx([0.7, -0.7], rel=1e-9)
    close(force, closed=False)
    advance(plan, state, integrator, 30, 34)
    half_opening, jaw_speed = state.memory[JAWS_KEY][0]
    assert abs(jaw_speed) < 1e-12
    assert half_opening == pytest.approx(0.5 * jaw.opening, abs=0.1 * THICKNESS)


def test_empty_jaws_stop_at_each_other():
    plan, state, integrator, force = hanging()
    distant_path = still((0.0, 0.0, 1.0))
    force.set_paths(np.array([distant_path, distant_path]))
    close(force)
    flagged = sum(advance(plan, state, integrator, 1, k).flagged for k in range(40))
    half_opening, jaw_speed = state.memory[JAWS_KEY][0]
    assert 0.0 < half_opening < 0.5 * THICKNESS
    assert abs(jaw_speed) < 1e-12
    assert flagged == 0


def test_jaw_acceleration_is_that_of_the_formulas():
    """Each jaw has the force on a box at its position; drive force is linear in speed; stops are out of reach."""
    jaw = make_jaw(0.7, friction=(0.6, 0.4), speed=0.2)
    plan, state, _, force = hanging(jaw)
    close(force)
    half_opening, jaw_speed = 0.8 * THICKNESS, -0.03
    rng = np.random.default_rng(1)
    state.v = rng.normal(size=state.x.shape) * 0.05
    state.memory[JAWS_KEY] = np.array([[half_opening, jaw_speed]])
    boxes = [Obstacle(name=name, shape="box", size=jaw.size) for name in ("left", "right")]
    paths = [still((0.0, sign * (half_opening + 0.5 * jaw.size[1]), 0.0)) for sign in (1.0, -1.0)]
    for path, sign in zip(paths, (1.0, -1.0), strict=True):
        path[4:7] = [0.0, sign * jaw_speed, 0.0]
    alone = [contact(box, paths=[path]) for box, path in zip(boxes, paths, strict=True)]
    pushes = [
        laws.contact(0.0, state.x, state.v, single_contact, plan.model.masses)[0].force for single_contact in alone
    ]
    free = plan.model.inverse_masses > 0.0
    outward = -pushes[0][1, free].sum() + pushes[1][1, free].sum()
    expected = (outward - 2.0 * 0.7 * (1.0 + jaw_speed / 0.2)) / jaw.inertia
    accelerations = plan.contact.jaw_accelerations(0.0, state.x, state.v, memory=state.memory)
    assert outward > 0.1
    # Friction acts along the surface: it does not move a jaw along its axis.
    assert accelerations == pytest.approx([expected], rel=1e-9)


@pytest.mark.parametrize("friction", [(0.0, 0.0), (0.5, 0.5)])
def test_errors_stay_within_tolerance_of_dop853(friction):
    jaw, start = make_jaw(0.2, friction=friction), np.array([[1.3 * THICKNESS, -0.05]])
    reference = None
    for tolerance in (1e-3, 1e-4, 1e-5, 1e-6):
        plan, state, integrator, force = hanging(jaw, tolerance=tolerance)
        close(force)
        state.memory[JAWS_KEY] = start
        state.v[1, COLUMNS:] = 0.02 * np.sin(3.0 + 40.0 * state.x[2, COLUMNS:])
        if reference is None:
            reference = dop853(plan, 0.0, 12 * FRAME, MotionState(state.x, state.v, {JAWS_KEY: start}))
        advance(plan, state, integrator, 12)
        assert np.abs(state.x - reference.x).max() < 12 * FRAME * tolerance
        assert np.abs(state.memory[JAWS_KEY] - reference.memory[JAWS_KEY])[0, 0] < 12 * FRAME * tolerance


@grids_and_lists
def test_no_bit_depends_on_threads(listed):
    jaw = make_jaw(0.5, friction=(0.6, 0.3))
    plan, state, _, force = hanging(jaw, listed=listed)
    path = still()
    path[4:7], path[17:20] = [0.2, 0.1, -0.1], [0.0, 1.0, 0.5]
    force.set_paths(np.array([path, path]))
    close(force)
    state.memory[JAWS_KEY] = np.array([[1.1 * THICKNESS, -0.05]])
    runs = []
    for threads in (1, 2, 3, 8):
        runs.append(
            plan.runs(
                0.0, 0.02, (state.x, state.v), [900], record_obstacles=True, threads=threads, memory=state.memory
            )[0][0]
        )
    assert np.abs(runs[0].obstacle_integrals[:, :3]).max(axis=1).min() > 0.0
    assert runs[0].jaw_states[0, 0] < THICKNESS
    for run in runs[1:]:
        for reference_run, compared_run in zip(runs[0], run, strict=True):
            assert np.array_equal(reference_run, compared_run)


def test_grids_and_lists_move_jaws_alike():
    ends = []
    for listed in (False, True):
        plan, state, integrator, force = hanging(listed=listed)
        close(force)
        advance(plan, state, integrator, 15)
        ends.append((state.x, state.memory[JAWS_KEY]))
    assert ends[0][0] == pytest.approx(ends[1][0], abs=1e-7)
    assert ends[0][1] == pytest.approx(ends[1][1], abs=1e-7)


@grids_and_lists
@pytest.mark.parametrize("mu", [0.2, 1.0])
def test_pinch_holds_from_weight_over_twice_the_friction(mu, listed):
    plan, state, integrator, _ = grasped_sheet(0.99, mu, listed=listed)
    before = state.x[2].mean()
    gravity(plan, 9.81)
    advance(plan, state, integrator, 60, HELD)
    # It slides with a hundredth of g.
    assert state.x[2].mean() - before < -0.01
    plan, state, integrator, _ = grasped_sheet(1.01, mu, listed=listed)
    anchors = state.memory[ANCHORS_KEY]
    before = state.x[2].mean()
    gravity(plan, 9.81)
    advance(plan, state, integrator, 60, HELD)
    assert state.x[2].mean() == pytest.approx(before, abs=1e-7)
    assert np.array_equal(state.memory[ANCHORS_KEY], anchors)


def test_twice_the_holding_force_prevents_slip_and_creep():
    plan, state, integrator, _ = grasped_sheet(2.0)
    gravity(plan, 9.81)
    advance(plan, state, integrator, 60, HELD)
    before, anchors = state.x, state.memory[ANCHORS_KEY]
    for k in range(10):
        advance(plan, state, integrator, 60, HELD + 60 * (k + 1))
        assert np.array_equal(state.memory[ANCHORS_KEY], anchors)
    # A micrometre in ten minutes would be 17 nanometres in these ten seconds.
    assert np.abs(state.x - before).max() < 1e-12


@pytest.mark.parametrize(("axis", "share"), [(0, 3.0), (1, 2.0), (2, 2.0)])
def test_sheet_carried_at_1_m_per_s_does_not_slip(axis, share):
    """In a motion within its plane the sheet's inertia turns it about the jaws, which loads only their ends."""
    plan, state, integrator, force = grasped_sheet(share)
    gravity(plan, 9.81)
    advance(plan, state, integrator, 60, HELD)
    start, anchors = state.x[:, : 2 * COLUMNS], state.memory[ANCHORS_KEY]
    height, speed, max_slip = 0.0, 0.0, 0.0
    for s in range(210):
        k = HELD + 60 + s
        rise = 2.0 if s < 30 else -2.0 if 60 <= s < 90 else 0.0
        path = still()
        path[0], path[1 + axis], path[4 + axis], path[7 + axis] = k * FRAME, height, speed, 0.5 * rise
        force.set_paths(np.array([path, path]))
        advance(plan, state, integrator, 1, k)
        height, speed = height + speed * FRAME + 0.5 * rise * FRAME**2, speed + rise * FRAME
        carried = state.x[:, : 2 * COLUMNS].copy()
        carried[axis] -= height
        max_slip = max(max_slip, float(np.abs(carried - start).max()))
    assert height == pytest.approx(1.0)
    assert max_slip < SPACING / 100.0
    assert np.abs(carried - start).max() < 1e-6
    assert np.array_equal(state.memory[ANCHORS_KEY], anchors)


def test_energy_balance_includes_the_work_of_jaws():
    plan, state, integrator, force = hanging(make_jaw(0.3), tolerance=1e-6)
    close(force)
    state.memory[JAWS_KEY] = np.array([[1.3 * THICKNESS, -0.05]])
    balance = EnergyBalance(plan, state)
    for k in range(12):
        integrator.advance(plan, state, k * FRAME, FRAME, balance.accumulator)
        residual = balance.add_advance((k + 1) * FRAME, state)
    assert balance.work > 1e-5
    assert abs(residual) < 1e-3 * balance.energy_turnover


@pytest.mark.parametrize(
    ("integrator", "tolerance"),
    [("leapfrog", 1e-4), ("leapfrog", None), ("extrapolated", None), ("implicit", 1e-4), ("symplectic_euler", None)],
)
def test_every_integrator_closes_jaws_until_their_force(integrator, tolerance):
    plan, state, steps, force = hanging(make_jaw(0.2), integrator=integrator, tolerance=tolerance)
    close(force)
    state.memory[JAWS_KEY] = np.array([[1.2 * THICKNESS, -0.05]])
    advance(plan, state, steps, 6)
    loads = plan.contact.wrench_rates(6 * FRAME, state.x, state.v, memory=state.memory)
    assert loads[:, 1] == pytest.approx([0.2, -0.2], rel=1e-3)


def test_state_restored_from_bytes_continues_with_the_same_bits():
    plan, state, integrator, force = hanging()
    close(force)
    advance(plan, state, integrator, 11)
    again = State.from_bytes(state.to_bytes())
    second_plan, steps = compile(plan.model), make_integrator("auto", tolerance=1e-5)
    for k in range(11, 14):
        advance(plan, state, integrator, 1, k)
        advance(second_plan, again, steps, 1, k)
        assert state.digest() == again.digest()
    twin = state.shallow_copy()
    twin.memory[JAWS_KEY] = state.memory[JAWS_KEY] + 1e-15
    assert twin.digest() != state.digest()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"force": -1.0}, "force of the pads of 'hand' is -1.0 N; it must be above 0"),
        ({"speed": 0.0}, "speed of the pads of 'hand' is 0.0 m/s; it must be above 0"),
        ({"opening": float("nan")}, "opening of the pads of 'hand' is nan m; it must be above 0"),
        ({"inertia": float("inf")}, "inertia of the pads of 'hand' is inf kg; it must be above 0"),
        ({"size": (0.1, -0.1, 0.1)}, "y -0.1 m; it must be above 0"),
        ({"friction": (0.2, 0.5)}, "has friction 0.2 at rest and 0.5 in motion"),
    ],
)
def test_invalid_jaws_are_refused(change, words):
    values = {"force": 1.0, "speed": 0.05, "opening": 0.02, "inertia": 0.1} | change
    with pytest.raises(ValueError, match=words.replace("(", r"\(")):
        make_jaw(**values)


def test_sheet_mass_matches_the_tests_constant():
    assert hanging()[0].model.mass == pytest.approx(MASS)


@pytest.mark.parametrize("share", [0.1, 1.0, 10.0])
def test_step_limit_includes_jaws_that_move_with_the_sheet(share):
    """The bound is above the largest eigenvalue of sheet and jaws together, for jaws of any inertia."""
    between = 2 * COLUMNS
    masses = hanging()[0].model.masses[:between].sum()
    plan, state, _, force = hanging(make_jaw(friction=(0.0, 0.0), inertia=share * masses), anchored=False)
    close(force)
    x, still_ = state.x, np.zeros_like(state.x)
    half_opening, count = 0.6 * THICKNESS, x.size

    def accelerations(coordinates):
        memory = {JAWS_KEY: np.array([[coordinates[-1], 0.0]])}
        out, moved = np.empty_like(x), np.ascontiguousarray(coordinates[:-1].reshape(x.shape))
        plan.accelerations(0.0, moved, still_, out, memory)
        return np.concatenate([out.ravel(), plan.contact.jaw_accelerations(0.0, moved, still_, memory)])

    at, step = np.concatenate([x.ravel(), [half_opening]]), 1e-9
    slopes = [(accelerations(at + step * e) - accelerations(at - step * e)) / (2.0 * step) for e in np.eye(count + 1)]
    largest = -np.linalg.eigvals(np.array(slopes)).real.min()
    energy = plan.contact.predict_energy(0.0, 0.0, x, still_, {JAWS_KEY: np.array([[half_opening, 0.0]])})
    bound = plan.contact.bounds_at_energy(energy)[0] + plan.spectral_bounds(x)[0]
    assert largest < 1.001 * bound
    # A particle between two jaws is in two contacts. The limit of one is hardly more than half of the eigenvalue.
    alone = plan.contact.bounds_at_energy(plan.contact.contact_energy(half_opening))[0]
    assert largest > 1.9 * alone
