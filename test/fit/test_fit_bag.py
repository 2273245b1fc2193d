# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Clouds, poses and grasps of a bag as a recording: topics, particle numbers, stamps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from support.session_samples import header, message

from cloth_sim_ros import Scene
from cloth_sim_ros.fit import bag
from cloth_sim_ros.fit.parameters import FitError
from cloth_sim_ros.session.cdr import encode

CLOUD, POSE = "sensor_msgs/msg/PointCloud2", "geometry_msgs/msg/PoseStamped"
#: Types of PointField by numpy type.
DATATYPES = {"<u4": 6, "<f4": 7}
SECOND = 10**9
STAMPS = tuple(SECOND + k * SECOND // 10 for k in range(4))
SCENE = Scene.from_parameters({"cloth.resolution": [2, 2], "grippers": ["left"]})
PAIR = Scene.from_parameters({"cloth.resolution": [2, 2], "grippers": ["left", "right"]})
Messages = dict[str, tuple[str, list[tuple[int, bytes]]]]


def pose(stamp: int, x: float = 0.5) -> bytes:
    point = message("geometry_msgs/msg/Point", x=x, y=0.0, z=1.0)
    turn = message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
    pose = message("geometry_msgs/msg/Pose", position=point, orientation=turn)
    return encode(message(POSE, header=header(stamp), pose=pose), POSE)


def numbered_cloud(stamp: int, particles: Sequence[float], *, field: str = "index", kind: str = "<u4") -> bytes:
    """A cloud whose x are its particle numbers, which stand in a field of their own too."""
    points = np.zeros(len(particles), dtype=[("x", "<f4"), ("y", "<f4"), ("z", "<f4"), (field, kind)])
    points["x"] = points[field] = particles
    fields = [
        message(
            "sensor_msgs/msg/PointField", name=name, offset=4 * k, datatype=7 if k < 3 else DATATYPES[kind], count=1
        )
        for k, name in enumerate(points.dtype.names or ())
    ]
    layout = {"height": 1, "width": len(points), "point_step": 16, "row_step": 16 * len(points)}
    data = np.frombuffer(points.tobytes(), np.uint8)
    cloud = message(CLOUD, header=header(stamp), fields=fields, is_bigendian=False, data=data, is_dense=True, **layout)
    return encode(cloud, CLOUD)


def messages_of(*, particles: Sequence[float] = (0, 1, 2, 3), poses: str = "/left/target", **field: str) -> Messages:
    """Messages by topic of a short bag, logged at their stamps."""
    clouds = [(stamp, numbered_cloud(stamp, particles, **field)) for stamp in STAMPS]
    return {"/points": (CLOUD, clouds), poses: (POSE, [(stamp, pose(stamp)) for stamp in STAMPS])}


def read(monkeypatch: pytest.MonkeyPatch, messages: Messages, scene: Scene = SCENE, **options: str) -> bag.Recording:
    monkeypatch.setattr(bag, "_read_messages", lambda _: messages)
    return bag.read_recording([Path("real.mcap")], scene, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize(("poses", "gripper"), [("/left/target", "right"), ("/goal_pose", "left")])
def test_gripper_without_own_topic_is_refused(poses: str, gripper: str, monkeypatch: pytest.MonkeyPatch) -> None:
    reason = f"/{gripper}/target or /{gripper}/pose; select one by --pose {gripper}=TOPIC; available: {poses}"
    with pytest.raises(FitError, match=reason):
        read(monkeypatch, messages_of(poses=poses), PAIR)


@pytest.mark.parametrize(
    ("field", "kind", "index_field"),
    [("index", "<u4", ""), ("index", "<f4", ""), ("label", "<u4", "label"), ("label", "<f4", "label")],
)
def test_particle_numbers_order_a_cloud(
    field: str, kind: str, index_field: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    messages = messages_of(particles=[3, 1, 0], field=field, kind=kind)
    recording = read(monkeypatch, messages, index_field=index_field)
    np.testing.assert_equal(recording.clouds[0][:, 0], [0.0, 1.0, np.nan, 3.0])


def test_cloud_of_no_points_hides_all_particles(monkeypatch: pytest.MonkeyPatch) -> None:
    messages = messages_of()
    messages["/points"][1][0] = (STAMPS[0], numbered_cloud(STAMPS[0], []))
    recording = read(monkeypatch, messages)
    assert recording.clouds[0].shape == recording.clouds[1].shape == (4, 3)
    assert np.isnan(recording.clouds[0]).all()


@pytest.mark.parametrize(
    ("particles", "kind", "index_field", "reason"),
    [
        ([0, 1], "<u4", "label", r"no field 'label' \(--index\); they have x, y, z, index"),
        ([0, 0.5], "<f4", "", "'index' of a cloud has the type float32 and numbers that are not whole"),
        ([0, float("nan")], "<f4", "", "not whole"),
        ([0, 4], "<u4", "", "names particle 4; there are 4, from index 0"),
        ([0, 1, 2, 1], "<u4", "", "particle 1 has 2 points in a cloud; each particle has one"),
        ([0, -1], "<f4", "", "names particle -1; there are 4"),
    ],
)
def test_faulty_particle_numbers_are_refused(
    particles: Sequence[float], kind: str, index_field: str, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(FitError, match=reason):
        read(monkeypatch, messages_of(particles=particles, kind=kind), index_field=index_field)


def test_marker_number_that_stands_twice_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    point = SimpleNamespace(x=1.0, y=2.0, z=3.0)
    markers = SimpleNamespace(markers=[SimpleNamespace(id=k, point=point) for k in (0, 1, 0)])
    monkeypatch.setattr(bag.message_fields, "topic_messages", lambda _paths, _topic: [(SECOND, markers)])
    with pytest.raises(FitError, match="particle 0 has 2 points in a cloud"):
        read(monkeypatch, messages_of(), topic="/markers:markers[].point", index_field="markers[].id")


@pytest.mark.parametrize("wall_time", [0, 1_795_000_000 * SECOND])
def test_grasps_follow_the_clock_of_the_poses(wall_time: int, monkeypatch: pytest.MonkeyPatch) -> None:
    messages = messages_of()
    grasps = [(STAMPS[0] - 1, True), (STAMPS[2], False)]
    flags = [(time, encode(message("std_msgs/msg/Bool", data=closed), "std_msgs/msg/Bool")) for time, closed in grasps]
    messages["/left/grasp"] = ("std_msgs/msg/Bool", flags)
    logged = {
        topic: (kind, [(time + wall_time, data) for time, data in entries])
        for topic, (kind, entries) in messages.items()
    }
    track = read(monkeypatch, logged).grippers["left"]
    assert [closed for _, closed in track.grasps] == [True, False]
    assert [time for time, _ in track.grasps] == pytest.approx([-1e-9, 0.2])
    assert track.is_closed(0.19)
    assert not track.is_closed(0.21)


@pytest.mark.parametrize("stamps", [(0, 1, 2), (0, 0, 0)])
def test_log_times_replace_stamps_that_are_all_zero(stamps: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    clouds = [(7 + k, numbered_cloud(stamp, [0, 1, 2, 3])) for k, stamp in enumerate(stamps)]
    poses = [(7 + k, pose(stamp)) for k, stamp in enumerate(stamps)]
    recording = read(monkeypatch, {"/points": (CLOUD, clouds), "/left/pose": (POSE, poses)})
    assert recording.times == pytest.approx([0.0, 1e-9, 2e-9])
    assert recording.grippers["left"].times == pytest.approx([0.0, 1e-9, 2e-9])
