# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Message bytes of the session writer, compared with rosbags' generic writer."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rosbags")

from cloth_sim_ros.session import messages
from cloth_sim_ros.session.cdr import decode, decode_cloud, encode, message_class

STAMP = 1_800_000_000_123_456_789


@pytest.mark.parametrize("frame_id", ["", "world", "a_longer_frame"])
@pytest.mark.parametrize("velocity", [False, True])
@pytest.mark.parametrize("double", [False, True])
def test_cloud_bytes_equal_generic_writer(frame_id: str, velocity: bool, double: bool) -> None:
    x, v = np.random.default_rng(0).normal(size=(2, 3, 6))
    content = messages.CloudEncoder(frame_id=frame_id, height=2, width=3, velocity=velocity, double=double)
    content = content.encode(x, STAMP, v if velocity else None)
    read = decode(content, messages.CLOUD)
    # Padding after the last field extends the message to a multiple of four bytes.
    again = encode(read, messages.CLOUD)
    assert content[: len(again)] == again
    assert len(content) % 4 == 0
    assert read.header.stamp.sec * 10**9 + read.header.stamp.nanosec == STAMP
    assert read.header.frame_id == frame_id
    values = read.data.view("<f8" if double else "<f4").reshape(6, -1)
    assert np.array_equal(values[:, :3], x.T.astype(values.dtype))
    assert not velocity or np.array_equal(values[:, 3:], v.T.astype(values.dtype))


@pytest.mark.parametrize("velocity", [False, True])
@pytest.mark.parametrize("double", [False, True])
def test_normals_and_ids_follow_the_velocities(velocity: bool, double: bool) -> None:
    x, v, n = np.random.default_rng(0).normal(size=(3, 3, 6))
    encoder = messages.CloudEncoder(
        frame_id="world", height=2, width=3, velocity=velocity, normal=True, ids=True, double=double
    )
    encoder.encode(x + 1.0, STAMP, v if velocity else None, n)
    content = encoder.encode(x, STAMP, v if velocity else None, n)
    read = decode(content, messages.CLOUD)
    again = encode(read, messages.CLOUD)
    assert content[: len(again)] == again
    names = ["x", "y", "z", *(["vx", "vy", "vz"] if velocity else []), "normal_x", "normal_y", "normal_z", "id"]
    assert [field.name for field in read.fields] == names
    points = np.frombuffer(
        read.data.tobytes(), [(name, ("<u4" if name == "id" else "<f8" if double else "<f4")) for name in names]
    )
    assert points["id"].tolist() == [0, 1, 2, 3, 4, 5]
    vectors = np.concatenate([x, v, n] if velocity else [x, n])
    for name, row in zip(names[:-1], vectors, strict=True):
        assert np.array_equal(points[name], row.astype(points[name].dtype))
    assert np.array_equal(decode_cloud(content).xyz, x.T.astype("<f8" if double else "<f4"))


@pytest.mark.parametrize("frame_id", ["", "world", "map"])
def test_small_message_bytes_equal_generic_writer(frame_id: str) -> None:
    encoded = [
        (messages.POSE, messages.pose_bytes((1.0, -0.0, 3.0), (0.0, 0.6, 0.0, 0.8), frame_id=frame_id, stamp=STAMP)),
        (messages.POINT, messages.point_bytes((1.0, 2.0, 3.0), frame_id=frame_id, stamp=STAMP)),
        (messages.WRENCH, messages.wrench_bytes(range(6), frame_id=frame_id, stamp=STAMP)),
        (messages.BOOL, messages.bool_bytes(True)),
        (messages.MESH, messages.mesh_bytes([[0, 1, 2]], np.arange(9.0).reshape(3, 3))),
        (messages.MESH, messages.mesh_bytes(np.zeros((0, 3), np.int64), np.arange(9.0).reshape(3, 3))),
    ]
    for kind, data in encoded:
        assert encode(decode(data, kind), kind) == data
    pose = decode(encoded[0][1], messages.POSE)
    assert (pose.pose.position.z, pose.pose.orientation.w, pose.header.frame_id) == (3.0, 0.8, frame_id)
    assert message_class(messages.WRENCH)
    wrench = decode(encoded[2][1], messages.WRENCH).wrench
    assert (wrench.force.y, wrench.torque.z) == (1.0, 5.0)
