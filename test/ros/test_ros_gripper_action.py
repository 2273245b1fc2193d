# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Gripper action: goals, feedback and results in simulated time, as gripper controllers and MoveIt have them."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient
from std_srvs.srv import SetBool, Trigger
from support.clocked_cloth import ClockedCloth
from support.interface_packages import importable
from support.ros_client import Client

from cloth_sim_ros.simulation.events import Pause
from cloth_sim_ros.verify.run import verify

ACTION = "/cloth_sim/gripper/gripper_cmd"
#: A sheet of which the pads just hold a corner.
PINCH: dict[str, Any] = {
    "gripper.mode": "pinch",
    "gripper.pad_size": [0.15, 0.02, 0.15],
    "gripper.opening": 0.02,
    "gripper.force": 2.0,
    "gripper.action": "GripperCommand",
    "cloth.resolution": [6, 6],
    "cloth.size": [0.3, 0.3],
    "cloth.position": [0.0, 0.0, 0.15],
    "tolerance": 1e-3,
}
PARALLEL = {**PINCH, "gripper.action": "ParallelGripperCommand"}
CORNER = np.array([0.15, 0.0, 0.0])
FAR_AWAY = np.array([0.6, 0.0, 0.0])


@pytest.fixture(scope="session")
def control_msgs() -> Iterator[Any]:
    """The action types of control_msgs: installed ones, or built ones."""
    with importable("control_msgs", "action") as (types,):
        yield types


@pytest.fixture
def client(ros_domain: int) -> Iterator[Client]:
    with Client() as client:
        yield client


class Commander:
    """A client of the action, as MoveIt's controller handle is, on a cloth whose frames the test runs."""

    def __init__(self, client: Client, cloth: ClockedCloth, kind: Any, topic: str = ACTION) -> None:
        self._client, self._cloth = client, cloth
        self._action, self._kind = ActionClient(client.node, kind, topic), kind
        self.feedback: list[Any] = []
        client.spin_until(self._action.server_is_ready, description="the action")

    def goal(self, position: float, effort: float = 0.0, /, **fields: Any) -> Any:
        """Return a goal; `fields` are those of a joint state."""
        goal = self._kind.Goal()
        if hasattr(goal.command, "max_effort"):
            goal.command.position, goal.command.max_effort = position, effort
        else:
            goal.command.position = [position]
            for name, value in fields.items():
                setattr(goal.command, name, value)
        return goal

    def send(self, goal: Any) -> Any:
        """Send a goal; return its handle once it is accepted or rejected."""
        future = self._action.send_goal_async(goal, feedback_callback=lambda m: self.feedback.append(m.feedback))
        self._client.spin_until(future.done, description="an answer to the goal")
        return future.result()

    def finish(self, handle: Any, frames: int = 100) -> tuple[int, Any, int]:
        """Run frames until a goal has ended; return its status, its result and the number of frames."""
        future = handle.get_result_async()
        count = 0
        while not future.done() and count < frames:
            self._cloth.tick()
            count += 1
            for _ in range(6):
                self._client.executor.spin_once(timeout_sec=0.002)
        self._client.spin_until(future.done, description="a result", limit=5.0)
        return future.result().status, future.result().result, count

    def run(self, position: float, effort: float = 0.0, /, **fields: Any) -> tuple[int, Any, int]:
        """Send a goal and run frames until it has ended."""
        handle = self.send(self.goal(position, effort, **fields))
        assert handle.accepted
        return self.finish(handle)

    def close(self) -> None:
        self._action.destroy()


def placed(cloth: ClockedCloth, position: np.ndarray = CORNER) -> None:
    cloth.target("gripper", position)
    cloth.tick()


def test_goal_ends_when_pads_rest_at_position(client: Client, control_msgs: Any) -> None:
    with ClockedCloth(client, PINCH) as cloth:
        placed(cloth, FAR_AWAY)
        commander = Commander(client, cloth, control_msgs.GripperCommand)
        status, result, frames = commander.run(0.01)
        assert (status, result.stalled, result.reached_goal) == (GoalStatus.STATUS_SUCCEEDED, False, True)
        assert result.position == pytest.approx(0.01, abs=5e-4)
        # 5 mm for each pad at 0.05 m/s take 6 frames.
        assert 6 <= frames <= 12
        positions = [feedback.position for feedback in commander.feedback]
        assert positions[0] > positions[-1] > result.position
        status, result, _ = commander.run(0.02)
        assert (status, result.reached_goal, result.position) == (
            GoalStatus.STATUS_SUCCEEDED,
            True,
            pytest.approx(0.02, abs=5e-4),
        )
        status, result, _ = commander.run(0.0, 1.0)
        assert (result.stalled, result.reached_goal, result.effort) == (False, True, pytest.approx(1.0, rel=1e-3))
        commander.close()


def test_goal_stalls_on_cloth(client: Client, control_msgs: Any) -> None:
    with ClockedCloth(client, PINCH) as cloth:
        placed(cloth)
        commander = Commander(client, cloth, control_msgs.GripperCommand)
        status, result, _ = commander.run(0.0)
        assert (status, result.stalled, result.reached_goal) == (GoalStatus.STATUS_SUCCEEDED, True, False)
        assert result.effort == pytest.approx(2.0, rel=1e-3)
        assert cloth.simulation.grasped_count(0) == 4
        commander.close()


def test_joint_range_maps_joint_to_opening(client: Client, control_msgs: Any) -> None:
    # As the knuckle of a 2F-85: 0.8 rad closed, 0 open; MoveIt may command both fingers.
    with ClockedCloth(client, {**PARALLEL, "gripper.joint_range": [0.8, 0.0]}) as cloth:
        placed(cloth, FAR_AWAY)
        commander = Commander(client, cloth, control_msgs.ParallelGripperCommand)
        names = ["left_knuckle", "right_knuckle"]
        status, result, _ = commander.run(0.4, name=names, position=[0.4, 0.4], effort=[1.0, 1.0], velocity=[2.0, 2.0])
        assert (status, result.stalled, result.reached_goal) == (GoalStatus.STATUS_SUCCEEDED, False, True)
        assert list(result.state.name) == names
        assert list(result.state.position) == [pytest.approx(0.4, abs=0.02)] * 2
        assert list(result.state.effort) == [pytest.approx(1.0, rel=1e-3)] * 2
        # 2 rad/s are 25 mm/s for each pad.
        velocities = [feedback.state.velocity[0] for feedback in commander.feedback]
        assert max(velocities) == pytest.approx(2.0, rel=1e-2)
        status, result, _ = commander.run(-0.001)
        assert (result.reached_goal, list(result.state.name)) == (True, ["gripper"])
        commander.close()


def test_attaching_gripper_has_two_positions(client: Client, control_msgs: Any) -> None:
    values = {"gripper.action": "GripperCommand", "gripper.joint_range": [0.0, 0.04], "gripper.radius": 0.1}
    with ClockedCloth(client, values) as cloth:
        commander = Commander(client, cloth, control_msgs.GripperCommand)
        status, result, _ = commander.run(0.0)
        assert (status, result.stalled, result.reached_goal) == (GoalStatus.STATUS_ABORTED, False, False)
        placed(cloth, cloth.simulation.positions[-1])
        commander.run(0.04)
        status, result, frames = commander.run(0.01)
        assert (status, result.stalled, result.reached_goal) == (GoalStatus.STATUS_SUCCEEDED, True, False)
        assert (result.position, frames) == (0.0, 1)
        assert cloth.held("gripper")
        status, result, _ = commander.run(0.03)
        assert (result.stalled, result.reached_goal, result.position) == (False, True, 0.04)
        assert not cloth.held("gripper")
        placed(cloth, np.array([3.0, 0.0, 0.0]))
        status, result, _ = commander.run(0.0)
        assert (result.stalled, result.reached_goal) == (False, True)
        commander.close()


def test_stalled_goal_is_aborted_if_stalling_is_not_allowed(client: Client, control_msgs: Any) -> None:
    with ClockedCloth(client, {**PINCH, "gripper.allow_stalling": False}) as cloth:
        placed(cloth)
        commander = Commander(client, cloth, control_msgs.GripperCommand)
        status, result, _ = commander.run(0.0)
        assert (status, result.stalled, result.reached_goal) == (GoalStatus.STATUS_ABORTED, True, False)
        commander.close()


def test_canceled_goal_stops_pads(client: Client, control_msgs: Any) -> None:
    with ClockedCloth(client, PINCH) as cloth:
        placed(cloth, FAR_AWAY)
        commander = Commander(client, cloth, control_msgs.GripperCommand)
        handle = commander.send(commander.goal(0.0))
        cloth.tick(5)
        future = handle.cancel_goal_async()
        client.spin_until(future.done, description="an answer to the cancellation")
        assert len(future.result().goals_canceling) == 1
        status, result, _ = commander.finish(handle)
        assert (status, result.reached_goal) == (GoalStatus.STATUS_CANCELED, False)
        assert 0.005 < result.position < 0.018
        cloth.tick(10)
        pinching = cloth.simulation.pinching
        assert pinching is not None
        assert pinching.drive_state("gripper")[0] == pytest.approx(result.position, abs=5e-4)
        commander.close()


def test_canceled_goal_leaves_attaching_gripper(client: Client, control_msgs: Any) -> None:
    with ClockedCloth(client, {"gripper.action": "GripperCommand", "gripper.radius": 0.1}) as cloth:
        placed(cloth, cloth.simulation.positions[-1])
        commander = Commander(client, cloth, control_msgs.GripperCommand)
        handle = commander.send(commander.goal(0.0))
        future = handle.cancel_goal_async()
        client.spin_until(future.done, description="an answer to the cancellation")
        status, _, frames = commander.finish(handle)
        assert (status, frames) == (GoalStatus.STATUS_CANCELED, 1)
        assert not cloth.is_closed("gripper")
        assert not cloth.held("gripper")
        # The next goal is taken as any.
        assert commander.run(0.0)[0] == GoalStatus.STATUS_SUCCEEDED
        assert cloth.held("gripper")
        commander.close()


def test_newer_goal_aborts_older_one(client: Client, control_msgs: Any) -> None:
    with ClockedCloth(client, PINCH) as cloth:
        placed(cloth, FAR_AWAY)
        commander = Commander(client, cloth, control_msgs.GripperCommand)
        first = commander.send(commander.goal(0.0))
        cloth.tick(5)
        second = commander.send(commander.goal(0.02))
        assert commander.finish(first)[0] == GoalStatus.STATUS_ABORTED
        status, result, _ = commander.finish(second)
        assert (status, result.reached_goal) == (GoalStatus.STATUS_SUCCEEDED, True)
        assert result.position == pytest.approx(0.02, abs=5e-4)
        commander.close()


def test_other_commands_abort_goal(client: Client, control_msgs: Any) -> None:
    with ClockedCloth(client, PINCH) as cloth:
        placed(cloth, FAR_AWAY)
        commander = Commander(client, cloth, control_msgs.GripperCommand)
        for position, closed in ((0.0, False), (0.02, True)):
            commander.run(0.02 - position)
            handle = commander.send(commander.goal(position))
            cloth.tick(3)
            cloth.grasp("gripper", closed)
            status, result, _ = commander.finish(handle)
            assert (status, result.reached_goal) == (GoalStatus.STATUS_ABORTED, False)
        handle = commander.send(commander.goal(0.01))
        cloth.tick(2)
        client.node.create_client(Trigger, "/cloth_sim/reset").call_async(Trigger.Request())
        client.spin_until(lambda: len(cloth.node.stepper.queue), description="the reset")
        assert commander.finish(handle)[0] == GoalStatus.STATUS_ABORTED
        commander.close()


def test_action_and_service_agree(client: Client, control_msgs: Any) -> None:
    with ClockedCloth(client, PINCH) as cloth:
        placed(cloth)
        commander = Commander(client, cloth, control_msgs.GripperCommand)
        commander.run(0.0)
        assert cloth.is_closed("gripper")
        caller = client.node.create_client(SetBool, "/cloth_sim/gripper/close")
        client.spin_until(caller.service_is_ready, description="the service")
        future = caller.call_async(SetBool.Request(data=True))
        client.spin_until(lambda: len(cloth.node.stepper.queue), description="the event")
        while not future.done():
            cloth.tick()
        assert future.result().message == "holds 4 particles"
        _, result, _ = commander.run(0.02)
        assert result.reached_goal
        assert not cloth.is_closed("gripper")
        commander.close()


@pytest.mark.parametrize("factor", [0.3, 1.0, 3.0])
def test_result_comes_in_simulated_time(client: Client, control_msgs: Any, factor: float) -> None:
    with ClockedCloth(client, PINCH) as cloth:
        placed(cloth)
        commander = Commander(client, cloth, control_msgs.GripperCommand)
        future = commander.send(commander.goal(0.0)).get_result_async()
        begun, rate = cloth.simulation.time, cloth.simulation.scene.rate
        while not future.done():
            cloth.tick()
            end = time.monotonic() + 1.0 / (rate * factor)
            while time.monotonic() < end:
                client.executor.spin_once(timeout_sec=0.002)
        # 20 mm at 0.1 m/s, less the thickness of the cloth, and a frame in transit.
        assert future.result().result.stalled
        assert cloth.simulation.time - begun == pytest.approx(11 / 60, abs=2.5 / 60)
        commander.close()


def test_paused_cloth_delays_result(client: Client, control_msgs: Any) -> None:
    with ClockedCloth(client, PINCH) as cloth:
        placed(cloth, FAR_AWAY)
        commander = Commander(client, cloth, control_msgs.GripperCommand)
        future = commander.send(commander.goal(0.01)).get_result_async()
        cloth.tick(2)
        cloth.node.stepper.queue.put(Pause(True))
        for _ in range(20):
            cloth.publish_clock(cloth.now)
            cloth.tick_index += 1
            client.executor.spin_once(timeout_sec=0.02)
        assert not future.done()
        cloth.node.stepper.queue.put(Pause(False))
        cloth.tick(12)
        client.spin_until(future.done, description="a result")
        assert future.result().result.reached_goal
        commander.close()


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"position": [float("nan")]}, "it has numbers that are not finite"),
        ({"position": [0.03]}, "its position is 0.03; it must be from 0 (closed) to 0.02 (open)"),
        ({"position": []}, "it has no position"),
        ({"position": [0.0, 0.02]}, "its positions [0.0, 0.02] differ"),
    ],
)
def test_impossible_goal_is_rejected_with_reason(
    client: Client, control_msgs: Any, capfd: pytest.CaptureFixture[str], fields: dict[str, Any], words: str
) -> None:
    with ClockedCloth(client, PARALLEL) as cloth:
        placed(cloth, FAR_AWAY)
        commander = Commander(client, cloth, control_msgs.ParallelGripperCommand)
        assert not commander.send(commander.goal(0.0, **fields)).accepted
        cloth.tick(2)
        commander.close()
    assert f"goal for gripper 'gripper' is rejected: {words}" in capfd.readouterr().err


def test_session_with_goals_runs_again_without_control_msgs(
    client: Client, control_msgs: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ClockedCloth(client, {**PINCH, "record.enabled": True, "record.folder": str(tmp_path)}) as cloth:
        placed(cloth)
        commander = Commander(client, cloth, control_msgs.GripperCommand)
        commander.run(0.012)
        commander.run(0.0, 1.5)
        commander.run(0.02)
        commander.close()
    monkeypatch.setitem(sys.modules, "control_msgs.action", None)
    verdict = verify(list(tmp_path.glob("*.mcap")))
    assert (verdict.different, verdict.first_reason) == (0, "")
    assert verdict.frames > 15


def test_missing_control_msgs_is_logged_once(
    client: Client, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "control_msgs.action", None)
    with ClockedCloth(client, PINCH) as cloth:
        cloth.tick(3)
    assert capfd.readouterr().err.count("control_msgs is not installed: no goals are taken for gripper") == 1


def test_actions_are_not_loaded_unless_requested() -> None:
    program = "import sys, cloth_sim_ros.ros.node; sys.exit(any(n.startswith('rclpy.action') for n in sys.modules))"
    subprocess.run([sys.executable, "-c", program], check=True)
