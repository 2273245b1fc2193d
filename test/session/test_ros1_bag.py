# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bags of ROS 1."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rosbags")
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

from cloth_sim_ros.session.bag import bag_messages
from cloth_sim_ros.session.cdr import decode
from cloth_sim_ros.session.errors import SessionError

STORE = get_typestore(Stores.ROS1_NOETIC)
BOOL, POSE, CAMERA = "std_msgs/msg/Bool", "geometry_msgs/msg/PoseStamped", "sensor_msgs/msg/CameraInfo"


def pose(x: float, seconds: int) -> Any:
    types = STORE.types
    stamp = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=7)
    header = types["std_msgs/msg/Header"](seq=3, stamp=stamp, frame_id="map")
    position = types["geometry_msgs/msg/Point"](x=x, y=2.0, z=3.0)
    orientation = types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
    body = types["geometry_msgs/msg/Pose"](position=position, orientation=orientation)
    return types[POSE](header=header, pose=body)


def write(path: Path, messages: Sequence[tuple[str, str, int, Any]], unused: Sequence[str] = ()) -> Path:
    with Writer(path) as writer:
        connections = {}
        for topic, kind, log_time, message in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(connections[topic], log_time, STORE.serialize_ros1(message, kind))
        for kind in unused:
            writer.add_connection("/unused", kind, typestore=STORE)
    return path


def test_messages_come_in_the_types_of_ros_2(tmp_path: Path) -> None:
    flag = STORE.types[BOOL](data=True)
    path = write(tmp_path / "a.bag", [("/left/pose", POSE, 10, pose(1.5, 4)), ("/left/grasp", BOOL, 20, flag)])
    messages = [(topic, kind, log_time, decode(data, kind)) for topic, kind, log_time, data in bag_messages(path)]
    assert [entry[:3] for entry in messages] == [("/left/pose", POSE, 10), ("/left/grasp", BOOL, 20)]
    header = messages[0][3].header
    assert (header.stamp.sec, header.stamp.nanosec, header.frame_id) == (4, 7, "map")
    assert messages[0][3].pose.position.x == 1.5
    assert messages[1][3].data is True


def test_types_that_differ_are_left_out(tmp_path: Path) -> None:
    assert list(bag_messages(write(tmp_path / "a.bag", [], unused=[CAMERA]))) == []


def test_damaged_bag_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "a.bag", [("/left/pose", POSE, k, pose(1.5, 4)) for k in range(200)])
    whole = path.read_bytes()
    for size in (0, 5, 100, 5000, len(whole) - 3):
        path.write_bytes(whole[:size])
        with pytest.raises(SessionError, match=r"a\.bag can't be read as a bag of ROS 1"):
            list(bag_messages(path))
    with pytest.raises(SessionError, match="does not exist"):
        list(bag_messages(tmp_path / "b.bag"))


def test_random_damage_causes_no_other_error(tmp_path: Path) -> None:
    import random

    path = write(tmp_path / "a.bag", [("/left/pose", POSE, k, pose(1.5, 4)) for k in range(20)])
    whole, source = path.read_bytes(), random.Random(5)
    for _ in range(100):
        damaged = bytearray(whole)
        for _ in range(source.randint(1, 8)):
            damaged[source.randrange(len(damaged))] = source.randrange(256)
        path.write_bytes(damaged)
        try:
            list(bag_messages(path))
        except SessionError:
            continue
