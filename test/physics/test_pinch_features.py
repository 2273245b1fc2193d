# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Jaws that close on a cell of a coarse cloth, between its particles, by their points and edges."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.contact_scenes import drop, flat_sheet, still
from support.feature_scenes import THICKNESS, come_through

from cloth_sim_ros.physics.control.fallback import finish
from cloth_sim_ros.physics.energy_balance import EnergyBalance
from cloth_sim_ros.physics.forces.contact import Contact, OwnSurface
from cloth_sim_ros.physics.obstacles import Obstacle
from cloth_sim_ros.physics.pinch import Pads
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.remembered import PINCHED
from cloth_sim_ros.physics.sheets.grid import GridSheet
from cloth_sim_ros.verify.fine import Moving
from cloth_sim_ros.verify.independent import dop853

FRAME = 1.0 / 60.0
#: The gripper's closing axis, y, is the sheet's normal; its middle is over that of a cell.
UP = Rotation.from_euler("x", 90.0, degrees=True).as_quat()
MIDDLE = (0.06, 0.055, 0.0)
FORCE = 0.4


def pads(**options):
    """Return jaws that are smaller than a cell of 125 mm."""
    values = {"size": (0.04, 0.01, 0.03), "friction": (0.0, 0.0), "inertia": 0.06, "opening": 0.02, "force": FORCE}
    return Pads(gripper="hand", speed=0.1, **values | options)


def between(own=None, *, faces=True, listed=False, place=MIDDLE, way=None, anchored=True, **options):
    """Return plan, state, integrator and contact of a weightless sheet between closing jaws.

    The sheet's corners are anchored. Several jaws have a position each.
    """
    hands = own if isinstance(own, tuple) else (own or pads(),)
    middles = [place] if isinstance(place, tuple) else place
    sheet = GridSheet(height=0.5, width=0.5, rows=5, columns=5, layout="alternating")
    surface = OwnSurface(sheet.triangles(), sheet.positions(), thickness=THICKNESS)
    force = Contact([], thickness=THICKNESS, pads=hands, faces=surface if faces else None)
    force.move(np.array([still(middle, UP) for middle in middles for _ in range(2)]))
    force.drive(np.array([[True, True]] * len(hands)))
    anchors = [0, 4, 20, 24] if anchored else ()
    material = {"gravity": False, "air.drag": 2.0, **options.pop("sheet", {})}
    model, places = flat_sheet(5, 5, force, size=0.5, listed=listed, anchors=anchors, **material)
    plan, state, integrator = drop(model, places, **{"tolerance": 1e-4, **options})
    if way is not None:
        state.memory[PINCHED] = np.array([[way, 0.0]] * len(hands))
    return plan, state, integrator, force


def advance(plan, state, integrator, frames, first=0, book=None):
    """Advance by frames; return how many were flagged."""
    return sum(integrator.advance(plan, state, k * FRAME, FRAME, book).flagged for k in range(first, first + frames))


def through(own, state, place=MIDDLE):
    """Return the triangles that a jaw's edges pass through."""
    way = state.memory[PINCHED][0, 0]
    sheet = GridSheet(height=0.5, width=0.5, rows=5, columns=5, layout="alternating")
    found = []
    for side in (1.0, -1.0):
        out = Rotation.from_quat(UP).apply([0.0, side * (way + 0.5 * own.size[1]), 0.0])
        box = Obstacle(name="pad", shape="box", size=own.size)
        found += come_through(box, still(np.add(place, out), UP), 0.0, sheet.triangles(), state.positions)
    return found


@pytest.mark.parametrize("listed", [False, True])
def test_jaws_press_a_cell_with_their_force(listed):
    plan, state, integrator, _ = between(listed=listed)
    assert advance(plan, state, integrator, 40) == 0
    way, rate = state.memory[PINCHED][0]
    assert 0.1 * THICKNESS < way < 0.5 * THICKNESS
    assert abs(rate) < 1e-9
    loads = plan.contact.rates(40 * FRAME, state.x, state.v)
    assert loads[:, 2] == pytest.approx([FORCE, -FORCE], rel=1e-6)
    # No particle is in reach.
    assert plan.contact.gaps(40 * FRAME, state.x)[:, 0].tolist() == [0.0, 0.0]
    assert not through(pads(), state)


def test_jaws_meet_nothing_without_faces():
    plan, state, integrator, _ = between(faces=False)
    advance(plan, state, integrator, 40)
    assert not plan.contact.rates(40 * FRAME, state.x, state.v)[:, :3].any()


@pytest.mark.parametrize("speed", [0.5, 5.0])
def test_closed_gripper_driven_through_the_sheet_carries_it(speed):
    plan, state, integrator, force = between(anchored=False)
    advance(plan, state, integrator, 30)
    for k in range(30, 36):
        place = np.add(MIDDLE, [0.0, 0.0, (k - 30) * FRAME * speed])
        path = still(place, UP)
        path[0], path[6] = k * FRAME, speed
        force.move(np.array([path] * 2))
        advance(plan, state, integrator, 1, k)
        assert not through(pads(), state, np.add(place, [0.0, 0.0, FRAME * speed]))
    assert state.x[2].max() > 0.8 * 6 * FRAME * speed


def test_force_on_jaws_is_the_energy_slope():
    """The slope is that by the half opening and by the sheet's positions; the jaws are tilted."""
    plan, state, _, force = between(anchored=False)
    turn = (Rotation.from_quat(UP) * Rotation.from_euler("xyz", [4.0, 20.0, 3.0], degrees=True)).as_quat()
    force.move(np.array([still(MIDDLE, turn)] * 2))
    x, at_rest = state.x, np.zeros_like(state.x)
    own, way, step = pads(), 0.006, 1e-8

    def energy(way, x=x):
        plan.contact.lay_pads(np.array([[way, 0.0]]))
        return plan.energy(0.0, x, at_rest)

    # Down to where a corner is in reach.
    while energy(way) == energy(0.1):
        way -= 1e-4
    way -= 2e-4
    slope = (energy(way + step) - energy(way - step)) / (2.0 * step)
    plan.contact.lay_pads(np.array([[way, 0.0]]))
    drive = -2.0 * own.force / own.inertia
    assert abs(slope) > 0.01
    assert plan.contact.pad_accelerations(0.0, x, at_rest)[0] == pytest.approx(drive - slope / own.inertia, rel=1e-6)
    a = np.empty_like(x)
    plan.accelerations(0.0, x, at_rest, a)
    # Forces on the jaws are opposite to those on the cloth, and so are torques about the gripper.
    felt, own_forces = plan.contact.rates(0.0, x, at_rest).sum(axis=0), (plan.model.masses * a).T
    torques = np.cross(state.positions - MIDDLE, own_forces)
    assert np.abs(torques.sum(axis=0)).max() > 1e-4
    assert felt[:3] == pytest.approx(-own_forces.sum(axis=0), abs=1e-12)
    assert felt[3:6] == pytest.approx(-torques.sum(axis=0), abs=1e-12)
    for c, i in ((2, 12), (2, 17), (0, 12)):
        moved = [x.copy() for _ in range(2)]
        moved[0][c, i] += step
        moved[1][c, i] -= step
        slope = (energy(way, moved[0]) - energy(way, moved[1])) / (2.0 * step)
        assert plan.model.masses[i] * a[c, i] == pytest.approx(-slope, rel=1e-5, abs=1e-6)


@pytest.mark.parametrize("inertia", [2e-3, 0.02, 0.2])
def test_step_limit_includes_jaws_that_move_with_a_cell(inertia):
    """The bound is above the largest eigenvalue of sheet and jaws together, for jaws of any inertia."""
    plan, state, _, _ = between(pads(inertia=inertia), anchored=False)
    x, at_rest, way = state.x, np.zeros_like(state.x), 0.3 * THICKNESS
    count = x.size

    def accelerations(place):
        plan.contact.lay_pads(np.array([[place[-1], 0.0]]))
        out, moved = np.empty_like(x), np.ascontiguousarray(place[:-1].reshape(x.shape))
        plan.accelerations(0.0, moved, at_rest, out)
        return np.concatenate([out.ravel(), plan.contact.pad_accelerations(0.0, moved, at_rest)])

    at, step = np.concatenate([x.ravel(), [way]]), 1e-9
    slopes = [(accelerations(at + step * e) - accelerations(at - step * e)) / (2.0 * step) for e in np.eye(count + 1)]
    largest = -np.linalg.eigvals(np.array(slopes)).real.min()
    plan.contact.lay_pads(np.array([[way, 0.0]]))
    bound = plan.contact.own_ahead(0.0, 0.0, x, at_rest)[0] + plan.rates(x)[0]
    assert 0.2 * bound < largest < 1.001 * bound


def test_the_motion_is_that_of_dop853():
    plan, state, integrator, _ = between(way=0.8 * THICKNESS, tolerance=1e-6)
    exact = dop853(plan, 0.0, 6 * FRAME, Moving(state.x, state.v, None, state.memory[PINCHED]))
    advance(plan, state, integrator, 6)
    assert np.abs(state.x - exact.x).max() < 6 * FRAME * 1e-6
    assert np.abs(state.memory[PINCHED] - exact.pinched)[0, 0] < 6 * FRAME * 1e-6


def test_energy_balance_includes_the_work_of_jaws():
    plan, state, integrator, _ = between(way=0.8 * THICKNESS, tolerance=1e-6)
    balance = EnergyBalance(plan, state)
    for k in range(12):
        integrator.advance(plan, state, k * FRAME, FRAME, balance.book)
        residual = balance.close((k + 1) * FRAME, state)
    assert abs(balance.work) > 1e-6
    assert abs(residual) < 1e-3 * balance.turned_over


@pytest.mark.parametrize("integrator", ["leapfrog", "implicit"])
def test_other_integrators_press_a_cell_with_the_same_force(integrator):
    plan, state, steps, _ = between(way=0.7 * THICKNESS, integrator=integrator)
    advance(plan, state, steps, 30)
    loads = plan.contact.rates(30 * FRAME, state.x, state.v)
    assert loads[:, 2] == pytest.approx([FORCE, -FORCE], rel=1e-3)
    assert not through(pads(), state)


def test_implicit_steps_press_cells_of_two_grippers():
    strong, weak = pads(size=(0.03, 0.01, 0.02)), pads(size=(0.03, 0.01, 0.02), force=0.5 * FORCE)
    places = [MIDDLE, (-0.06, -0.065, 0.0)]
    plan, state, steps, _ = between((strong, weak), place=places, way=0.7 * THICKNESS, integrator="implicit")
    advance(plan, state, steps, 30)
    loads = plan.contact.rates(30 * FRAME, state.x, state.v)
    assert loads[:, 2] == pytest.approx([FORCE, -FORCE, 0.5 * FORCE, -0.5 * FORCE], rel=1e-3)


def test_fallback_starts_from_the_jaws_at_frame_start():
    plan, state, *_ = between(way=0.7 * THICKNESS, place=(0.0, 0.0, 0.0))
    # As abandoned steps leave them: with the grasped particle inside.
    plan.contact.lay_pads(np.array([[-0.004, 0.0]]))
    assert finish(plan, state, 0.0, FRAME, None, instead_of="explicit", most=math.inf).flagged
    assert np.isfinite(plan.energy(FRAME, state.x, state.v))


def test_threads_change_no_bit(monkeypatch):
    ends = []
    for threads in (1, 3):
        monkeypatch.setattr(Plan, "threads", lambda self, *_, count=threads: count)
        plan, state, integrator, _ = between(way=0.8 * THICKNESS)
        advance(plan, state, integrator, 8)
        ends.append(state.digest())
    assert ends[0] == ends[1]


def test_jaws_inside_a_cell_are_refused():
    plan, state, _, force = between(way=-0.004)
    plan.contact.take(state)
    with pytest.raises(ValueError, match=r"'hand\.(left|right)_pad' comes through the cloth between particles"):
        plan.contact.check_clear(0.0, state.x)
    force.drive(np.array([[False, False]]))
    plan.contact.check_clear(0.0, state.x)


def test_absent_jaws_cost_nothing():
    """The estimated cost of a frame decides its steps: it must not depend on earlier calls."""
    plan, state, _, force = between(way=0.8 * THICKNESS)
    assert plan.contact.work(0.0, FRAME, state) > 0.0
    force.drive(np.array([[False, False]]))
    assert plan.contact.work(0.0, FRAME, state) == 0.0
