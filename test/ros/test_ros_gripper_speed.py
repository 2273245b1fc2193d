# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Grippers at their speed limit: warnings, and limits that change while the cloth runs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rcl_interfaces.msg import Log as RosLog
from rcl_interfaces.msg import SetParametersResult
from rclpy.exceptions import ParameterNotDeclaredException
from rclpy.parameter import Parameter
from support.clocked_cloth import ClockedCloth
from support.line_log import LineLog
from support.ros_client import Client

from cloth_sim_ros import Grasp, Scene, Simulation, Target
from cloth_sim_ros.ros.reporting.gripper_speed import GripperSpeedMonitor
from cloth_sim_ros.ros.reporting.log import ThrottledLog

CORNER = np.array([0.5, 0.0, 0.5])
TWO = {"grippers": ["left", "right"]}


def sideways(distance: float) -> np.ndarray:
    """A position at a distance [m] from the corner."""
    return np.add(CORNER, (0.0, distance, 0.0))


@pytest.fixture
def client(ros_domain: int) -> Iterator[Client]:
    with Client() as client:
        yield client


def monitored(**values: Any) -> tuple[Simulation, Callable[..., list[str]]]:
    """A cloth with a grasped corner for each gripper, and the log of a frame with a target for each."""
    cloth = Simulation(Scene.from_parameters({"cloth.resolution": [5, 5], **values}))
    names = cloth.scene.gripper_names
    log = LineLog()
    monitor = GripperSpeedMonitor(cloth, ThrottledLog(log, seconds=0.0))
    cloth.advance([Target(name, tuple(CORNER)) for name in names] + [Grasp(name, True) for name in names])

    def follow(**ways: float) -> list[str]:
        before = len(log.lines)
        cloth.advance([Target(name, tuple(sideways(distance))) for name, distance in ways.items()])
        monitor.check()
        return log.lines[before:]

    return cloth, follow


def test_speed_limit_is_warned_of_once() -> None:
    _, follow = monitored()
    assert follow(gripper=0.1) == []
    assert follow(gripper=1.1) == [
        "'gripper' follows its target at 10 m/s, gripper.max_speed: the target asks for 60 m/s; send targets that are "
        "nearer to each other, or raise gripper.max_speed"
    ]
    for _ in range(4):
        assert follow(gripper=1.1) == []
    # It has arrived; another jump is warned of again.
    assert follow(gripper=1.1) == []
    assert len(follow(gripper=0.1)) == 1


def test_each_gripper_names_its_own_limit() -> None:
    _, follow = monitored(**TWO, **{"left.max_speed": 2.0})
    lines = follow(left=0.1, right=0.1)
    assert len(lines) == 1
    assert lines[0].startswith("'left' follows its target at 2 m/s, left.max_speed: the target asks for 6 m/s;")
    assert [line.split()[0] for line in follow(left=0.1, right=1.0)] == ["'right'"]


def test_pad_speed_limit_names_no_parameter() -> None:
    scene = Scene.from_parameters(
        {"cloth.resolution": [5, 5], "gripper.mode": "pinch", "contact.thickness": 0.005, "gripper.max_speed": 0.0}
    )
    cloth, log = Simulation(scene), LineLog()
    monitor = GripperSpeedMonitor(cloth, ThrottledLog(log))
    cloth.advance([Target("gripper", (0.0, 1.0, 1.0))])
    cloth.advance([Target("gripper", (0.0, 2.0, 1.0))])
    monitor.check()
    assert log.lines[0].startswith("'gripper' follows its target at 10 m/s, the limit of pads: the target asks for 60")
    assert log.lines[0].endswith("send targets that are nearer to each other")


def set_one(cloth: ClockedCloth, name: str, value: Any) -> SetParametersResult:
    result: SetParametersResult = cloth.node.node.set_parameters_atomically([Parameter(name, value=value)])
    return result


def test_a_wrong_target_is_followed_at_the_limit_and_warned_of(client: Client) -> None:
    lines: list[str] = []
    client.node.create_subscription(RosLog, "/rosout", lambda message: lines.append(message.msg), 100)
    with ClockedCloth(client) as cloth:
        cloth.target("gripper", CORNER)
        cloth.grasp("gripper", True)
        cloth.tick(2)
        assert cloth.held("gripper")
        cloth.target("gripper", sideways(1.0))
        cloth.tick()
        assert np.linalg.norm(cloth.position("gripper") - CORNER) == pytest.approx(10.0 / 60.0)
        client.spin_until(lambda: any("gripper.max_speed" in line for line in lines), description="the warning")
        assert set_one(cloth, "gripper.max_speed", 0.0).successful
        cloth.tick()
        assert cloth.position("gripper") == pytest.approx(sideways(1.0))


def test_node_records_pose_of_limited_gripper(client: Client, tmp_path: Path) -> None:
    pytest.importorskip("mcap")
    from cloth_sim_ros.session.reader import SessionReader
    from cloth_sim_ros.verify.run import verify

    with ClockedCloth(client, {"record.enabled": True, "record.folder": str(tmp_path)}) as cloth:
        cloth.target("gripper", CORNER)
        cloth.grasp("gripper", True)
        cloth.tick(2)
        cloth.target("gripper", sideways(0.3))
        cloth.tick(3)
        frame = cloth.simulation.frame
        assert cloth.position("gripper") == pytest.approx(sideways(0.3))
    (path,) = tmp_path.glob("*.mcap")
    with SessionReader(path) as reader:
        frames = {shown.frame.frame: shown.frame for shown in reader.clouds() if shown.frame is not None}
    poses = [frames[k].extras.get("poses") for k in (frame - 2, frame - 1, frame)]
    assert poses[0]["gripper"] == pytest.approx([*sideways(10.0 / 60.0), 0.0, 0.0, 0.0, 1.0])
    assert poses[1:] == [None, None]
    verdict = verify([path])
    assert verdict.same, verdict.first_reason


def test_one_grippers_limit_is_set_while_the_cloth_runs(client: Client) -> None:
    with ClockedCloth(client, TWO) as cloth:
        refused = set_one(cloth, "left.max_speed", -1.0)
        assert not refused.successful
        assert not cloth.node.node.has_parameter("left.max_speed")
        assert set_one(cloth, "left.max_speed", 1.5).successful
        assert (
            set_one(cloth, "left.frame", "tcp").reason
            == "left.frame can't change while the cloth runs; set it at start"
        )
        with pytest.raises(ParameterNotDeclaredException, match=r"no parameter 'ball\.max_speed'"):
            set_one(cloth, "ball.max_speed", 1.0)
        for name in ("left", "right"):
            cloth.target(name, CORNER)
            cloth.grasp(name, True)
        cloth.tick(2)
        for name in ("left", "right"):
            cloth.target(name, sideways(0.1))
        cloth.tick()
        assert cloth.position("left")[1] == pytest.approx(1.5 / 60.0)
        assert cloth.position("right")[1] == pytest.approx(0.1)
        assert set_one(cloth, "left.max_speed", 3.0).successful
        assert cloth.node.node.get_parameter("left.max_speed").value == 3.0


def test_individual_gripper_frame_is_a_parameter(client: Client) -> None:
    lines: list[str] = []
    client.node.create_subscription(RosLog, "/rosout", lambda message: lines.append(message.msg), 100)
    values = {**TWO, "left.frame": "left_tcp", "obstacles": ["ball"], "ball.shape": "sphere", "ball.size": [0.1]}
    with ClockedCloth(client, {**values, "ball.position": [0.0, 2.0, 0.0]}) as cloth:
        assert cloth.node.node.get_parameter("left.frame").value == "left_tcp"
        cloth.tick()
        client.spin_until(lambda: any("left_tcp" in line for line in lines), description="words on the frame")
    assert not [line for line in lines if "no parameter" in line]
