# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Scripts of grippers from bags."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest
from support.bag_maker import BagMessage, write_bag

from cloth_sim_ros.ros.client.gripper_bag import bag_scripts
from cloth_sim_ros.session.cdr import encode, message_class
from cloth_sim_ros.simulation.gripper_script import ScriptError

_POSE, _BOOL = "geometry_msgs/msg/PoseStamped", "std_msgs/msg/Bool"


def pose(topic: str, seconds: float | None, x: float, *, frame: str = "world", w: float = 1.0) -> BagMessage:
    stamp = 0 if seconds is None else 50 * 10**9 + round(seconds * 1e9)
    time = message_class("builtin_interfaces/msg/Time")(sec=stamp // 10**9, nanosec=stamp % 10**9)
    header = message_class("std_msgs/msg/Header")(stamp=time, frame_id=frame)
    position = message_class("geometry_msgs/msg/Point")(x=x, y=0.0, z=1.0)
    orientation = message_class("geometry_msgs/msg/Quaternion")(x=0.0, y=0.0, z=0.0, w=w)
    message = message_class(_POSE)(
        header=header, pose=message_class("geometry_msgs/msg/Pose")(position=position, orientation=orientation)
    )
    return BagMessage(topic, _POSE, encode(message, _POSE))


def grasp(topic: str, closed: bool) -> BagMessage:
    return BagMessage(topic, _BOOL, encode(message_class(_BOOL)(data=closed), _BOOL))


def bag(folder: Path, stream: Sequence[BagMessage]) -> Path:
    return write_bag(folder / "robot.mcap", stream)


def test_grippers_of_a_bag_start_together(tmp_path: Path) -> None:
    path = bag(
        tmp_path,
        [
            pose("/cloth/left/target", 0.0, 0.0),
            pose("/cloth/right/pose", 0.5, 7.0),
            pose("/cloth/left/target", 1.0, 1.0),
            grasp("/cloth/left/grasp", True),
            pose("/cloth/left/target", 3.0, 2.0),
            grasp("/cloth/left/grasp", False),
            grasp("/elsewhere/right/grasp", False),
        ],
    )
    left, right = sorted(bag_scripts(path), key=lambda script: script.gripper)
    assert (left.gripper, right.gripper) == ("left", "right")
    assert left.pose(2.0)[0] == (1.5, 0.0, 1.0)
    # The messages are 1 ns apart: the gripper closes halfway between its poses at 1 s and 3 s, and opens at the last.
    assert [(entry.time, entry.closed) for entry in left.grasps] == [(2.0, True), (3.0, False)]
    assert [(entry.time, entry.closed) for entry in right.grasps] == [(0.5, True)]
    assert right.waypoints[0].time == 0.5
    assert [script.gripper for script in bag_scripts(path, gripper="right")] == ["right"]


def test_topic_of_poses_is_selected(tmp_path: Path) -> None:
    stream = [pose("/arm/tool", 0.0, 0.0), pose("/arm/tool", 1.0, 1.0), pose("/arm/tool", 1.0, 2.0)]
    (script,) = bag_scripts(bag(tmp_path, stream), topic="/arm/tool", gripper="left")
    assert script.gripper == "left"
    # Of two poses with one stamp the last one counts.
    assert script.pose(1.0)[0][0] == 2.0
    assert bag_scripts(tmp_path, topic="/arm/tool")[0].gripper == "gripper"


def test_target_is_preferred_to_measured_pose(tmp_path: Path) -> None:
    path = bag(tmp_path, [pose("/left/pose", 0.0, 0.0), pose("/left/target", 0.0, 5.0)])
    (script,) = bag_scripts(path)
    assert script.pose(0.0)[0][0] == 5.0


def test_pose_without_stamp_has_its_log_time(tmp_path: Path) -> None:
    path = bag(tmp_path, [pose("/left/target", None, 0.0), pose("/left/target", None, 1.0)])
    assert bag_scripts(path)[0].duration == pytest.approx(1e-9)


@pytest.mark.parametrize(
    ("stream", "options", "reason"),
    [
        ([grasp("/left/grasp", True)], {}, r"no topic ends in <gripper>/target \(PoseStamped\).*there are none"),
        ([pose("/arm/tool", 0.0, 0.0)], {}, "select one by --topic; there are /arm/tool"),
        ([pose("/left/pose", 0.0, 0.0)], {"gripper": "right"}, "no topic ends in right/target"),
        ([pose("/left/pose", 0.0, 0.0)], {"topic": "/left"}, r"no topic '/left' of poses.*there are /left/pose"),
        ([pose("/a/left/pose", 0.0, 0.0), pose("/b/left/pose", 0.0, 0.0)], {}, "/a/left/pose, /b/left/pose; select by"),
        ([pose("/left/pose", 0.0, 0.0), pose("/left/pose", 1.0, 0.0, frame="tool")], {}, "several frames: tool, world"),
        ([pose("/left/pose", 0.0, float("nan"))], {}, "/left/pose: poses hold nan"),
        ([pose("/left/pose", 0.0, 0.0, w=0.0)], {}, "/left/pose: the pose at 0 s: orientation"),
        ([BagMessage("/left/pose", _POSE, b"\0\1\0\0rubbish")], {}, "11 bytes are no geometry_msgs/msg/PoseStamped"),
    ],
)
def test_bag_that_cannot_be_played_is_refused(
    tmp_path: Path, stream: Sequence[BagMessage], options: dict[str, str], reason: str
) -> None:
    with pytest.raises(ScriptError, match=f"robot.mcap: .*{reason}"):
        bag_scripts(bag(tmp_path, stream), **options)


def test_missing_bag_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ScriptError, match=r"robot\.mcap does not exist"):
        bag_scripts(tmp_path / "robot.mcap")
    with pytest.raises(ScriptError, match="no bag is in it"):
        bag_scripts(tmp_path)
