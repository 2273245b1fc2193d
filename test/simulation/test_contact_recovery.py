# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recovery of compressed contacts: thickness, added speed and energy, and refusals."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support import contact_starts as starts
from support import garment
from support.layer_stacks import stack_geometry
from support.obstacle_sheets import BORNE, SHEET, THICKNESS
from support.session_maker import SessionMaker

from cloth_sim_ros.physics.contact.thickness import LAYER_RECOVERY_SPEED, RECOVERY_SPEED, START_GAP
from cloth_sim_ros.physics.control.explicit import ExplicitIntegrator
from cloth_sim_ros.physics.integrators.base import UnstableError
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.state.controller_state import THICKNESS_KEY as KEY
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.event_checks import EventError
from cloth_sim_ros.simulation.events import Event, Grasp, Move, Reset, SetParameters, Target
from cloth_sim_ros.simulation.simulation import Simulation
from cloth_sim_ros.verify.accuracy import certify
from cloth_sim_ros.verify.run import verify

#: A sheet on a table, so close that a larger thickness compresses its contacts.
LYING: dict[str, Any] = {
    **SHEET,
    "cloth.resolution": [7, 7],
    "cloth.position": [0.0, 0.0, BORNE * THICKNESS],
    "cloth.orientation": [0.0, 0.0, 0.0, 1.0],
    "tolerance": 1e-3,
    "obstacles": ["table"],
    "table.shape": "box",
    "table.size": [0.6, 0.6, 0.1],
    "table.position": [0.0, 0.0, -0.05],
    "table.friction": [0.5, 0.4],
}
THICK = SetParameters({"contact.thickness": 5e-3})


def lying(state: State | None = None, **more: Any) -> Simulation:
    return Simulation(Scene.from_parameters({**LYING, **more}), state)


def recovering(frames: int = 3, **more: Any) -> Simulation:
    """A sheet whose contacts have regained part of their thickness."""
    cloth = lying(**more)
    cloth.advance([THICK])
    for _ in range(frames - 1):
        cloth.advance()
    assert cloth.contact_recovery is not None
    return cloth


def frames_left(cloth: Simulation) -> int:
    """Return the number of frames until contacts have the full thickness."""
    recovery = cloth.contact_recovery
    assert recovery is not None
    return math.ceil(recovery.duration * cloth.scene.rate)


def start_at(height: float, **more: Any) -> Simulation:
    return lying(**{"cloth.position": [0.0, 0.0, height], **more})


SITUATIONS = [
    (starts.start, "plane", 0.05),
    (starts.start, "sphere", 0.5),
    (starts.start, "cloth", 0.9),
    (starts.start, "fold", 0.3),
    (starts.thickened, "mesh", 0.1),
    (starts.thickened, "cloth", 0.3),
    (starts.added, "box", 0.3),
    (starts.added, "box, hovering", 0.3),
    (starts.loaded, "box", 0.7),
    (starts.changed, "sphere", 0.1),
]


@pytest.mark.parametrize(("make", "support", "gap"), SITUATIONS)
def test_events_add_no_speed_above_the_limit(make: Any, support: str, gap: float) -> None:
    begun = make(support, gap * THICKNESS, starts.FINE)
    seen = starts.watch(begun, 0.5)
    assert begun.simulation.contact_recovery is None
    assert 1e-3 < seen.speed < starts.FASTEST
    assert seen.left_over < starts.OPEN
    report = begun.simulation.energy_report
    assert report is not None
    assert report.recovered > 0.0


def stack(layers: int, gap: float) -> Simulation:
    """Sheets of 6 x 6 particles above one another at a gap [m], the lowest one held, without gravity."""
    places: list[Array] = []
    triangles: list[NDArray[np.int64]] = []
    count = 6 * 6
    for k in range(layers):
        sheet, of, held = stack_geometry(6, 6, 0.3 * k)
        above = of[:, 0] >= len(held)
        sheet[:, 2] = k * gap
        places.append(sheet[len(held) :])
        triangles.append(of[above] - len(held) + k * count)
    mesh = garment.as_obj(np.concatenate(places), np.concatenate(triangles))
    more = {"cloth.anchors": [str(i) for i in range(count)], "gravity": [0.0, 0.0, 0.0]}
    return starts.simulation({**starts.stacked(gap, starts.COARSE)[0], **more}, sheets=mesh)


def test_stack_of_layers_stays_below_the_limit() -> None:
    cloth = stack(5, 0.3 * THICKNESS)
    fastest = 0.0
    for _ in range(2 * frames_left(cloth)):
        cloth.advance()
        fastest = max(fastest, float(np.linalg.norm(cloth.velocities, axis=1).max()))
    assert cloth.contact_recovery is None
    # Each of four layers adds to the speed of the one below.
    assert 4.0 * LAYER_RECOVERY_SPEED < fastest < starts.FASTEST


def test_cloth_between_near_plates_rests_with_thin_contacts() -> None:
    plates = {
        "cloth.position": [0.0, 0.0, 0.0],
        "obstacles": ["table", "lid"],
        "table.position": [0.0, 0.0, -0.05 - 0.5 * THICKNESS],
        "lid.shape": "box",
        "lid.size": [0.6, 0.6, 0.1],
        "lid.position": [0.0, 0.0, 0.05 + 0.5 * THICKNESS],
    }
    cloth = lying(**plates)
    rate = round(cloth.scene.rate)
    for _ in range(rate):
        assert np.abs(cloth.velocities).max() < starts.FASTEST
        cloth.advance()
    thickness = cloth.state.memory[KEY].copy()
    for _ in range(rate):
        cloth.advance()
    assert cloth.asleep
    assert not cloth.velocities.any()
    assert np.array_equal(cloth.state.memory[KEY], thickness)
    # The thickness grew to little more than the gap, where the force became too large.
    on_plates = thickness[:2, :-1]
    assert (on_plates > 0.5 / START_GAP * THICKNESS).all()
    assert (on_plates < 0.6 * THICKNESS).all()
    # Recovery continues when the plates separate.
    cloth.advance([Move("lid", (0.0, 0.0, 0.1))])
    for _ in range(frames_left(cloth) + 1):
        cloth.advance()
    assert cloth.contact_recovery is None


@pytest.mark.parametrize("support", ["plane", "cloth"])
def test_release_after_a_press_lifts_no_corner(support: str) -> None:
    begun = starts.released(support, 0.01, starts.COARSE)
    seen = starts.watch(begun, 0.3)
    assert seen.speed < starts.FASTEST
    assert seen.rise < starts.HIGHEST


#: Integrators, their fixed steps [s], and the largest speed [m/s]: explicit ones stay below the limit.
INTEGRATORS = [
    ("auto", 0.0),
    ("leapfrog", 0.0),
    ("leapfrog", 1e-5),
    ("extrapolated", 0.0),
    ("symplectic_euler", 0.0),
    ("symplectic_euler", 1e-5),
    ("implicit", 0.0),
    ("implicit", 1e-3),
]


@pytest.mark.parametrize(("integrator", "step"), INTEGRATORS)
def test_integrators_let_contacts_recover(integrator: str, step: float) -> None:
    smooth = {"table.friction": [0.0, 0.0], "tolerance": 0.0 if step else 1e-4}
    cloth = start_at(0.3 * THICKNESS, integrator=integrator, step=step, **smooth)
    fastest, flagged = 0.0, 0
    for _ in range(frames_left(cloth)):
        done = cloth.advance().advance
        assert done is not None
        fastest, flagged = max(fastest, float(np.abs(cloth.velocities).max())), flagged + done.flagged
    assert cloth.contact_recovery is None
    # Without recovery in the energy balance a frame seems to gain energy and is rejected.
    assert integrator == "implicit" or not flagged
    assert 0.5 * RECOVERY_SPEED < fastest < starts.FASTEST
    assert cloth.positions[:, 2].min() > 0.9 * THICKNESS


#: Without gravity, by the implicit method: rate [Hz], tolerance [m], and gap over thickness. First one step per frame,
#: in which thickness would grow twenty-fold; then frames that steps without energy gain complete.
IMPLICIT = [(10.0, 1e-3, 0.021), (60.0, 1e-6, 0.05)]


@pytest.mark.parametrize(("rate", "tolerance", "gap"), IMPLICIT)
def test_implicit_steps_follow_the_growth(rate: float, tolerance: float, gap: float) -> None:
    values = {"contact.damping": 100.0} if rate == 10.0 else {}
    cloth = starts.simulation(
        starts.sheet_on(
            "plane", gap * THICKNESS, tolerance, integrator="implicit", rate=rate, gravity=[0.0, 0.0, 0.0], **values
        )
    )
    for _ in range(3 * frames_left(cloth)):
        cloth.advance()
        assert np.abs(cloth.velocities).max() < 2.5 * RECOVERY_SPEED
    assert cloth.contact_recovery is None


def test_recovery_reports_what_recovers_and_for_how_long() -> None:
    cloth = start_at(0.5 * THICKNESS)
    recovery = cloth.contact_recovery
    assert recovery is not None
    assert (recovery.names, recovery.particles) == (("table",), 49)
    assert recovery.lift == pytest.approx((1.0 - 0.5 / START_GAP) * THICKNESS)
    assert recovery.duration == pytest.approx(recovery.lift / RECOVERY_SPEED)
    for left in range(frames_left(cloth), 0, -1):
        assert frames_left(cloth) == left
        cloth.advance()
    assert cloth.contact_recovery is None
    assert KEY not in cloth.state.memory


@pytest.mark.parametrize("gap", [0.0199, 0.005])
def test_starts_too_near_are_refused_with_the_lift(gap: float) -> None:
    lift = f"{(1.0 - gap) * THICKNESS:.3g}"
    with pytest.raises(ValueError, match=rf"the cloth is .* m from obstacle 'table' at particle 0 .*{lift} m apart"):
        start_at(gap * THICKNESS)
    start_at(0.0201 * THICKNESS)


def test_layers_too_near_are_refused_with_the_lift() -> None:
    with pytest.raises(ValueError, match=r"the cloth is 2e-05 m from itself .*layers 0.00198 m apart"):
        starts.start("cloth", 0.01 * THICKNESS, starts.COARSE)


@pytest.mark.parametrize(
    "values",
    [{"contact.thickness": 0.02}, {"obstacles": ["table", "new"]}],
)
def test_parameters_that_leave_no_gap_are_refused(values: dict[str, Any]) -> None:
    near_plane = {"new.shape": "plane", "new.position": [0.0, 0.0, BORNE * THICKNESS - 0.01 * THICKNESS]}
    # A small thickness, of which 20 mm are fifty times as much.
    thin = {"contact.thickness": 0.15 * THICKNESS, "cloth.position": [0.0, 0.0, 0.147 * THICKNESS]}
    cloth = lying(**(thin if "contact.thickness" in values else near_plane))
    cloth.advance()
    before = cloth.state.digest()
    with pytest.raises(
        EventError, match=r"the cloth is .* m at least, 0.02 of contact.thickness: move them .* m apart"
    ):
        cloth.advance([SetParameters(values)])
    assert cloth.state.digest() == before
    cloth.advance()


def test_reset_to_a_compressed_start_recovers_again() -> None:
    cloth = start_at(0.3 * THICKNESS)
    recovery, frames = cloth.contact_recovery, frames_left(cloth)
    first = [cloth.advance() and cloth.positions for _ in range(frames)]
    assert cloth.contact_recovery is None
    cloth.advance([Reset()])
    assert recovery is not None
    assert cloth.contact_recovery is not None
    assert cloth.contact_recovery.lift == pytest.approx(recovery.lift - RECOVERY_SPEED / cloth.scene.rate)
    again = [cloth.positions] + [cloth.advance() and cloth.positions for _ in range(frames - 1)]
    assert again == [pytest.approx(coordinate, abs=1e-6) for coordinate in first]


def test_reset_too_near_is_refused_and_changes_nothing() -> None:
    cloth = start_at(0.3 * THICKNESS, **{"cloth.size": [0.9, 0.9]})
    for _ in range(60):
        cloth.advance()
    cloth.advance([SetParameters({"contact.thickness": 0.035})])
    before = cloth.state.digest()
    with pytest.raises(EventError, match=r"the cloth as it starts is 0.0006 m from obstacle 'table'"):
        cloth.advance([Reset()])
    assert cloth.state.digest() == before


def test_controls_of_a_frame_keep_its_recovery() -> None:
    cloth = lying()
    cloth.advance([THICK])
    before = cloth.state.memory[KEY]
    cloth.advance()
    contact, present = cloth.frame_controls.contact, cloth.plan.controls.contact
    assert contact is not None
    assert contact.recovery.start is before
    assert contact.recovery.target is cloth.state.memory[KEY]
    assert (contact.recovery.start < contact.recovery.target).any()
    # Between frames nothing grows.
    assert present is not None
    assert present.recovery.target is None


def test_snapshots_amid_a_recovery_give_the_same_bits() -> None:
    cloth = recovering()
    snapshot = cloth.snapshot()
    frames = frames_left(cloth) + 2
    digests = [cloth.advance() and cloth.state.digest() for _ in range(frames)]
    assert cloth.contact_recovery is None
    for simulation in (cloth, recovering(5), lying()):
        if simulation.scene.contact.thickness != cloth.scene.contact.thickness:
            simulation.advance([THICK])
        simulation.restore(snapshot)
        assert simulation.contact_recovery is not None
        assert [simulation.advance() and simulation.state.digest() for _ in range(frames)] == digests


def test_states_amid_a_recovery_go_through_bytes() -> None:
    cloth = recovering()
    data = cloth.state.to_bytes()
    assert KEY in State.from_bytes(data).memory
    values = {**LYING, "contact.thickness": 5e-3}
    restored = Simulation(Scene.from_parameters(values), State.from_bytes(data))
    for _ in range(10):
        cloth.advance()
        restored.advance()
        assert restored.state.digest() == cloth.state.digest()


@pytest.mark.parametrize("seed", [2, 3, 5])
def test_release_on_a_moving_table_restarts_to_the_bit(seed: int) -> None:
    # A path's end differs by rounding from the pose in a saved state.
    random = np.random.default_rng(seed)
    cloth = lying(grippers=["gripper"], **{"gripper.radius": 0.03, "gripper.stiffness": 1e4})
    held, table = cloth.positions[-1], np.array([0.0, 0.0, -0.05])
    cloth.advance([Target("gripper", tuple(held)), Grasp("gripper", True)])
    for _ in range(12):
        held = held - [0.0, 0.0, 1.5e-3]
        table = table + random.normal(size=3) * [1e-3, 1e-3, 2e-4]
        turn = random.normal(size=4) * [1e-3, 1e-3, 1e-2, 0.0] + [0.0, 0.0, 0.0, 1.0]
        cloth.advance([Target("gripper", tuple(held)), Move("table", tuple(table), tuple(turn))])
    again = Simulation(cloth.scene, State.from_bytes(cloth.state.to_bytes()))
    for simulation in (cloth, again):
        simulation.advance([Grasp("gripper", False)])
    assert KEY in cloth.state.memory
    assert again.state.digest() == cloth.state.digest()


def test_thickness_that_reaches_pads_is_refused_in_check() -> None:
    cloth = Simulation(Scene.from_parameters({**PINCH, "contact.thickness": 1e-4, "gravity": [0.0, 0.0, 0.0]}))
    cloth.advance([Target("gripper", (0.15, 0.01 - 2e-4, 0.0))])
    with pytest.raises(EventError, match=r"the cloth is .* m from obstacle 'gripper.right_pad'.* 0.02 of"):
        cloth.check(SetParameters({"contact.thickness": 0.02}))


def _single_precision(reduced: Array) -> Array:
    return reduced[:, 1:]


def _zero(reduced: Array) -> Array:
    return reduced * 0.0


def _endless(reduced: Array) -> Array:
    return reduced * np.nan


@pytest.mark.parametrize("spoil", [_single_precision, _zero, _endless])
def test_states_with_a_bad_thickness_are_refused(spoil: Any) -> None:
    state = recovering().state.copy()
    state.memory[KEY] = np.ascontiguousarray(spoil(state.memory[KEY]))
    with pytest.raises(ValueError, match=re.escape(f"memory '{KEY}'")):
        State.from_bytes(state.to_bytes())


def test_states_of_other_obstacles_are_refused_or_whole() -> None:
    state = recovering().state.copy()
    state.memory[KEY] = np.vstack([state.memory[KEY], state.memory[KEY][-1:]])
    read = State.from_bytes(state.to_bytes())
    with pytest.raises(ValueError, match=KEY):
        Simulation(Scene.from_parameters({**LYING, "contact.thickness": 5e-3}), read).advance()


def test_full_thickness_leaves_no_state_entry() -> None:
    cloth, reference = lying(), lying()
    for k in range(30):
        # Changes without effect on contact geometry leave the contact unchanged.
        cloth.advance([SetParameters({"table.friction": [0.5, 0.4]})] if k == 10 else ())
        reference.advance([SetParameters({"table.friction": [0.5, 0.4]})] if k == 10 else ())
        assert KEY not in cloth.state.memory
    assert cloth.state.digest() == reference.state.digest()


def test_cloth_stays_awake_while_contacts_recover() -> None:
    calm = {"air.drag": 50.0, "rate": 30.0, "tolerance": 1e-3, "contact.thickness": 0.016}
    cloth = start_at(0.05 * 0.016, **calm)
    slept = None
    for k in range(200):
        cloth.advance()
        if cloth.contact_recovery is not None:
            assert not cloth.asleep
        if cloth.asleep:
            slept = k
            break
    assert slept is not None
    # A thickness that compresses contacts wakes the cloth.
    cloth.advance([SetParameters({"contact.thickness": 0.02})])
    assert not cloth.asleep
    assert cloth.contact_recovery is not None


def test_repeated_frames_keep_the_thickness(monkeypatch: pytest.MonkeyPatch) -> None:
    moved, reference = recovering(), recovering()
    order = Move("table", (0.0, 0.0, -0.051))
    advance, calls = ExplicitIntegrator.advance, []

    def fails_once(*args: Any) -> Any:
        calls.append(args)
        if len(calls) == 1:
            args[2].memory.pop(KEY)  # The state is advanced in place.
            raise UnstableError("as if obstacles left no room")
        return advance(*args)

    monkeypatch.setattr(ExplicitIntegrator, "advance", fails_once)
    frame = moved.advance([order])
    monkeypatch.setattr(ExplicitIntegrator, "advance", advance)
    assert frame.stopped == ("table",)
    assert len(calls) == 2
    # The other simulation's table was never commanded: recovery continues as without the command.
    reference.advance()
    assert np.array_equal(moved.state.memory[KEY], reference.state.memory[KEY])


def test_failed_frames_leave_the_thickness(monkeypatch: pytest.MonkeyPatch) -> None:
    cloth = recovering()
    before, thickness = cloth.state.digest(), cloth.state.memory[KEY].copy()

    def fails(*_: Any) -> Any:
        raise UnstableError("never")

    with monkeypatch.context() as patched:
        patched.setattr(ExplicitIntegrator, "advance", fails)
        with pytest.raises(UnstableError):
            cloth.advance()
    assert cloth.state.digest() == before
    assert np.array_equal(cloth.state.memory[KEY], thickness)
    cloth.advance()


PINCH: dict[str, Any] = {
    "gripper.mode": "pinch",
    "gripper.pad_size": [0.15, 0.02, 0.15],
    "gripper.opening": 0.02,
    "gripper.force": 30.0,
    "cloth.resolution": [6, 6],
    "cloth.size": [0.3, 0.3],
    "cloth.position": [0.0, 0.0, 0.15],
    "tolerance": 1e-3,
    "air.drag": 0.0,
}


def test_opening_pads_do_not_accelerate_the_cloth() -> None:
    corner = (0.15, 0.0, 0.0)
    cloth = Simulation(Scene.from_parameters(PINCH))
    cloth.advance([Target("gripper", corner), Grasp("gripper", True)])
    for _ in range(60):
        cloth.advance()
    assert cloth.grasped_count(0) > 0
    cloth.advance([Grasp("gripper", False)])
    recovery = cloth.contact_recovery
    assert recovery is not None
    assert set(recovery.names) == {"gripper.left_pad", "gripper.right_pad"}
    for _ in range(2 * frames_left(cloth)):
        # Across the pads.
        assert np.abs(cloth.velocities[:, 1]).max() < starts.FASTEST
        cloth.advance()
    assert cloth.contact_recovery is None
    assert cloth.grasped_count(0) == 0


def test_pads_placed_near_the_cloth_do_not_accelerate_it() -> None:
    cloth = Simulation(Scene.from_parameters({**PINCH, "gravity": [0.0, 0.0, 0.0]}))
    cloth.advance()
    before, thickness = cloth.state.digest(), cloth.scene.contact.thickness
    with pytest.raises(EventError, match=r"target of 'gripper': the cloth is .* m from obstacle 'gripper.right_pad'"):
        cloth.advance([Target("gripper", (0.15, 0.01 - 0.01 * thickness, 0.0))])
    assert cloth.state.digest() == before
    cloth.advance([Target("gripper", (0.15, 0.01 - 0.1 * thickness, 0.0))])
    assert cloth.contact_recovery is not None
    for _ in range(frames_left(cloth)):
        assert np.abs(cloth.velocities).max() < starts.FASTEST
        cloth.advance()
    assert cloth.contact_recovery is None


def _recorded(folder: Path, frames: int = 14, **more: Any) -> list[Path]:
    """A session in which contacts recover after the start, and again after a larger thickness."""
    values = {**LYING, "cloth.position": [0.0, 0.0, 0.5 * THICKNESS], "diagnostics.energy": True, **more}
    maker = SessionMaker(folder, Scene.from_parameters(values))
    assert maker.simulation.contact_recovery is not None
    for k in range(frames):
        events: list[Event] = [THICK] if k == 7 else []
        if k == 9:
            # The file begins with a state during the recovery.
            assert maker.simulation.contact_recovery is not None
            maker.split()
        maker.add(events)
    maker.finish()
    return sorted(folder.glob("*.mcap"))


def test_sessions_amid_a_recovery_verify_to_the_last_bit(tmp_path: Path) -> None:
    paths = _recorded(tmp_path)
    for these, frames in ((paths, 14), (paths[1:], 5)):
        verdict = verify(these)
        assert verdict.same, verdict.first_reason
        assert verdict.frames == frames


def test_sessions_that_lost_the_thickness_differ(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paths = _recorded(tmp_path)
    read = State.from_bytes

    def forgetful(data: bytes) -> State:
        state = read(data)
        state.memory.pop(KEY, None)
        return state

    monkeypatch.setattr(State, "from_bytes", forgetful)
    assert not verify(paths[1:]).same


def test_the_certificate_covers_recovering_contacts(tmp_path: Path) -> None:
    verdict, certificate = certify(
        _recorded(tmp_path, **{"table.friction": [0.0, 0.0], "tolerance": 1e-4}), every_sample=True
    )
    assert verdict.same
    assert certificate.is_satisfied
    # An independent integrator checks every frame.
    assert len(certificate.samples) == 14
    assert max(sample.difference for sample in certificate.samples) < 1e-6
