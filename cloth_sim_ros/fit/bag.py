# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Reader of a real cloth's recording: clouds and gripper poses in a bag, or in tables."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence, Set
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from numpy.typing import ArrayLike, NDArray

from cloth_sim_ros.fit import message_fields, tables
from cloth_sim_ros.fit.parameters import FitError
from cloth_sim_ros.fit.recorded import RecordedGripper, Recording
from cloth_sim_ros.fit.recording import FitRecording, visible_mask
from cloth_sim_ros.fit.start import rest_recording
from cloth_sim_ros.scene.scene import Scene

_CLOUD, _POSE, _BOOL = "sensor_msgs/msg/PointCloud2", "geometry_msgs/msg/PoseStamped", "std_msgs/msg/Bool"
#: Endings of files that are no MCAP.
_OTHER_ENDINGS = (".db3", ".bag")
#: Names of a cloud's field with the particle index, and numpy types of PointField's types.
_INDEX_FIELDS = ("index", "id", "particle")
_FIELD_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


def is_session(path: Path) -> bool:
    """Return True for a session of this package, False for any other recording. Raises SessionError if it is damaged.

    Raises:
        SessionError: if the file can't be read.
    """
    from cloth_sim_ros.session.errors import NotASessionError
    from cloth_sim_ros.session.part import SessionPart

    if path.is_dir() or path.suffix in _OTHER_ENDINGS or tables.is_table(path):
        return False
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
    index_field: str = "",
    columns: Mapping[str, str] | None = None,
    scale: float = 1.0,
) -> FitRecording:
    """Read a bag or table for a fit of a cloth that hangs at rest at the first used cloud. Raises FitError.

    Args:
        paths: as for `read_recording`, and so are `topic`, `poses`, `matched`, `index_field`, `columns` and `scale`.
        scene: the cloth and its grippers.
        topic: topic of the clouds.
        poses: poses by gripper.
        settle_time: settling time of the simulated cloth before the first cloud [s].
        matched: true if points are particles.
        grasped: grasped particles by gripper, such as ``12,13`` or ``top_left``; by default, found from the clouds.
        first_time: time of the first used cloud, relative to the first recorded one [s].
        index_field: field with the particles' numbers.
        columns: names in a table.
        scale: factor from the unit of tables to metres.

    Raises:
        FitError: if the recording is unusable; the text names cause and remedy.
        SessionError: if a file can't be read.
    """
    recording = read_recording(
        paths,
        scene,
        topic=topic,
        poses=poses,
        matched=matched,
        index_field=index_field,
        columns=columns,
        scale=scale,
    ).since(first_time)
    return rest_recording(recording, scene, settle_time=settle_time, grasped=grasped)


def read_recording(
    paths: Sequence[Path],
    scene: Scene,
    *,
    topic: str | None = None,
    poses: Mapping[str, str] | None = None,
    matched: bool = True,
    index_field: str = "",
    columns: Mapping[str, str] | None = None,
    scale: float = 1.0,
    camera_pose: Sequence[float] | None = None,
    offsets: Mapping[str, Sequence[float]] | None = None,
) -> Recording:
    """Read clouds and gripper poses of a bag or table; times count from the first cloud. Raises FitError.

    Args:
        paths: files or folder of one bag (MCAP, SQLite, ROS 1), or one table (CSV, npz).
        scene: names the grippers, the frame and the particles.
        topic: topic of the clouds; required if several topics have clouds. `TOPIC:FIELD` for messages of any type, see
            `message_fields`.
        poses: poses by gripper: a topic, `TOPIC:FIELD`, or a table (CSV). Default: the topic of PoseStamped whose name
            ends in /GRIPPER/target or /GRIPPER/pose.
        matched: true if points are particles, in order or by an index field; false if they are bare surface points.
        index_field: field with the particles' numbers: of the points of PointCloud2 (by default `index`, `id` or
            `particle`, if they have one), or beside FIELD of `topic`.
        columns: names in a table, see `tables.read_clouds`.
        scale: factor from the unit of tables to metres.
        camera_pose: position [m] and quaternion x, y, z, w of the clouds' frame in that of the poses; the same frame by
            default.
        offsets: point that each gripper holds, in the frame of its poses [m]; their origin by default.

    Raises:
        FitError: if the recording is unusable; the text names cause and remedy.
        SessionError: if a file can't be read.
    """
    for option, names in (("--pose", poses or {}), ("--offset", offsets or {})):
        unknown = [name for name in names if name not in scene.gripper_names]
        if unknown:
            grippers = ", ".join(scene.gripper_names) or "none"
            raise FitError(f"{option} names '{unknown[0]}'; the scene's grippers are {grippers}")
    recording = _read(paths, scene, topic, poses or {}, matched, index_field, columns, scale, camera_pose is not None)
    moved = {name: recording.grippers[name].offset_by(offset) for name, offset in (offsets or {}).items()}
    recording = attrs.evolve(recording, grippers={**recording.grippers, **moved})
    return recording if camera_pose is None else recording.in_gripper_frame(camera_pose)


def _read(
    paths: Sequence[Path],
    scene: Scene,
    topic: str | None,
    poses: Mapping[str, str],
    matched: bool,
    index_field: str,
    columns: Mapping[str, str] | None,
    scale: float,
    accepts_any_frame: bool,
) -> Recording:
    """Return the recording of a bag or a table, in the frames of its files."""
    count = len(scene.initial_positions())
    sources = {name: poses.get(name) for name in scene.gripper_names}
    if any(tables.is_table(path) for path in paths):
        if len(paths) > 1:
            raise FitError(f"{paths[1]}: a table is one recording; give its files one by one")
        times, clouds = tables.read_clouds(paths[0], count, columns=columns, scale=scale, matched=matched)
        tracks = {name: _read_table_track(name, source, float(times[0]), scale) for name, source in sources.items()}
        return Recording(
            name=paths[0].name, times=times - times[0], clouds=tuple(clouds), grippers=tracks, matched=matched
        )
    messages_by_topic = _read_messages(paths)
    cloud_name, field = message_fields.split_topic(topic) if topic is not None else (None, "")
    if cloud_name is not None and field:
        read = list(_read_fields(paths, cloud_name, field, index_field, count, matched))
    else:
        cloud_topics = [name for name, (kind, _) in messages_by_topic.items() if kind == _CLOUD]
        frame = None if accepts_any_frame else scene.frame_id
        cloud_name = _select_topic(cloud_topics, cloud_name, "clouds (PointCloud2)", "--topic NAME")
        read = [
            _read_cloud(data, time, frame, count, matched, index_field)
            for time, data in messages_by_topic[cloud_name][1]
        ]
    if not read:
        raise FitError(f"{paths[0]} holds no cloud on {cloud_name}")
    cloud_times = _message_times([(stamp, log_time) for stamp, log_time, _, _ in read])
    stamped = sorted(zip(cloud_times, (cloud for *_, cloud in read), strict=True), key=lambda entry: entry[0])
    cloud_frames = frozenset[str]() if accepts_any_frame else frozenset(name for _, _, name, _ in read if name)
    start = stamped[0][0]
    distinct = [entry for k, entry in enumerate(stamped) if not k or entry[0] > stamped[k - 1][0]]
    return Recording(
        name=", ".join(Path(path).name for path in paths),
        times=np.array([stamp - start for stamp, _ in distinct], dtype=np.int64) * 1e-9,
        clouds=tuple(cloud for _, cloud in distinct),
        grippers={
            name: _read_track(paths, messages_by_topic, name, source, start, scale, cloud_frames)
            for name, source in sources.items()
        },
        matched=matched,
    )


def _read_table_track(gripper: str, source: str | None, start: float, scale: float) -> RecordedGripper:
    if source is None:
        raise FitError(f"the poses of gripper '{gripper}' are missing; give --pose {gripper}=poses.csv")
    return tables.read_track(Path(source), start, scale=scale)


def _read_fields(
    paths: Sequence[Path], topic: str, field: str, index_field: str, count: int, matched: bool
) -> Iterator[tuple[int, int, str, NDArray[np.float64]]]:
    """Yield stamp and log time [ns], frame, and points [m] of each message of a topic, by the names of its fields."""
    if index_field:
        message_fields.check_field(index_field)
    for log_time, message in message_fields.topic_messages(paths, topic):
        points = message_fields.points_of(message, field)
        if not matched:
            points = points[visible_mask(points)]
        elif index_field:
            indices = message_fields.indices_of(message, index_field)
            if len(indices) != len(points):
                raise FitError(f"field '{index_field}' has {len(indices)} numbers for {len(points)} points")
            wrong = [index for index in indices if not 0 <= index < count]
            if wrong:
                raise FitError(f"field '{index_field}' names particle {wrong[0]}; there are {count}, from index 0")
            points = _order_points(points, indices, count)
        yield message_fields.stamp_of(message), log_time, message_fields.frame_of(message), points


def _message_times(times: Sequence[tuple[int, int]]) -> list[int]:
    """Return the times of a topic's messages [ns] by their stamps and log times: the latter if no message has a stamp.

    Simulated time begins at the stamp 0.
    """
    has_stamps = any(stamp for stamp, _ in times)
    return [stamp if has_stamps else log_time for stamp, log_time in times]


def _read_messages(paths: Sequence[Path]) -> dict[str, tuple[str, list[tuple[int, bytes]]]]:
    """Read the clouds, poses and grasps of a bag: by topic, the type, and log time [ns] and bytes of each message."""
    from cloth_sim_ros.session.bag import bag_files, bag_messages
    from cloth_sim_ros.session.errors import DamagedSessionError

    messages_by_topic: dict[str, tuple[str, list[tuple[int, bytes]]]] = {}
    for file in itertools.chain.from_iterable(map(bag_files, paths)):
        try:
            for topic, kind, time, data in bag_messages(file):
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
    paths: Sequence[Path],
    messages_by_topic: Mapping[str, tuple[str, list[tuple[int, bytes]]]],
    gripper: str,
    requested: str | None,
    start: int,
    scale: float,
    cloud_frames: Set[str],
) -> RecordedGripper:
    """Return a gripper's recorded poses and grasps; times count from `start` [ns].

    Raises FitError without poses, and for poses in another frame than the clouds.
    """
    if requested is not None and tables.is_table(Path(requested)):
        return tables.read_track(Path(requested), 1e-9 * start, scale=scale)
    from cloth_sim_ros.session.cdr import decode

    read = list(_read_poses(paths, messages_by_topic, gripper, requested))
    if not read:
        raise FitError(f"{paths[0]} holds no pose of gripper '{gripper}' on {requested}")
    frames = sorted({name for _, _, name, _ in read if name})
    if len(frames) > 1:
        raise FitError(f"the poses of gripper '{gripper}' are in several frames: {', '.join(frames)}; transform them")
    if frames and cloud_frames and frames[0] not in cloud_frames:
        raise FitError(
            f"the poses of gripper '{gripper}' are in frame '{frames[0]}', the clouds in '{min(cloud_frames)}'; give "
            "--camera-pose, or transform them"
        )
    stamps = _message_times([(stamp, log_time) for stamp, log_time, _, _ in read])
    poses = [pose for *_, pose in read]
    # Grasps have no stamp. Their log times are of another clock if the robot's time is simulated.
    delays = sorted(stamp - log_time for stamp, (_, log_time, *_) in zip(stamps, read, strict=True))
    delay = delays[len(delays) // 2]
    grasps = [
        (1e-9 * (time + delay - start), bool(decode(data, _BOOL).data))
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


def _read_poses(
    paths: Sequence[Path],
    messages_by_topic: Mapping[str, tuple[str, list[tuple[int, bytes]]]],
    gripper: str,
    requested: str | None,
) -> Iterator[tuple[int, int, str, list[float]]]:
    """Yield stamp and log time [ns], frame, and position [m] and quaternion of each pose of a gripper."""
    from cloth_sim_ros.session.cdr import decode

    topic, field = message_fields.split_topic(requested) if requested is not None else (None, "")
    if topic is not None and field:
        messages = message_fields.topic_messages(paths, topic)
    else:
        topics = [name for name, (kind, _) in messages_by_topic.items() if kind == _POSE]
        if topic is None:
            matching = [name for name in topics if name.endswith((f"/{gripper}/target", f"/{gripper}/pose"))]
            if not matching:
                available = ", ".join(topics) or "none"
                raise FitError(
                    f"no topic of poses (PoseStamped) ends in /{gripper}/target or /{gripper}/pose; select one by "
                    f"--pose {gripper}=TOPIC; available: {available}"
                )
            topics = matching
        remedy = f"--pose {gripper}=TOPIC"
        topic = _select_topic(topics, topic, f"poses of gripper '{gripper}' (PoseStamped)", remedy)
        messages = ((time, decode(data, _POSE)) for time, data in messages_by_topic[topic][1])
    for time, message in messages:
        pose = message_fields.pose_of(message, field)
        if not np.isfinite(pose).all() or not any(pose[3:]):
            raise FitError(f"a pose on {topic} is {pose}; it must be finite, with a unit quaternion")
        yield message_fields.stamp_of(message), time, message_fields.frame_of(message), pose


def _read_cloud(
    data: bytes, time: int, frame: str | None, count: int, matched: bool, index_field: str
) -> tuple[int, int, str, NDArray[np.float64]]:
    """Return stamp and log time [ns], frame, and points [m] of a cloud: of a matched one a row for each particle."""
    from cloth_sim_ros.session.cdr import decode, decode_cloud

    cloud = decode_cloud(data)
    if frame is not None and cloud.frame_id not in ("", frame):
        frames = f"in frame '{cloud.frame_id}', the scene in '{frame}'"
        raise FitError(f"a cloud is given {frames}; give --camera-pose, transform it, or set frame_id")
    points = np.array(cloud.xyz, dtype=np.float64)
    if not matched:
        return cloud.stamp, time, cloud.frame_id, points[visible_mask(points)]
    indices = _read_indices(decode(data, _CLOUD), index_field)
    if indices is None:
        return cloud.stamp, time, cloud.frame_id, points
    wrong = np.flatnonzero((indices < 0) | (indices >= count))
    if wrong.size:
        raise FitError(f"a point of a cloud names particle {indices[wrong[0]]}; there are {count}, from index 0")
    return cloud.stamp, time, cloud.frame_id, _order_points(points, indices, count)


def _order_points(points: NDArray[np.float64], indices: ArrayLike, count: int) -> NDArray[np.float64]:
    """Return a row for each of `count` particles, NaN without a point. `indices`: particle of each point."""
    particles = np.asarray(indices, dtype=np.int64)
    n_points = np.bincount(particles, minlength=count)
    if n_points.max(initial=0) > 1:
        particle = int(np.argmax(n_points))
        raise FitError(f"particle {particle} has {n_points[particle]} points in a cloud; each particle has one")
    ordered = np.full((count, 3), np.nan)
    ordered[particles] = points
    return ordered


def _read_indices(message: Any, index_field: str) -> NDArray[np.int64] | None:
    """Return the particle of each point of a PointCloud2, shape (points,); None if the points have no numbers.

    Args:
        message: the decoded cloud.
        index_field: name of the field; empty for one of the usual names.
    """
    names = (index_field,) if index_field else _INDEX_FIELDS
    fields = sorted((field for field in message.fields if field.name in names), key=lambda f: names.index(f.name))
    if not fields:
        if index_field:
            available = ", ".join(field.name for field in message.fields)
            raise FitError(f"a cloud's points have no field '{index_field}' (--index); they have {available}")
        return None
    field = fields[0]
    kind = np.dtype(_FIELD_TYPES.get(field.datatype, "V0"))
    if not kind.itemsize or field.count != 1 or field.offset + kind.itemsize > message.point_step:
        layout = f"has type {field.datatype}, count {field.count} and offset {field.offset}"
        raise FitError(f"field '{field.name}' of a cloud {layout}; it must hold a number for each point")
    if not message.height * message.width:
        # Numpy refuses the strides of a buffer without bytes.
        return np.zeros(0, dtype=np.int64)
    values = np.ndarray(
        (message.height, message.width),
        dtype=kind.newbyteorder(">" if message.is_bigendian else "<"),
        buffer=np.ascontiguousarray(message.data),
        offset=field.offset,
        strides=(message.row_step, message.point_step),
    ).ravel()
    if kind.kind == "f":
        if not (np.isfinite(values) & (values == np.round(values))).all():
            raise FitError(f"field '{field.name}' of a cloud has the type {kind.name} and numbers that are not whole")
        values = np.clip(values, -1.0, 2.0**32)
    return values.astype(np.int64)
