# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Messages written as bytes: rclpy deserializes the intended fields."""

from __future__ import annotations

import numpy as np
import pytest
from geometry_msgs.msg import WrenchStamped
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import PointCloud2
from shape_msgs.msg import Mesh
from visualization_msgs.msg import Marker

from cloth_sim_ros.ros.io.messages import CloudMessage, SurfaceMarker, mesh_bytes, wrench_message
from cloth_sim_ros.session.messages import CloudEncoder

STAMP = 12_345_678_901
X = np.arange(18.0).reshape(3, 6) / 7.0
TRIANGLES = np.array([[0, 1, 3], [1, 4, 3], [1, 2, 4], [2, 5, 4]])


@pytest.mark.parametrize("frame_id", ["w", "wo", "wor", "worl", "world"])
def test_cloud(frame_id: str) -> None:
    cloud = CloudMessage(frame_id=frame_id, height=2, width=3)
    cloud.serialize(X + 1.0, 1)
    data = cloud.serialize(X, STAMP)
    message = deserialize_message(data, PointCloud2)
    assert (message.header.frame_id, message.header.stamp.sec, message.header.stamp.nanosec) == (
        frame_id, 12, 345_678_901,
    )  # fmt: skip
    assert (message.height, message.width, message.point_step, message.row_step) == (2, 3, 12, 36)
    assert [(field.name, field.offset, field.datatype) for field in message.fields] == [
        ("x", 0, 7), ("y", 4, 7), ("z", 8, 7),
    ]  # fmt: skip
    assert message.is_dense
    assert len(data) % 4 == 0
    points = np.frombuffer(bytes(message.data), "<f4").reshape(-1, 3)
    np.testing.assert_array_equal(points, X.T.astype(np.float32))


def test_cloud_with_velocities() -> None:
    cloud = CloudMessage(frame_id="world", height=2, width=3, velocity=True)
    message = deserialize_message(cloud.serialize(X, STAMP, X - 1.0), PointCloud2)
    assert (message.point_step, message.row_step) == (24, 72)
    assert [(field.name, field.offset, field.datatype) for field in message.fields[3:]] == [
        ("vx", 12, 7), ("vy", 16, 7), ("vz", 20, 7),
    ]  # fmt: skip
    points = np.frombuffer(bytes(message.data), "<f4").reshape(-1, 6)
    np.testing.assert_array_equal(points, np.concatenate([X.T, X.T - 1.0], axis=1).astype(np.float32))


@pytest.mark.parametrize("double", [False, True])
def test_cloud_is_that_of_the_encoder_without_ros(double: bool) -> None:
    fields = {"velocity": True, "normal": True, "ids": True, "double": double}
    expected = CloudEncoder(frame_id="world", height=2, width=3, **fields).encode(X, STAMP, X - 1.0, X + 1.0)
    cloud = CloudMessage(frame_id="world", height=2, width=3, **fields)
    data = cloud.serialize(X, STAMP, X - 1.0, X + 1.0)
    assert len(data) == len(expected)
    assert deserialize_message(data, PointCloud2) == deserialize_message(expected, PointCloud2)


def test_cloud_in_double_precision() -> None:
    cloud = CloudMessage(frame_id="world", height=2, width=3, velocity=True, double=True)
    message = deserialize_message(cloud.serialize(X, STAMP, X - 1.0), PointCloud2)
    assert (message.point_step, message.row_step) == (48, 144)
    assert [(field.name, field.offset, field.datatype) for field in message.fields] == [
        ("x", 0, 8), ("y", 8, 8), ("z", 16, 8), ("vx", 24, 8), ("vy", 32, 8), ("vz", 40, 8),
    ]  # fmt: skip
    points = np.frombuffer(bytes(message.data), "<f8").reshape(-1, 6)
    np.testing.assert_array_equal(points, np.concatenate([X.T, X.T - 1.0], axis=1))


@pytest.mark.parametrize("count", [0, 1, 2, 4])
def test_topology(count: int) -> None:
    message = deserialize_message(mesh_bytes(TRIANGLES[:count], X.T), Mesh)
    assert [list(triangle.vertex_indices) for triangle in message.triangles] == TRIANGLES[:count].tolist()
    assert [(p.x, p.y, p.z) for p in message.vertices] == [tuple(p) for p in X.T]


@pytest.mark.parametrize("name", ["/a", "/ab", "/abc", "/abcd"])
@pytest.mark.parametrize("frame_id", ["w", "wo", "wor", "worl"])
def test_marker(name: str, frame_id: str) -> None:
    marker = SurfaceMarker(frame_id=frame_id, name=name, triangles=TRIANGLES)
    message = deserialize_message(marker.serialize(X, STAMP), Marker)
    assert (message.ns, message.header.frame_id, message.header.stamp.sec) == (name, frame_id, 12)
    assert message.type == Marker.TRIANGLE_LIST
    assert (message.scale.x, message.pose.orientation.w, message.color.a) == (1.0, 1.0, 1.0)
    assert message.frame_locked
    assert [(p.x, p.y, p.z) for p in message.points] == [tuple(p) for p in X.T[TRIANGLES.ravel()]]
    assert (len(message.colors), message.text, message.mesh_resource) == (0, "", "")


def test_wrench() -> None:
    data = wrench_message([1, 2, 3, 4, 5, 6], frame_id="world", stamp=STAMP)
    message = deserialize_message(data, WrenchStamped)
    assert (message.wrench.force.y, message.wrench.torque.z, message.header.stamp.nanosec) == (2.0, 6.0, 345_678_901)
