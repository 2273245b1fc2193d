# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Reader of a real cloth's MCAP: clouds and gripper poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.fit.parameters import FitError
from cloth_sim_ros.fit.recorded import RecordedGripper, Recording
from cloth_sim_ros.fit.recording import FitRecording, visible
from cloth_sim_ros.fit.start import rest_recording
from cloth_sim_ros.scene.scene import Scene

_CLOUD, _POSE, _BOOL = "sensor_msgs/msg/PointCloud2", "geometry_msgs/msg/PoseStamped", "std_msgs/msg/Bool"
#: Names of a cloud's field with the particle index, and numpy types of PointField's integer types.
_INDEX_FIELDS, _INTEGER_TYPES = ("index", "id", "particle"), {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4"}


def is_session(path: Path) -> bool:
    """Return true if a file is a session of this package, intact or damaged; false for any other MCAP.

    Raises:
        SessionError: if the file can't be read.
    """
    from cloth_sim_ros.session.errors import NotASessionError
    from cloth_sim_ros.session.part import SessionPart

    try:
        SessionPart(path).close()
    except NotASessionError as error:
        if "without the metadata record" in str(error) or "profile" in str(error):
            return False
        raise
    return True


def read_bag(
    paths: Sequence[Path],
    scene: Scene,
    *,
    topic: str | None = None,
    poses: Mapping[str, str] | None = None,
    settle_time: float = 4.0,
    matched: bool = True,
    grasped: Mapping[str, str] | None = None,
    first_time: float = 0.0,
) -> FitRecording:
    """Read clouds and gripper poses of a cloth that hangs at rest in its grippers at the first cloud.

    Args:
        paths: MCAP files of one recording, with messages in CDR.
        scene: the cloth and its grippers.
        topic: topic of the clouds; required if several topics have clouds.
        poses: topic of PoseStamped by gripper; default: the one whose name ends in /GRIPPER/target or /GRIPPER/pose.
        settle_time: settling time of the simulated cloth before the first cloud [s].
        matched: true if points are particles, in order or by an index field; false if they are bare surface points.
        grasped: grasped particles by gripper, such as ``12,13`` or ``top_left``; by default, found from the clouds.
        first_time: time of the first used cloud, relative to the first recorded one [s].

    Raises:
        FitError: if the recording is unusable; the text names cause and remedy.
    """
    recording = read_recording(paths, scene, topic=topic, poses=poses, matched=matched).since(first_time)
    return rest_recording(recording, scene, settle_time=settle_time, grasped=grasped)


def read_recording(
    paths: Sequence[Path],
    scene: Scene,
    *,
    topic: str | None = None,
    poses: Mapping[str, str] | None = None,
    matched: bool = True,
) -> Recording:
    """Read clouds and gripper poses; times count from the first cloud.

    Args:
        paths: MCAP files of one recording, with messages in CDR.
        scene: names the grippers, the frame and the particles.
        topic: topic of the clouds; required if several topics have clouds.
        poses: topic of PoseStamped by gripper; default: the one whose name ends in /GRIPPER/target or /GRIPPER/pose.
        matched: true if points are particles, in order or by an index field; false if they are bare surface points.

    Raises:
        FitError: if the recording is unusable; the text names cause and remedy.
    """
    messages_by_topic = _read_messages(paths)
    cloud_topics = [name for name, (kind, _) in messages_by_topic.items() if kind == _CLOUD]
    cloud_topic = _select_topic(cloud_topics, topic, "clouds (PointCloud2)", "--topic NAME")
    unknown = [name for name in poses or {} if name not in scene.gripper_names]
    if unknown:
        grippers = ", ".join(scene.gripper_names) or "none"
        raise FitError(f"--pose names '{unknown[0]}'; the scene's grippers are {grippers}")
    count = len(scene.initial_positions())
    cloud_messages = messages_by_topic[cloud_topic][1]
    clouds = [_read_cloud(data, time, scene, count, matched) for time, data in cloud_messages]
    if not clouds:
        raise FitError(f"{paths[0]} holds no cloud on {cloud_topic}")
    clouds.sort(key=lambda entry: entry[0])
    start = clouds[0][0]
    distinct = [entry for k, entry in enumerate(clouds) if not k or entry[0] > clouds[k - 1][0]]
    return Recording(
        name=", ".join(Path(path).name for path in paths),
        times=np.array([stamp - start for stamp, _ in distinct], dtype=np.int64) * 1e-9,
        clouds=tuple(cloud for _, cloud in distinct),
        grippers={
            name: _read_track(messages_by_topic, name, dict(poses or {}).get(name), start)
            for name in scene.gripper_names
        },
        matched=matched,
    )


def _read_messages(paths: Sequence[Path]) -> dict[str, tuple[str, list[tuple[int, bytes]]]]:
    """Read the messages of clouds, poses and grasps: for each topic, the type, log times [ns] and bytes."""
    from cloth_sim_ros.session.bag import bag_messages
    from cloth_sim_ros.session.errors import DamagedSessionError

    messages_by_topic: dict[str, tuple[str, list[tuple[int, bytes]]]] = {}
    for path in paths:
        try:
            for topic, kind, time, data in bag_messages(path):
                if kind in (_CLOUD, _POSE, _BOOL):
                    messages_by_topic.setdefault(topic, (kind, []))[1].append((time, data))
        except DamagedSessionError as error:
            raise FitError(str(error)) from error
    return messages_by_topic


def _select_topic(topics: Sequence[str], requested: str | None, description: str, remedy: str) -> str:
    available = ", ".join(topics) or "none"
    if requested is not None:
        if requested not in topics:
            raise FitError(f"there is no topic '{requested}' of {description}; available: {available}")
        return requested
    if len(topics) != 1:
        raise FitError(f"{len(topics)} topics hold {description}: {available}; select one by {remedy}")
    return topics[0]


def _read_track(
    messages_by_topic: Mapping[str, tuple[str, list[tuple[int, bytes]]]],
    gripper: str,
    requested: str | None,
    start: int,
) -> RecordedGripper:
    """Return the poses and grasps of a gripper; times count from a stamp [ns]."""
    from cloth_sim_ros.session.cdr import decode

    topics = [name for name, (kind, _) in messages_by_topic.items() if kind == _POSE]
    if requested is None:
        matching = [name for name in topics if name.endswith((f"/{gripper}/target", f"/{gripper}/pose"))]
        topics = matching or topics
    topic = _select_topic(topics, requested, f"poses of gripper '{gripper}' (PoseStamped)", f"--pose {gripper}=TOPIC")
    stamps, poses = list[int](), list[list[float]]()
    for time, data in messages_by_topic[topic][1]:
        message = decode(data, _POSE)
        p, q = message.pose.position, message.pose.orientation
        pose = [p.x, p.y, p.z, q.x, q.y, q.z, q.w]
        if not np.isfinite(pose).all() or not any(pose[3:]):
            raise FitError(f"a pose on {topic} is {pose}; it must be finite, with a unit quaternion")
        stamps.append(_stamp(message.header) or time)
        poses.append(pose)
    grasps = [
        (1e-9 * (time - start), bool(decode(data, _BOOL).data))
        for name, (kind, messages) in messages_by_topic.items()
        if kind == _BOOL and name.endswith(f"/{gripper}/grasp")
        for time, data in messages
    ]
    order = np.argsort(np.array(stamps), kind="stable")
    sorted_poses = np.array(poses)[order]
    return RecordedGripper(
        times=1e-9 * (np.array(stamps, dtype=np.int64)[order] - start),
        positions=sorted_poses[:, :3],
        quaternions=sorted_poses[:, 3:],
        grasps=tuple(grasps),
    )


def _read_cloud(data: bytes, time: int, scene: Scene, count: int, matched: bool) -> tuple[int, NDArray[np.float64]]:
    """Return stamp [ns] and points [m] of a cloud; a matched cloud has a row for each particle, NaN if unseen."""
    from cloth_sim_ros.session.cdr import decode, decode_cloud

    cloud = decode_cloud(data)
    if cloud.frame_id not in ("", scene.frame_id):
        frames = f"in frame '{cloud.frame_id}', the scene in '{scene.frame_id}'"
        raise FitError(f"a cloud is given {frames}; transform it, or set frame_id")
    points = np.array(cloud.xyz, dtype=np.float64)
    if not matched:
        return cloud.stamp or time, points[visible(points)]
    message = decode(data, _CLOUD)
    fields = [field for field in message.fields if field.name in _INDEX_FIELDS and field.datatype in _INTEGER_TYPES]
    if not fields:
        return cloud.stamp or time, points
    order = ">" if message.is_bigendian else "<"
    indices = np.ndarray(
        (message.height, message.width),
        dtype=order + _INTEGER_TYPES[fields[0].datatype],
        buffer=np.ascontiguousarray(message.data),
        offset=fields[0].offset,
        strides=(message.row_step, message.point_step),
    ).ravel()
    wrong = np.flatnonzero((indices < 0) | (indices >= count))
    if wrong.size:
        named = f"field '{fields[0].name}' names particle {indices[wrong[0]]}"
        raise FitError(f"a cloud's {named}; there are {count}, from index 0")
    ordered = np.full((count, 3), np.nan)
    ordered[indices.astype(np.int64)] = points
    return cloud.stamp or time, ordered


def _stamp(header: Any) -> int:
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)
