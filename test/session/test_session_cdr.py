# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""CDR codecs agree with rosbags' generic reader, and with ROS if it is installed."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest
from support import session_samples as samples

from cloth_sim_ros.session import cdr
from cloth_sim_ros.session.channel_description import Qos, describe
from cloth_sim_ros.session.errors import SessionError

# As published with ROS 2 Jazzy (`ros2 topic info -v`, metadata.yaml of its bags).
POINT_CLOUD_HASH = "RIHS01_9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5"


@pytest.mark.parametrize("frame_id", ["", "w", "wo", "wor", "world", "a frame with ünicode"])
@pytest.mark.parametrize("names", [("x", "y", "z"), ("x", "y", "z", "vx", "vy", "vz"), ("intensity", "x", "y", "z")])
def test_cloud_is_what_was_encoded(frame_id: str, names: tuple[str, ...]) -> None:
    values = np.random.default_rng(1).random((17, len(names)), np.float32)
    data = samples.cloud(values, samples.START + 7, frame_id=frame_id, names=names)
    cloud = cdr.decode_cloud(data)
    generic = cdr.decode(data, "sensor_msgs/msg/PointCloud2")
    first = names.index("x")
    assert np.array_equal(cloud.xyz, values[:, first : first + 3])
    if "vx" in names:
        assert cloud.velocity is not None
        assert np.array_equal(cloud.velocity, values[:, 3:])
    else:
        assert cloud.velocity is None
    assert (cloud.stamp, cloud.frame_id, cloud.height, cloud.width) == (samples.START + 7, frame_id, 1, 17)
    assert generic.header.frame_id == frame_id
    assert bytes(generic.data) == values.tobytes()


def test_cloud_is_a_view_that_cannot_be_written() -> None:
    data = samples.cloud(samples.positions(0, 10), 0)
    cloud = cdr.decode_cloud(data)
    assert np.shares_memory(cloud.xyz, np.frombuffer(data, np.uint8))
    assert not cloud.xyz.flags.writeable


def test_big_endian_cloud() -> None:
    little = samples.cloud(samples.positions(3, 10), samples.START)
    content: Any = cdr.decode(little, "sensor_msgs/msg/PointCloud2")
    content.is_bigendian = True
    content.data = np.frombuffer(samples.positions(3, 10).astype(">f4").tobytes(), np.uint8)
    from cloth_sim_ros.session.channel_description import standard_types

    data = bytes(standard_types().serialize_cdr(content, "sensor_msgs/msg/PointCloud2", little_endian=False))
    assert data[1] == 0
    assert np.array_equal(cdr.decode_cloud(data).xyz, samples.positions(3, 10))


def test_rows_may_be_padded() -> None:
    rows, columns, row_step = 3, 4, 4 * 12 + 20
    values = np.random.default_rng(2).random((rows, columns, 3), np.float32)
    padded = np.zeros((rows, row_step), np.uint8)
    padded[:, : columns * 12] = np.frombuffer(values.tobytes(), np.uint8).reshape(rows, -1)
    content: Any = cdr.decode(samples.cloud(values.reshape(-1, 3), 0), "sensor_msgs/msg/PointCloud2")
    content.height, content.width, content.row_step, content.data = rows, columns, row_step, padded.reshape(-1)
    cloud = cdr.decode_cloud(cdr.encode(content, "sensor_msgs/msg/PointCloud2"))
    assert np.array_equal(cloud.xyz, values.reshape(-1, 3))


@pytest.mark.parametrize("points", [0, 1, 3, 4, 7, 40])
def test_surface_is_what_was_encoded(points: int) -> None:
    data = samples.topology(points)
    surface = cdr.decode_mesh(data)
    generic: Any = cdr.decode(data, "shape_msgs/msg/Mesh")
    assert surface.triangles.tolist() == [triangle.vertex_indices.tolist() for triangle in generic.triangles]
    assert surface.vertices.tolist() == [[point.x, point.y, point.z] for point in generic.vertices]


@pytest.mark.parametrize("text", ["", "a", "abc", "é", "x" * 1000])
def test_string(text: str) -> None:
    data = cdr.encode_string(text)
    assert cdr.decode_string(data) == text
    assert cdr.decode(data, "std_msgs/msg/String").data == text
    assert data == cdr.encode(samples.message("std_msgs/msg/String", data=text), "std_msgs/msg/String")


@pytest.mark.parametrize(
    ("read", "data"),
    [
        (cdr.decode_cloud, samples.cloud(samples.positions(0, 5), 0)),
        (cdr.decode_mesh, samples.topology(5)),
        (cdr.decode_string, cdr.encode_string("frame")),
    ],
)
def test_bytes_cut_anywhere_are_refused(read: Any, data: bytes) -> None:
    # The last byte of a cloud is `is_dense`, which is not read.
    for end in range(len(data) - 1):
        with pytest.raises(SessionError):
            read(data[:end])


def test_sizes_beyond_the_bytes_are_refused() -> None:
    data = bytearray(samples.cloud(samples.positions(0, 5), 0))
    content: Any = cdr.decode(bytes(data), "sensor_msgs/msg/PointCloud2")
    for field, value in [("width", 6), ("height", 2), ("row_step", 61), ("point_step", 8)]:
        original = getattr(content, field)
        setattr(content, field, value)
        with pytest.raises(SessionError, match="does not fit"):
            cdr.decode_cloud(cdr.encode(content, "sensor_msgs/msg/PointCloud2"))
        setattr(content, field, original)
    assert len(cdr.decode_cloud(cdr.encode(content, "sensor_msgs/msg/PointCloud2")).xyz) == 5


def test_cloud_without_float32_positions_is_refused() -> None:
    with pytest.raises(SessionError, match="x, y, z"):
        cdr.decode_cloud(samples.cloud(samples.positions(0, 5), 0, names=("u", "v", "w")))


def test_descriptions_are_those_of_ros() -> None:
    cloud = describe("sensor_msgs/msg/PointCloud2")
    assert cloud.type_hash == POINT_CLOUD_HASH
    assert cloud.definition.startswith("std_msgs/Header header\nuint32 height\n")
    for used in ("std_msgs/Header", "builtin_interfaces/Time", "sensor_msgs/PointField"):
        assert f"{'=' * 80}\nMSG: {used}\n" in cloud.definition
    with pytest.raises(SessionError, match="my_msgs/msg/Thing"):
        describe("my_msgs/msg/Thing")


def test_qos_text_equals_rosbag2() -> None:
    from rosbags.rosbag2.metadata import parse_qos

    (qos,) = parse_qos(Qos(reliability="best_effort", durability="transient_local", depth=3).to_yaml())
    assert (qos.reliability.name, qos.durability.name, qos.history.name, qos.depth) == (
        "BEST_EFFORT",
        "TRANSIENT_LOCAL",
        "KEEP_LAST",
        3,
    )
    assert (qos.deadline.sec, qos.deadline.nsec) == divmod(2**63 - 1, 10**9)


def test_bytes_from_ros_itself() -> None:
    serialization = pytest.importorskip("rclpy.serialization")
    from sensor_msgs.msg import PointCloud2, PointField
    from std_msgs.msg import String

    xyz = samples.positions(1, 30)
    content = PointCloud2(height=5, width=6, point_step=12, row_step=72, is_dense=True)
    content.header.frame_id = "world"
    content.header.stamp.sec, content.header.stamp.nanosec = 12, 34
    content.fields = [PointField(name=name, offset=4 * i, datatype=7, count=1) for i, name in enumerate("xyz")]
    content.data = xyz.tobytes()
    cloud = cdr.decode_cloud(serialization.serialize_message(content))
    assert np.array_equal(cloud.xyz, xyz)
    assert (cloud.stamp, cloud.frame_id, cloud.height, cloud.width) == (12 * 10**9 + 34, "world", 5, 6)
    raw = serialization.serialize_message(String(data="{}"))
    assert cdr.decode_string(raw) == "{}"
    assert serialization.deserialize_message(cdr.encode_string("{}"), String).data == "{}"
    assert struct.unpack_from("<I", raw, 4) == (3,)
