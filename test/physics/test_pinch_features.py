# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Jaws that close on a cell of a coarse cloth, between its particles, by their points and edges."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.contact_scenes import drop, flat_sheet, still
from support.feature_scenes import THICKNESS, intersected_triangles

from cloth_sim_ros.physics.accounting.energy_balance import EnergyBalance
from cloth_sim_ros.physics.contact.obstacles import Obstacle
from cloth_sim_ros.physics.contact.parallel_jaw import ParallelJaw
from cloth_sim_ros.physics.control.fallback import finish_implicitly
from cloth_sim_ros.physics.model.forces.contact import Contact, ContactSurface
from cloth_sim_ros.physics.model.sheets.grid import GridSheet
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.state.controller_state import JAWS_KEY
from cloth_sim_ros.verify.independent_integrator import dop853
from cloth_sim_ros.verify.reference_integrator import MotionState

FRAME = 1.0 / 60.0
#: The gripper's closing axis, y, is the sheet's normal; its middle is over that of a cell.
UP = Rotation.from_euler("x", 90.0, degrees=True).as_quat()
MIDDLE = (0.06, 0.055, 0.0)
FORCE = 0.4


def small_jaw(**options):
    """Return jaws that are smaller than a cell of 125 mm."""
    values = {"size": (0.04, 0.01, 0.03), "friction": (0.0, 0.0), "inertia": 0.06, "opening": 0.02, "force": FORCE}
    return ParallelJaw(gripper="hand", speed=0.1, **values | options)


def between(jaw=None, *, faces=True, listed=False, position=MIDDLE, half_opening=None, anchored=True, **options):
    """Return plan, state, integrator and contact of a weightless sheet between closing jaws.

    The sheet's corners are anchored. Several jaws have a position each.
    """
    jaws = jaw if isinstance(jaw, tuple) else (jaw or small_jaw(),)
    middles = [position] if isinstance(position, tuple) else position
    sheet = GridSheet(height=0.5, width=0.5, rows=5, columns=5, layout="alternating")
    surface = ContactSurface(sheet.triangles(), sheet.positions(), thickness=THICKNESS)
    force = Contact([], thickness=THICKNESS, jaws=jaws, faces=surface if faces else None)
    force.set_paths(np.array([still(middle, UP) for middle in middles for _ in range(2)]))
    force.set_jaw_commands(np.array([[True, True]] * len(jaws)))
    anchors = [0, 4, 20, 24] if anchored else ()
    material = {"gravity": False, "air.drag": 2.0, **options.pop("sheet", {})}
    model, places = flat_sheet(5, 5, force, size=0.5, listed=listed, anchors=anchors, **material)
    plan, state, integrator = drop(model, places, **{"tolerance": 1e-4, **options})
    if half_opening is not None:
        state.memory[JAWS_KEY] = np.array([[half_opening, 0.0]] * len(jaws))
    return plan, state, integrator, force


def advance(plan, state, integrator, frames, first=0, book=None):
    """Advance by frames; return how many were flagged."""
    return sum(integrator.advance(plan, state, k * FRAME, FRAME, book).flagged for k in range(first, first + frames))


def crossed_triangles(jaw, state, position=MIDDLE):
    """Return the triangles that a jaw's edges pass through."""
    half_opening = state.memory[JAWS_KEY][0, 0]
    sheet = GridSheet(height=0.5, width=0.5, rows=5, columns=5, layout="alternating")
    triangles = []
    for sign in (1.0, -1.0):
        offset = Rotation.from_quat(UP).apply([0.0, sign * (half_opening + 0.5 * jaw.size[1]), 0.0])
        box = Obstacle(name="pad", shape="box", size=jaw.size)
        triangles += intersected_triangles(
            box, still(np.add(position, offset), UP), 0.0, sheet.triangles(), state.positions
        )
    return triangles


@pytest.mark.parametrize("listed", [False, True])
def test_jaws_press_a_cell_with_their_force(listed):
    plan, state, integrator, _ = between(listed=listed)
    assert advance(plan, state, integrator, 40) == 0
    half_opening, rate = state.memory[JAWS_KEY][0]
    assert 0.1 * THICKNESS < half_opening < 0.5 * THICKNESS
    assert abs(rate) < 1e-9
    loads = plan.contact.wrench_rates(40 * FRAME, state.x, state.v, memory=state.memory)
    assert loads[:, 2] == pytest.approx([FORCE, -FORCE], rel=1e-6)
    # No particle is in reach.
    assert plan.contact.obstacle_gaps(40 * FRAME, state.x, memory=state.memory)[:, 0].tolist() == [0.0, 0.0]
    assert not crossed_triangles(small_jaw(), state)


def test_jaws_meet_nothing_without_faces():
    plan, state, integrator, _ = between(faces=False)
    advance(plan, state, integrator, 40)
    assert not plan.contact.wrench_rates(40 * FRAME, state.x, state.v, memory=state.memory)[:, :3].any()


@pytest.mark.parametrize("speed", [0.5, 5.0])
def test_closed_gripper_driven_through_the_sheet_carries_it(speed):
    plan, state, integrator, force = between(anchored=False)
    advance(plan, state, integrator, 30)
    for k in range(30, 36):
        position = np.add(MIDDLE, [0.0, 0.0, (k - 30) * FRAME * speed])
        path = still(position, UP)
        path[0], path[6] = k * FRAME, speed
        force.set_paths(np.array([path] * 2))
        advance(plan, state, integrator, 1, k)
        assert not crossed_triangles(small_jaw(), state, np.add(position, [0.0, 0.0, FRAME * speed]))
    assert state.x[2].max() > 0.8 * 6 * FRAME * speed


def test_force_on_jaws_is_the_energy_slope():
    """The slope is that by the half opening and by the sheet's positions; the jaws are tilted."""
    plan, state, _, force = between(anchored=False)
    turn = (Rotation.from_quat(UP) * Rotation.from_euler("xyz", [4.0, 20.0, 3.0], degrees=True)).as_quat()
    force.set_paths(np.array([still(MIDDLE, turn)] * 2))
    x, at_rest = state.x, np.zeros_like(state.x)
    jaw, half_opening, step = small_jaw(), 0.006, 1e-8

    def energy(half_opening, x=x):
        return plan.energy(0.0, x, at_rest, {JAWS_KEY: np.array([[half_opening, 0.0]])})

    # Down to where a corner is in reach.
    while energy(half_opening) == energy(0.1):
        half_opening -= 1e-4
    half_opening -= 2e-4
    slope = (energy(half_opening + step) - energy(half_opening - step)) / (2.0 * step)
    memory = {JAWS_KEY: np.array([[half_opening, 0.0]])}
    drive = -2.0 * jaw.force / jaw.inertia
    assert abs(slope) > 0.01
    assert plan.contact.jaw_accelerations(0.0, x, at_rest, memory)[0] == pytest.approx(
        drive - slope / jaw.inertia, rel=1e-6
    )
    a = np.empty_like(x)
    plan.accelerations(0.0, x, at_rest, a, memory)
    # Forces on the jaws are opposite to those on the cloth, and so are torques about the gripper.
    jaw_wrench, cloth_forces = (
        plan.contact.wrench_rates(0.0, x, at_rest, memory).sum(axis=0),
        (plan.model.masses * a).T,
    )
    torques = np.cross(state.positions - MIDDLE, cloth_forces)
    assert np.abs(torques.sum(axis=0)).max() > 1e-4
    assert jaw_wrench[:3] == pytest.approx(-cloth_forces.sum(axis=0), abs=1e-12)
    assert jaw_wrench[3:6] == pytest.approx(-torques.sum(axis=0), abs=1e-12)
    for c, i in ((2, 12), (2, 17), (0, 12)):
        moved = [x.copy() for _ in range(2)]
        moved[0][c, i] += step
        moved[1][c, i] -= step
        slope = (energy(half_opening, moved[0]) - energy(half_opening, moved[1])) / (2.0 * step)
        assert plan.model.masses[i] * a[c, i] == pytest.approx(-slope, rel=1e-5, abs=1e-6)


@pytest.mark.parametrize("inertia", [2e-3, 0.02, 0.2])
def test_step_limit_includes_jaws_that_move_with_a_cell(inertia):
    """The bound is above the largest eigenvalue of sheet and jaws together, for jaws of any inertia."""
    plan, state, _, _ = between(small_jaw(inertia=inertia), anchored=False)
    x, at_rest, half_opening = state.x, np.zeros_like(state.x), 0.3 * THICKNESS
    count = x.size

    def accelerations(coordinates):
        memory = {JAWS_KEY: np.array([[coordinates[-1], 0.0]])}
        out, moved = np.empty_like(x), np.ascontiguousarray(coordinates[:-1].reshape(x.shape))
        plan.accelerations(0.0, moved, at_rest, out, memory)
        return np.concatenate([out.ravel(), plan.contact.jaw_accelerations(0.0, moved, at_rest, memory)])

    at, step = np.concatenate([x.ravel(), [half_opening]]), 1e-9
    slopes = [(accelerations(at + step * e) - accelerations(at - step * e)) / (2.0 * step) for e in np.eye(count + 1)]
    largest = -np.linalg.eigvals(np.array(slopes)).real.min()
    memory = {JAWS_KEY: np.array([[half_opening, 0.0]])}
    bound = plan.contact.predict_surface_contact(0.0, 0.0, x, at_rest, memory)[0] + plan.spectral_bounds(x)[0]
    assert 0.2 * bound < largest < 1.001 * bound


def test_the_motion_is_that_of_dop853():
    plan, state, integrator, _ = between(half_opening=0.8 * THICKNESS, tolerance=1e-6)
    exact = dop853(plan, 0.0, 6 * FRAME, MotionState(state.x, state.v, state.memory))
    advance(plan, state, integrator, 6)
    assert np.abs(state.x - exact.x).max() < 6 * FRAME * 1e-6
    assert np.abs(state.memory[JAWS_KEY] - exact.memory[JAWS_KEY])[0, 0] < 6 * FRAME * 1e-6


def test_energy_balance_includes_the_work_of_jaws():
    plan, state, integrator, _ = between(half_opening=0.8 * THICKNESS, tolerance=1e-6)
    balance = EnergyBalance(plan, state)
    for k in range(12):
        integrator.advance(plan, state, k * FRAME, FRAME, balance.accumulator)
        residual = balance.add_advance((k + 1) * FRAME, state)
    assert abs(balance.work) > 1e-6
    assert abs(residual) < 1e-3 * balance.energy_turnover


@pytest.mark.parametrize("integrator", ["leapfrog", "implicit"])
def test_other_integrators_press_a_cell_with_the_same_force(integrator):
    plan, state, steps, _ = between(half_opening=0.7 * THICKNESS, integrator=integrator)
    advance(plan, state, steps, 30)
    loads = plan.contact.wrench_rates(30 * FRAME, state.x, state.v, memory=state.memory)
    assert loads[:, 2] == pytest.approx([FORCE, -FORCE], rel=1e-3)
    assert not crossed_triangles(small_jaw(), state)


def test_implicit_steps_press_cells_of_two_grippers():
    strong, weak = small_jaw(size=(0.03, 0.01, 0.02)), small_jaw(size=(0.03, 0.01, 0.02), force=0.5 * FORCE)
    places = [MIDDLE, (-0.06, -0.065, 0.0)]
    plan, state, steps, _ = between(
        (strong, weak), position=places, half_opening=0.7 * THICKNESS, integrator="implicit"
    )
    advance(plan, state, steps, 30)
    loads = plan.contact.wrench_rates(30 * FRAME, state.x, state.v, memory=state.memory)
    assert loads[:, 2] == pytest.approx([FORCE, -FORCE, 0.5 * FORCE, -0.5 * FORCE], rel=1e-3)


def test_fallback_starts_from_the_jaws_at_frame_start():
    plan, state, *_ = between(half_opening=0.7 * THICKNESS, position=(0.0, 0.0, 0.0))
    # Abandoned steps leave the engine's jaws with the grasped particle inside.
    plan.contact.upload({JAWS_KEY: np.array([[-0.004, 0.0]])})
    assert finish_implicitly(plan, state, 0.0, FRAME, None, instead_of="explicit", max_evaluations=math.inf).flagged
    assert np.isfinite(plan.energy(FRAME, state.x, state.v, memory=state.memory))


def test_threads_change_no_bit(monkeypatch):
    ends = []
    for threads in (1, 3):
        monkeypatch.setattr(Plan, "threads_per_run", lambda self, *_, count=threads: count)
        plan, state, integrator, _ = between(half_opening=0.8 * THICKNESS)
        advance(plan, state, integrator, 8)
        ends.append(state.digest())
    assert ends[0] == ends[1]


def test_jaws_inside_a_cell_are_refused():
    plan, state, _, force = between(half_opening=-0.004)
    with pytest.raises(ValueError, match=r"'hand\.(left|right)_pad' comes through the cloth between particles"):
        plan.contact.check_initial_penetration(0.0, state.x, memory=state.memory)
    force.set_jaw_commands(np.array([[False, False]]))
    plan.contact.check_initial_penetration(0.0, state.x, memory=state.memory)


def test_absent_jaws_cost_nothing():
    """The estimated cost of a frame decides its steps: it must not depend on earlier calls."""
    plan, state, _, force = between(half_opening=0.8 * THICKNESS)
    assert plan.contact.operation_count(0.0, FRAME, state) > 0.0
    force.set_jaw_commands(np.array([[False, False]]))
    assert plan.contact.operation_count(0.0, FRAME, state) == 0.0
