# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Gripper action: goals, feedback and results in simulated time, as gripper controllers and MoveIt have them."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient
from rclpy.parameter import Parameter
from std_msgs.msg import Bool
from std_srvs.srv import SetBool, Trigger
from support.clocked_cloth import ClockedCloth
from support.interface_packages import CONTROL_MSGS, build_package
from support.ros_client import Client

from cloth_sim_ros.ros.node import ClothNode
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
ASIDE = np.array([0.6, 0.0, 0.0])


@pytest.fixture(scope="session")
def control_msgs() -> Iterator[Any]:
    """The action types of control_msgs: installed ones, or built ones."""
    folder, reason = None, ""
    try:
        types = importlib.import_module("control_msgs.action")
    except ImportError:
        folder, reason = build_package("control_msgs", CONTROL_MSGS)
        if folder is None:
            pytest.skip(reason)
        sys.path.append(str(folder))
        types = importlib.import_module("control_msgs.action")
    yield types
    if folder is not None:
        sys.path.remove(str(folder))
        for name in [name for name in sys.modules if name.partition(".")[0] == "control_msgs"]:
            del sys.modules[name]


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

    def goal(self, position: float, effort: float = 0.0, **fields: Any) -> Any:
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

    def run(self, position: float, effort: float = 0.0, **fields: Any) -> tuple[int, Any, int]:
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
        placed(cloth, ASIDE)
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
