# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Class Simulation: frames, order of events, and reproducible bits."""

import json

import numpy as np
import pytest

from cloth_sim_ros.physics.control.automatic import INTEGRATORS
from cloth_sim_ros.physics.integrators.base import UnstableError
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.event_checks import EventError
from cloth_sim_ros.simulation.events import (
    Grasp,
    MoveObstacles,
    Pause,
    Reset,
    SetParameters,
    Step,
    Target,
    from_dict,
    ordered,
    to_dict,
)
from cloth_sim_ros.simulation.simulation import Simulation


def small(**values):
    named = {name.replace("__", "."): value for name, value in values.items()}
    return Scene.from_parameters({"cloth.resolution": [8, 9], "grippers": ["left", "right"], **named})


def corner(simulation):
    return simulation.positions[-1]


def script(simulation, frames, seed=0):
    """Random but reproducible events for a number of frames."""
    rng = np.random.default_rng(seed)
    low = corner(simulation)
    for k in range(frames):
        events = [Target("left", low + 0.02 * k * rng.standard_normal(3), rng.standard_normal(4))]
        if k % 5 == 1:
            events.append(Grasp("left", k % 10 == 1))
        if k % 7 == 3:
            events.append(SetParameters({"gravity": [0.0, 0.1 * k, -9.81]}))
        if k % 11 == 10:
            events.append(Reset())
        yield events


def test_time_is_an_integer_times_the_period():
    simulation = Simulation(small())
    for _ in range(7):
        frame = simulation.advance()
    assert (frame.index, simulation.frame) == (7, 7)
    assert frame.time == 7 * (1 / 60.0)


def test_run_repeats_and_continues_from_snapshot_bit_for_bit():
    first, second = Simulation(small()), Simulation(small())
    events = list(script(first, 24))
    digests = []
    for k, batch in enumerate(events):
        first.advance(batch)
        second.advance(batch)
        digests.append(first.state.digest())
        assert second.state.digest() == digests[-1]
        if k == 9:
            snapshot, scene = first.state.to_bytes(), first.scene
    assert len(set(digests)) == len(digests)
    resumed = Simulation(scene, State.from_bytes(snapshot))
    for batch, digest in zip(events[10:], digests[10:], strict=True):
        resumed.advance(batch)
        assert resumed.state.digest() == digest


def test_events_survive_their_text_form_to_the_last_bit():
    simulation = Simulation(small())
    for batch in script(simulation, 12):
        for event in batch:
            assert from_dict(json.loads(json.dumps(to_dict(event)))) == event
    for event in (Pause(True), Step(), Reset(), Grasp("left", False)):
        assert from_dict(to_dict(event)) == event
    with pytest.raises(ValueError, match="unknown kind 'explode'"):
        from_dict({"kind": "explode"})
    with pytest.raises(ValueError, match="does not fit 'grasp'"):
        from_dict({"kind": "grasp", "gripper": "left", "force": 3})


def test_events_are_ordered_targets_then_grasps_then_others():
    old_target, new_target, other_target = Target("b", (0, 0, 0)), Target("b", (1, 0, 0)), Target("a", (2, 0, 0))
    close, release = Grasp("b", True), Grasp("b", False)
    assert ordered([Pause(True), close, old_target, release, other_target, new_target]) == [
        other_target,
        new_target,
        close,
        release,
        Pause(True),
    ]


def test_reading_a_simulation_changes_no_bit():
    watched, plain = Simulation(small()), Simulation(small())
    for batch in script(watched, 12):
        frame = watched.advance(batch)
        watched.energy(), watched.state.digest(), watched.positions, frame.wrenches.sum()
        plain.advance(batch)
    assert watched.state.digest() == plain.state.digest()


def test_grasped_corner_follows_gripper_and_falls_when_released():
    simulation = Simulation(small(gripper__radius=0.08))
    start = corner(simulation)
    grasp = simulation.advance([Target("left", start), Grasp("left", True)]).grasps[0]
    assert (grasp.grasped_count, grasp.reason) == (1, "")
    lift = np.array([-0.1, 0.3, 0.2])
    for k in range(1, 61):
        frame = simulation.advance([Target("left", start + lift * k / 60)])
        assert np.linalg.norm(corner(simulation) - start - lift * k / 60) < 0.02
    assert frame.wrenches[0, 2] < 0.0, "the cloth pulls the gripper down"
    assert not frame.wrenches[1].any()
    height = corner(simulation)[2]
    simulation.advance([Grasp("left", False)])
    for _ in range(20):
        frame = simulation.advance()
    assert corner(simulation)[2] < height - 0.1
    assert not frame.wrenches.any()


def test_gripper_rotates_grasped_particles():
    simulation = Simulation(small(gripper__radius=0.16, gravity=[0.0, 0.0, 0.0]))
    start = corner(simulation)
    simulation.advance([Target("left", start), Grasp("left", True)])
    held = simulation.grippers.grasped_particles(0)
    assert len(held) >= 3
    offsets = simulation.positions[held] - start
    for k in range(1, 121):
        angle = 0.5 * np.pi * min(1.0, k / 60)
        simulation.advance([Target("left", start, (0.0, 0.0, np.sin(angle / 2), np.cos(angle / 2)))])
    turned = offsets @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert simulation.positions[held] - start == pytest.approx(turned, abs=0.02)


def test_closing_reports_grasped_particles_or_the_reason():
    simulation = Simulation(small())
    nowhere, _ = simulation.advance([Grasp("left", True), Grasp("right", False)]).grasps
    assert (nowhere.grasped_count, "nowhere" in nowhere.reason) == (0, True)
    far_grasp = simulation.advance([Grasp("left", False), Target("left", (5.0, 0, 0)), Grasp("left", True)]).grasps[1]
    assert (far_grasp.grasped_count, "no particle within 0.05 m" in far_grasp.reason) == (0, True)
    again = simulation.advance([Grasp("left", True)]).grasps[0]
    assert "closed already" in again.reason
    top = simulation.advance([Target("right", simulation.positions[0]), Grasp("right", True)]).grasps[0]
    assert (top.grasped_count, "anchored" in top.reason) == (0, True)


def test_two_grippers_hold_one_particle():
    simulation = Simulation(small())
    start = corner(simulation)
    both = [Target("left", start), Target("right", start), Grasp("left", True), Grasp("right", True)]
    assert [grasp.grasped_count for grasp in simulation.advance(both).grasps] == [1, 1]
    for _ in range(60):
        simulation.advance(
            [Target("left", start - np.array([0.1, 0, 0])), Target("right", start + np.array([0.1, 0, 0]))]
        )
    assert corner(simulation)[:1] == pytest.approx(start[:1], abs=0.02)
    simulation.advance([Grasp("left", False)])
    for _ in range(30):
        simulation.advance()
    assert corner(simulation)[0] == pytest.approx(start[0] + 0.1, abs=0.02)


def test_while_paused_commands_take_effect_without_time_passing():
    simulation = Simulation(small())
    simulation.advance()
    positions = simulation.positions
    frame = simulation.advance([Pause(True), Target("left", corner(simulation)), Grasp("left", True)])
    assert (frame.index, frame.moved, frame.grasps[0].grasped_count) == (1, False, 1)
    assert np.array_equal(simulation.positions, positions)
    frame = simulation.advance([Step()])
    assert (frame.index, frame.moved, simulation.paused) == (2, True, True)
    assert simulation.advance([Pause(False)]).index == 3


def test_reset_restores_cloth_and_grippers_not_frame_number():
    simulation = Simulation(small())
    start = simulation.positions
    for batch in script(simulation, 9):
        simulation.advance(batch)
    simulation.advance([Pause(True), Reset()])
    assert np.array_equal(simulation.positions, start)
    assert not simulation.velocities.any()
    assert simulation.frame == 9
    assert not simulation.grippers.is_placed(0)
    assert simulation.grippers.grasped_particles(0).size == 0


@pytest.mark.parametrize(
    ("event", "words"),
    [
        (Target("nobody", (0, 0, 0)), "no gripper 'nobody'; this cloth has left, right"),
        (Target("left", (np.nan, 0, 0)), "3 finite numbers"),
        (Target("left", (0, 0)), "3 finite numbers"),
        (Target("left", (1e9, 0, 0)), "beyond 10000 m"),
        (Target("left", (0, 0, 0), (0, 0, 0, 0)), "no quaternion"),
        ("close", "'close' is no event"),
        (SetParameters({1: 2}), "must be values by full name"),
        (SetParameters({"material.density": -1.0}), "must be at least 1e-09 kg/m"),
        (SetParameters({"cloth.size": [1.0, 1.0]}), "can't change while the cloth runs"),
        (SetParameters({"material.densty": 1.0}), "did you mean 'material.density'"),
    ],
)
def test_refused_event_gives_reason_and_changes_nothing(event, words):
    simulation = Simulation(small())
    simulation.advance()
    before = simulation.state.digest()
    with pytest.raises(EventError, match=words):
        simulation.advance([SetParameters({"gravity": [1.0, 0.0, 0.0]}), Pause(True), event])
    assert simulation.state.digest() == before
    assert simulation.scene == small()
    assert simulation.advance().index == 2


def test_a_state_of_another_cloth_is_refused():
    with pytest.raises(ValueError, match="has 4 particles, the cloth 72"):
        Simulation(small(), State(np.eye(4, 3)))
    other_cloth = Simulation(small(grippers=["one"]))
    with pytest.raises(ValueError, match="has 1 grippers, the scene 2"):
        Simulation(small(), other_cloth.state)
    with pytest.raises(ValueError, match="not a state file"):
        State.from_bytes(b"PK\x03\x04 no such thing")


def test_a_changed_parameter_takes_effect_at_the_next_frame():
    simulation = Simulation(small(cloth__anchors=[""], gravity=[0.0, 0.0, 0.0], air__drag=0.0, wind__normal_drag=0.0))
    simulation.advance()
    assert np.abs(simulation.velocities).max() < 1e-12
    simulation.advance([SetParameters({"gravity": [3.0, 0.0, 0.0]})])
    assert simulation.velocities[:, 0] == pytest.approx(3.0 / 60)


def test_every_bit_of_the_state_is_in_its_digest():
    state = Simulation(small()).state
    digest = state.digest()
    for name, array in state.arrays().items():
        if array.size and name != "frame":
            bits = array.reshape(-1).view(np.uint8)
            bits[-1] ^= 1
            assert state.digest() != digest, name
            bits[-1] ^= 1
    state.frame += 1
    assert state.digest() != digest


def test_a_frame_that_fails_leaves_state_and_scene_as_they_were(monkeypatch):
    simulation = Simulation(small())
    simulation.advance([Target("left", corner(simulation))])
    before, scene = simulation.state.digest(), simulation.scene

    def fail(self, plan, state, *rest):
        state.x = np.full_like(state.x, np.nan)
        raise UnstableError("on purpose")

    monkeypatch.setattr(type(simulation.scene.build_integrator()), "advance", fail)
    with pytest.raises(UnstableError):
        simulation.advance([Grasp("left", True), SetParameters({"air.drag": 3.0})])
    monkeypatch.undo()
    assert simulation.state.digest() == before
    assert simulation.scene is scene
    assert simulation.advance().index == 2


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_frames_replace_state_arrays_and_never_write_them(integrator):
    simulation = Simulation(small(integrator=integrator, tolerance=1e-2))
    for batch in [*script(simulation, 12, seed=4), [Pause(True), Reset()]]:
        held = simulation.state.shallow_copy()
        digest = held.digest()
        simulation.advance(batch)
        assert held.digest() == digest
        assert simulation.state.digest() != digest


def test_steady_targets_give_a_constant_gripper_velocity():
    simulation = Simulation(small())
    for k in range(5):
        simulation.advance([Target("left", (0.01 * k, 0.0, 0.0))])
    assert simulation.state.memory["gripper.twist"][0, :3] == pytest.approx([0.6, 0.0, 0.0])
    simulation.advance()
    assert not simulation.state.memory["gripper.twist"].any(), "without a new target it comes to rest"


def test_energy_balance_closes_and_changes_no_bit():
    watched, plain = Simulation(small(**{"diagnostics.energy": True})), Simulation(small())
    for batch in list(script(watched, 30, seed=2)):
        gripper_events = [event for event in batch if isinstance(event, Target | Grasp)]
        watched.advance(gripper_events)
        plain.advance(gripper_events)
    assert watched.state.digest() == plain.state.digest()
    assert plain.energy_report is None
    report = watched.energy_report
    assert abs(report.work) > 1e-2
    assert report.dissipated > 1e-2
    assert abs(report.residual) < 1e-3 * report.turned_over
    assert report.total == pytest.approx(watched.energy(), rel=1e-9)


def test_numpy_bool_closes_a_gripper():
    simulation = Simulation(small())
    grasp = simulation.advance([Target("left", corner(simulation)), Grasp("left", np.True_)]).grasps[0]
    assert (grasp.closed, grasp.grasped_count) == (True, 1)


def test_fixed_step_above_grip_limit_fails_with_limit():
    simulation = Simulation(small(step=0.9e-3, **{"gripper.stiffness": 1e5}))
    before = simulation.state.digest()
    with pytest.raises(UnstableError, match=r"step 0.0009 s is above the stability limit"):
        simulation.advance([Target("left", corner(simulation)), Grasp("left", True)])
    assert simulation.state.digest() == before


def test_pause_of_any_truth_value_is_a_bool():
    digests = set()
    for paused in (True, 1, np.bool_(True)):
        simulation = Simulation(small())
        simulation.advance([Pause(paused)])
        assert simulation.paused
        assert from_dict(json.loads(json.dumps(to_dict(Pause(paused))))) == Pause(True)
        digests.add(simulation.state.digest())
    assert len(digests) == 1


def test_parameters_of_event_are_plain_and_independent():
    wind = np.array([1.0, 0.0, 0.0])
    values = {"wind.velocity": wind, "air.drag": np.float32(0.5), "gravity": [np.float32(0.5), 0.0, -9.0]}
    event = SetParameters(values)
    text = json.dumps(to_dict(event))
    wind[:] = 5.0
    values["air.drag"] = 2.0
    assert json.dumps(to_dict(event)) == text
    assert from_dict(json.loads(text)) == event


@pytest.mark.parametrize(
    ("arguments", "words"), [(({},), "scene is {}; give a Scene"), ((None, 3), "state is 3; give")]
)
def test_simulation_of_something_else_is_refused(arguments, words):
    scene, *state = arguments
    with pytest.raises(ValueError, match=words):
        Simulation(small() if scene is None else scene, *state)


def test_no_obstacle_moves_in_scene_without_any():
    simulation, reference = Simulation(small()), Simulation(small())
    simulation.advance([MoveObstacles([], np.empty((0, 7)))])
    reference.advance()
    assert simulation.state.digest() == reference.state.digest()


def test_text_commands_no_grasp_and_no_pause():
    # Any text would be true.
    with pytest.raises(ValueError, match="'false' is a text; it must be True or False"):
        Grasp("gripper", "false")
    with pytest.raises(ValueError, match="'no' is a text"):
        Pause("no")
    assert Grasp("gripper", np.bool_(False)).closed is False
