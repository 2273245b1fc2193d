# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Commands without a graph: stamps, the event queue, the throttled log and gripper scripts."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.line_log import LineLog

from cloth_sim_ros import Grasp, Reset, Scene, SetParameters, Simulation, Target
from cloth_sim_ros.physics.integrators.base import UnstableError
from cloth_sim_ros.ros.io.stamps import OldStampError, StampError, StampGate, to_ros_time
from cloth_sim_ros.ros.reporting.log import ThrottledLog
from cloth_sim_ros.ros.timing.event_queue import MAX_QUEUED_EVENTS, EventQueue, EventResult, QueueFullError
from cloth_sim_ros.ros.timing.stepper import Stepper
from cloth_sim_ros.simulation.events import Event, Move, Pause, Step
from cloth_sim_ros.simulation.frame import Frame
from cloth_sim_ros.simulation.gripper_script import GripperScript, ScriptError

SECOND = 1_000_000_000
NOW = 1000 * SECOND


def run_frame(stepper: Stepper) -> Frame:
    """Compute a frame with the waiting events, and answer them."""
    frame = stepper.advance(0)
    assert frame is not None
    stepper.answer()
    return frame


def test_stamps() -> None:
    gate = StampGate()
    assert gate.accept(0, NOW) == NOW
    assert gate.accept(NOW + SECOND, NOW) == NOW + SECOND
    with pytest.raises(OldStampError, match=r"1\.000 s older"):
        gate.accept(0, NOW)
    assert gate.accept(NOW + SECOND, NOW + 5) == NOW + SECOND, "repeated, not older"
    with pytest.raises(StampError, match=r"1\.000 s ahead"):
        gate.accept(NOW + SECOND + 6, NOW + 5)
    # After a second of silence an older stamp is accepted: a bag is played again.
    assert gate.accept(7, NOW + SECOND + 5) == 7
    gate.reset()
    assert gate.accept(3, NOW) == 3


def test_queue_returns_due_events() -> None:
    queue = EventQueue()
    late, early = Target("g", (2.0, 0, 0)), Target("g", (1.0, 0, 0))
    queue.put(late, stamp=20)
    queue.put(early, stamp=10)
    queue.put(Grasp("g", True))
    assert [entry.event for entry in queue.pop_ready(9)] == [Grasp("g", True)]
    assert [entry.event for entry in queue.pop_ready(25)] == [early, late]
    assert queue.pop_ready(99) == []


def test_targets_due_after_a_set_back_time_are_dropped() -> None:
    queue = EventQueue()
    early, late = Target("g", (1.0, 0, 0)), Target("g", (2.0, 0, 0))
    queue.put(early, stamp=10)
    queue.put(late, stamp=90)
    queue.put(Grasp("g", True))
    queue.drop_later(20)
    assert [entry.event for entry in queue.pop_ready(99)] == [Grasp("g", True), early]


def test_each_step_is_a_frame() -> None:
    simulation, queue = Simulation(Scene.from_parameters({"cloth.resolution": (5, 5)})), EventQueue()
    stepper, results = Stepper(simulation, queue), list[EventResult]()
    queue.put(Pause(True))
    run_frame(stepper)
    begun = simulation.frame
    for event in (Step(), Grasp("gripper", True), Step(), Step()):
        queue.put(event, answer=results.append)
    assert run_frame(stepper).events == (Grasp("gripper", True), Step())
    run_frame(stepper)
    run_frame(stepper)
    assert simulation.frame == begun + 3
    assert [outcome.frame.index for outcome in results if outcome.frame] == [begun + k for k in (1, 1, 2, 3)]
    run_frame(stepper)
    assert simulation.frame == begun + 3


def test_queue_is_bounded() -> None:
    queue = EventQueue()
    for index in range(MAX_QUEUED_EVENTS + 10):
        queue.put(Target("g", (float(index), 0, 0)))
    assert len(queue) == MAX_QUEUED_EVENTS
    events = [entry.event for entry in queue.pop_ready(0)]
    assert events[-1] == Target("g", (MAX_QUEUED_EVENTS + 9.0, 0, 0))
    for _ in range(MAX_QUEUED_EVENTS):
        queue.put(Grasp("g", True))
    # Only a node on simulated time has a clock that can stand.
    with pytest.raises(QueueFullError, match="send fewer, and look in /diagnostics if frames go on"):
        queue.put(Reset())


def test_log_is_throttled_by_kind_and_counts_omissions() -> None:
    log, now = LineLog(), [0.0]
    throttled = ThrottledLog(log, seconds=1.0, clock=lambda: now[0])
    for index in range(100):
        now[0] = index * 0.015
        throttled.warn("a", f"a{index}")
    throttled.warn("b", "b")
    assert log.lines == ["a0", "a67 (66 more of this kind since the last message)", "b"]


def test_queued_grasps_are_answered_after_their_frame() -> None:
    simulation = Simulation(Scene.from_parameters({"cloth.resolution": (5, 5)}))
    queue = EventQueue()
    stepper = Stepper(simulation, queue)
    results: list[EventResult] = []
    queue.put(Grasp("gripper", True), answer=results.append)
    queue.put(Target("gripper", (0.5, 0.0, 0.5)))
    queue.put(Grasp("gripper", False), answer=results.append)
    run_frame(stepper)
    assert [(outcome.grasp.closed, outcome.grasp.grasped_count) for outcome in results if outcome.grasp] == [
        (True, 1),
        (False, 0),
    ]


def test_unstable_motion_stops_time_and_keeps_the_commands(monkeypatch: pytest.MonkeyPatch) -> None:
    simulation = Simulation(Scene.from_parameters({"cloth.resolution": (5, 5)}))
    queue = EventQueue()
    stepper = Stepper(simulation, queue)
    before = simulation.positions

    def fail(*_: Any) -> None:
        raise UnstableError("the motion became non-finite")

    with monkeypatch.context() as patch:
        patch.setattr(simulation, "_advance_time", fail)
        queue.put(Target("gripper", (0.5, 0.0, 0.5)))
        frame = run_frame(stepper)
    assert not frame.moved
    assert simulation.paused
    assert stepper.trouble == "the motion became non-finite"
    assert Target("gripper", (0.5, 0.0, 0.5)) in frame.events
    np.testing.assert_array_equal(simulation.positions, before)


@pytest.mark.parametrize("event", [Step(), Pause(False)], ids=["step", "go on"])
def test_stopped_time_is_answered_with_the_reason(monkeypatch: pytest.MonkeyPatch, event: Event) -> None:
    simulation = Simulation(Scene.from_parameters({"cloth.resolution": (5, 5)}))
    queue = EventQueue()
    stepper = Stepper(simulation, queue)
    results: list[EventResult] = []

    def fail(*_: Any) -> None:
        raise UnstableError("the motion became non-finite")

    with monkeypatch.context() as patch:
        patch.setattr(simulation, "_advance_time", fail)
        run_frame(stepper)
        # The node must survive any number of such requests.
        for _ in range(2):
            queue.put(event, answer=results.append)
            queue.put(Grasp("gripper", True), answer=results.append)
            frame = run_frame(stepper)
            assert not frame.moved
            assert simulation.paused
            assert stepper.trouble == "the motion became non-finite"
    reasons = [(outcome.frame is None, outcome.reason) for outcome in results if outcome.grasp is None]
    assert reasons == [(True, "time is stopped: the motion became non-finite")] * 2
    assert sum(outcome.grasp is not None for outcome in results) == 2
    queue.put(event, answer=results.append)
    assert run_frame(stepper).moved
    assert stepper.trouble == ""
    assert results[-1].frame is not None


def test_refused_parameters_leave_other_events_in_effect() -> None:
    simulation = Simulation(Scene.from_parameters({"cloth.resolution": (5, 5)}))
    queue = EventQueue()
    stepper = Stepper(simulation, queue)
    queue.put(SetParameters({"step": 0.5}))
    queue.put(Target("gripper", (0.5, 0.0, 0.5)))
    frame = run_frame(stepper)
    assert "stability limit" in stepper.refused_parameters
    assert frame.moved
    assert simulation.scene.step == 0.0
    assert simulation.grippers.is_placed(0)


def test_parameters_stay_if_another_event_is_refused() -> None:
    stepper = Stepper(Simulation(Scene.from_parameters({"cloth.resolution": (5, 5)})), EventQueue())
    results: list[EventResult] = []
    stepper.queue.put(SetParameters({"air.drag": 1.5}), answer=results.append)
    stepper.queue.put(Move("ball", (0.0, 0.0, 0.0)), answer=results.append)
    assert run_frame(stepper).moved
    assert [outcome.reason for outcome in results] == ["", "there is no obstacle 'ball'; this cloth has none"]
    assert stepper.refused_parameters == ""
    assert stepper.simulation.scene.air.drag == 1.5


def test_bad_parameters_and_unstable_motion_in_one_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    simulation = Simulation(Scene.from_parameters({"cloth.resolution": (5, 5)}))
    queue = EventQueue()
    stepper = Stepper(simulation, queue)
    # private: counts how often time moves
    move = simulation._advance_time

    def fail() -> Any:
        if simulation.scene.step:
            return move()
        raise UnstableError("the motion became non-finite")

    monkeypatch.setattr(simulation, "_advance_time", fail)
    queue.put(SetParameters({"step": 0.5}))
    assert not run_frame(stepper).moved
    assert "stability limit" in stepper.refused_parameters
    assert stepper.trouble == "the motion became non-finite"
    assert simulation.paused


@pytest.mark.parametrize(
    ("sec", "nanosec", "reason"),
    [(-5, 0, "-5 s and 0 ns; a time is not negative"), (5, 4_000_000_000, "nanoseconds are below 1000000000")],
)
def test_invalid_stamps_are_refused(sec: int, nanosec: int, reason: str) -> None:
    assert to_ros_time(0, 0) == 0
    assert to_ros_time(5, 999_999_999) == 6 * SECOND - 1
    with pytest.raises(StampError, match=reason):
        to_ros_time(sec, nanosec)


def script(*steps: dict[str, Any], **entries: Any) -> dict[str, Any]:
    return {"steps": list(steps), **entries}


def test_script_moves_smoothly_and_rests_in_each_waypoint() -> None:
    path = GripperScript.from_dict(
        script(
            {"time": 1.0, "position": [0, 0, 0]},
            {"time": 2.0, "position": [1.0, 0, 0], "orientation": [0, 0, 1.0, 0]},
            {"time": 2.5, "close": True},
        )
    )
    assert path.duration == 2.5
    assert path.pose(0.0) == path.pose(1.0) == ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    position, orientation = path.pose(1.5)
    assert position == pytest.approx((0.5, 0.0, 0.0))
    assert np.abs(orientation) == pytest.approx((0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)))
    times = np.linspace(0.9, 2.1, 1201)
    x = np.array([path.pose(time)[0][0] for time in times])
    speed = np.diff(x) / np.diff(times)
    assert np.max(np.abs(np.diff(speed))) < 0.01, "no jump of the velocity"
    assert path.pose(9.0)[0] == (1.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "script is None"),
        ({}, "no 'steps'"),
        (script(), "at least one step"),
        (script({"time": 0.0}), "neither position nor close"),
        (script({"time": 0.0, "position": [0, 0]}), "list of 3 numbers"),
        (script({"time": 0.0, "position": [0, 0, float("nan")]}), "finite"),
        (script({"time": 0.0, "position": [0, 0, 0], "orientation": [0, 0, 0, 0]}), "no quaternion"),
        (script({"time": 1.0, "position": [0, 0, 0]}, {"time": 0.5, "close": True}), "nor go back"),
        (script({"time": 1.0, "position": [0, 0, 0]}, {"time": 1.0, "position": [1, 0, 0]}), "one place at a time"),
        (script({"time": 0.0, "positon": [0, 0, 0]}), "unknown entry 'positon'"),
        (script({"time": 0.0, "close": True}), "no step has a position"),
        (script({"time": 0.0, "position": [0, 0, 0], "close": 1}), "true or false"),
        (script({"time": 0.0, "position": [0, 0, 0]}, rate=0.0), "rate is 0.0 Hz"),
        (script({"time": 0.0, "position": [0, 0, 0]}, frame_id=None), "frame_id is None; it must be a text"),
        (script({"time": 0.0, "position": [0, 0, 0]}, gripper=False), "gripper is False; it must be a text"),
    ],
)
def test_senseless_scripts_are_refused(content: Any, message: str) -> None:
    with pytest.raises(ScriptError, match=message):
        GripperScript.from_dict(content)
