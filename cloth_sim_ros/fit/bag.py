# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Reader of a real cloth's MCAP: clouds and gripper poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.fit.grasped import (
    GRASP_SPAN,
    GraspedParticles,
    check_distinct,
    find_grasped,
    find_grasped_at_rest,
    parse_all_grasped,
)
from cloth_sim_ros.fit.motion import GripperPath, check_rest
from cloth_sim_ros.fit.parameters import FitError
from cloth_sim_ros.fit.recording import FitRecording, visible
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.gripper_path import rotation_matrix
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.bodies.grippers import Grippers
from cloth_sim_ros.simulation.events import Event, Grasp, Target

_CLOUD, _POSE, _BOOL = "sensor_msgs/msg/PointCloud2", "geometry_msgs/msg/PoseStamped", "std_msgs/msg/Bool"
#: Names of a cloud's field with the particle index, and numpy types of PointField's integer types.
_INDEX_FIELDS, _INTEGER_TYPES = ("index", "id", "particle"), {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4"}
#: Longest accepted recording [s].
MAX_DURATION = 3600.0


@attrs.define(kw_only=True)
class _Track:
    """Recorded poses and grasps of a gripper."""

    #: Stamps of the poses [ns], in the order of the file.
    stamps: list[int] = attrs.field(factory=list)
    #: Positions [m] and quaternions x, y, z, w.
    poses: list[list[float]] = attrs.field(factory=list)
    #: Stamps [ns] of its grasps, and true if closed.
    grasps: list[tuple[int, bool]] = attrs.field(factory=list)

    def is_closed(self, stamp: int) -> bool:
        """Return True if it holds particles at a stamp [ns]: closed by its last grasp, or without any grasp."""
        grasps = [closed for time, closed in self.grasps if time <= stamp]
        return not grasps or grasps[-1]

    def pose_at(self, stamp: float) -> tuple[list[float], list[float]]:
        """Return position [m] and quaternion at a stamp [ns], linear between poses and constant outside them."""
        order = np.argsort(np.array(self.stamps), kind="stable")
        times, poses = np.array(self.stamps, dtype=np.float64)[order], np.array(self.poses)[order]
        k = int(np.clip(np.searchsorted(times, stamp, side="right") - 1, 0, max(len(times) - 2, 0)))
        after = min(k + 1, len(times) - 1)
        span = times[after] - times[k]
        fraction = float(np.clip((stamp - times[k]) / span, 0.0, 1.0)) if span > 0.0 else 0.0
        pose_before, pose_after = poses[k], poses[after].copy()
        if float(pose_before[3:] @ pose_after[3:]) < 0.0:
            pose_after[3:] *= -1.0
        pose = (1.0 - fraction) * pose_before + fraction * pose_after
        pose[3:] /= np.sqrt(float(pose[3:] @ pose[3:]))
        return pose[:3].tolist(), pose[3:].tolist()


def _gripper_path(track: _Track, start: int) -> GripperPath:
    """Return the path of a gripper over the time since a stamp [ns]."""
    order = np.argsort(np.array(track.stamps), kind="stable")
    times = np.asarray(1e-9 * (np.array(track.stamps, dtype=np.int64)[order] - start), dtype=np.float64)
    return GripperPath(times=times, positions=np.array(track.poses)[order, :3])


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
        paths: MCAP files with messages in CDR.
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
    named_particles = parse_all_grasped(scene, grasped or {})
    if not (np.isfinite(settle_time) and 0.0 <= settle_time <= MAX_DURATION):
        raise FitError(f"--settle is {settle_time:g} s; it must be from 0 to {MAX_DURATION:g}")
    messages_by_topic = _read_messages(paths)
    cloud_topics = [name for name, (kind, _) in messages_by_topic.items() if kind == _CLOUD]
    cloud_topic = _select_topic(cloud_topics, topic, "clouds (PointCloud2)", "--topic NAME")
    tracks = {name: _read_track(messages_by_topic, name, dict(poses or {}).get(name)) for name in scene.gripper_names}
    unknown = [name for name in poses or {} if name not in tracks]
    if unknown:
        raise FitError(f"--pose names '{unknown[0]}'; the scene's grippers are {', '.join(tracks) or 'none'}")
    count = len(scene.initial_positions())
    cloud_messages = messages_by_topic[cloud_topic][1]
    stamped_clouds = [_read_cloud(data, time, scene, count, matched) for time, data in cloud_messages]
    stamped_clouds.sort(key=lambda entry: entry[0])
    stamps = np.array([stamp for stamp, _ in stamped_clouds], dtype=np.int64)
    if not stamps.size:
        raise FitError(f"{paths[0]} holds no cloud on {cloud_topic}")
    last_time = 1e-9 * (stamps[-1] - stamps[0])
    if not (np.isfinite(first_time) and 0.0 <= first_time <= last_time):
        raise FitError(f"--from is {first_time:g} s; it must be from 0 to {last_time:.2f}, the last cloud")
    is_used = stamps >= stamps[0] + round(1e9 * first_time) - 1_000_000
    stamped_clouds = [entry for entry, is_late in zip(stamped_clouds, is_used, strict=True) if is_late]
    stamps = stamps[is_used]
    is_first = np.concatenate([[True], np.diff(stamps) > 0])
    seconds = (stamps[is_first] - stamps[0]) * 1e-9
    clouds = [cloud for (_, cloud), is_new in zip(stamped_clouds, is_first, strict=True) if is_new]
    if seconds[-1] > MAX_DURATION:
        span = f"clouds span {seconds[-1]:.0f} s; the limit is {MAX_DURATION:g} s"
        raise FitError(f"{span}. Stamp all messages by one clock")
    for name, track in tracks.items():
        if min(track.stamps) > stamps[-1] or max(track.stamps) < stamps[0] - 60 * 10**9:
            raise FitError(
                f"poses of gripper '{name}' and clouds do not overlap in time: stamps of "
                f"{min(track.stamps) * 1e-9:.3f} to {max(track.stamps) * 1e-9:.3f} s and {stamps[0] * 1e-9:.3f} to "
                f"{stamps[-1] * 1e-9:.3f} s; stamp both by one clock"
            )
    n_settle_frames = max(round(settle_time * scene.rate), 1)
    frames = n_settle_frames + seconds * scene.rate
    start = int(stamps[0])
    closed = _closed_grippers(scene, tracks, start)
    open_grippers = [name for name in named_particles if name not in closed]
    if open_grippers:
        raise FitError(f"--held names '{open_grippers[0]}', which is open at the first cloud")
    gripper_paths = {name: _gripper_path(tracks[name], start) for name in closed}
    check_rest(clouds if matched else (), seconds, scene.sheet.positions(), gripper_paths)
    closed_tracks = {name: tracks[name] for name in closed}
    state, grasped_particles = _initial_state(scene, clouds, seconds, matched, closed_tracks, start, named_particles)
    grasping = [entry.gripper for entry in grasped_particles]
    return FitRecording(
        name=", ".join(Path(path).name for path in paths),
        scene=scene,
        state=state,
        events=tuple(_events(scene, tracks, start, n_settle_frames, int(np.ceil(frames[-1] - 1e-9)), grasping)),
        frames=frames,
        seconds=seconds,
        clouds=tuple(clouds),
        matched=matched,
        n_settle_frames=n_settle_frames,
        has_shift=matched,
        grasped=tuple(grasped_particles),
    )


def _closed_grippers(scene: Scene, tracks: Mapping[str, _Track], stamp: int) -> list[str]:
    """Return the grippers that hold particles at a stamp [ns]: closed by their last grasp, or without any grasp."""
    return [name for name, track in tracks.items() if not scene.pinches(name) and track.is_closed(stamp)]


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
    messages_by_topic: Mapping[str, tuple[str, list[tuple[int, bytes]]]], gripper: str, requested: str | None
) -> _Track:
    from cloth_sim_ros.session.cdr import decode

    topics = [name for name, (kind, _) in messages_by_topic.items() if kind == _POSE]
    if requested is None:
        matching = [name for name in topics if name.endswith((f"/{gripper}/target", f"/{gripper}/pose"))]
        topics = matching or topics
    topic = _select_topic(topics, requested, f"poses of gripper '{gripper}' (PoseStamped)", f"--pose {gripper}=TOPIC")
    track = _Track()
    for time, data in messages_by_topic[topic][1]:
        message = decode(data, _POSE)
        p, q = message.pose.position, message.pose.orientation
        pose = [p.x, p.y, p.z, q.x, q.y, q.z, q.w]
        if not np.isfinite(pose).all() or not any(pose[3:]):
            raise FitError(f"a pose on {topic} is {pose}; it must be finite, with a unit quaternion")
        track.stamps.append(_stamp(message.header) or time)
        track.poses.append(pose)
    for name, (kind, messages) in messages_by_topic.items():
        if kind == _BOOL and name.endswith(f"/{gripper}/grasp"):
            track.grasps = [(time, bool(decode(data, _BOOL).data)) for time, data in messages]
    return track


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


def _initial_state(
    scene: Scene,
    clouds: Sequence[Array],
    seconds: NDArray[np.float64],
    matched: bool,
    tracks: Mapping[str, _Track],
    stamp: int,
    named_particles: Mapping[str, Sequence[int]],
) -> tuple[State | None, list[GraspedParticles]]:
    """Return an initial state near the first cloud, and the grasped particles.

    The cloth settles from this state. Gaps of a matched cloud are filled. Bare points deform the scene's flat sheet.
    Grasped particles lie at their gripper's origin, anchors at the scene's positions. The state is None if
    the cloud has no usable point.
    """
    rest_positions, cloud = scene.initial_positions(), clouds[0]
    seen = cloud[visible(cloud)]
    if not len(seen) or (matched and len(cloud) != len(rest_positions)):
        return None, []
    poses = {name: track.pose_at(stamp) for name, track in tracks.items()}
    grasped: list[GraspedParticles] = []
    if matched:
        x = cloud.copy()
        for name, track in tracks.items():
            cloud_indices = _clouds_while_grasped(clouds, seconds, track, stamp)
            grasped_clouds = [clouds[k] for k in cloud_indices]
            cloud_poses = [track.pose_at(stamp + 1e9 * seconds[k]) for k in cloud_indices]
            local_poses = [(*position, *turn) for position, turn in cloud_poses]
            known = named_particles.get(name, ())
            selection, local_positions = find_grasped(scene, name, grasped_clouds, local_poses, known)
            position, turn = poses[name]
            particles = list(selection.particles)
            x[particles] = np.array(position) + local_positions[particles] @ np.array(rotation_matrix(np.array(turn))).T
            grasped.append(selection)
        anchors = scene.anchored_particles()
        x[anchors] = rest_positions[anchors]
        x = _fill_gaps(x, scene.sheet.triangles())
    else:
        grasped = [find_grasped_at_rest(scene, name, poses[name][0], named_particles.get(name, ())) for name in tracks]
        positions = {selection.particles[0]: np.array(poses[selection.gripper][0]) for selection in grasped}
        x = _deform_sheet(rest_positions, seen, positions)
        anchors = scene.anchored_particles()
        x[anchors] = rest_positions[anchors]
    state = State(x, cloth=scene.starting_state().cloth)
    check_distinct(grasped)
    grippers = Grippers(scene.gripper_names, state)
    for selection in grasped:
        grippers.set_target(Target(selection.gripper, *poses[selection.gripper]))
        grippers.attach(selection.gripper, np.setdiff1d(selection.particles, anchors))
    return state, grasped


def _clouds_while_grasped(
    clouds: Sequence[Array], seconds: NDArray[np.float64], track: _Track, stamp: int
) -> NDArray[np.int64]:
    """Return the indices of the clouds of the first second before a gripper opens: they show its grasped particles."""
    opening_times = [1e-9 * (time - stamp) for time, closed in track.grasps if time > stamp and not closed]
    is_whole = [len(cloud) == len(clouds[0]) for cloud in clouds]
    return np.flatnonzero((seconds <= GRASP_SPAN) & (seconds < min(opening_times, default=np.inf)) & np.array(is_whole))


def _deform_sheet(rest_positions: Array, points: Array, grasped_positions: Mapping[int, Array]) -> Array:
    """Return a flat sheet, moved to the grasped particles and deformed along its normal to the nearest points."""
    from scipy.spatial import cKDTree

    x, grasped = rest_positions.copy(), list(grasped_positions)
    if grasped:
        distances = np.sqrt(np.square(rest_positions[:, None] - rest_positions[grasped]).sum(axis=2))
        weights = 1.0 / np.square(np.maximum(distances, 1e-6))
        weights /= weights.sum(axis=1, keepdims=True)
        x += weights @ (np.array([grasped_positions[particle] for particle in grasped]) - rest_positions[grasped])
    normal = np.linalg.svd(rest_positions - rest_positions.mean(axis=0), full_matrices=False)[2][2]
    _, nearest = cKDTree(points).query(x, k=min(8, len(points)))
    local_means = points[np.asarray(nearest).reshape(len(x), -1)].mean(axis=1)
    x = np.asarray(x + ((local_means - x) @ normal)[:, None] * normal)
    for particle, position in grasped_positions.items():
        x[particle] = position
    return x


def _fill_gaps(cloud: Array, triangles: NDArray[np.integer]) -> Array:
    """Return a cloud with each gap filled by the mean of its neighbours (Jacobi iteration)."""
    x, seen = cloud.copy(), visible(cloud)
    x[~seen] = cloud[seen].mean(axis=0)
    pairs = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]).astype(np.int64)
    pairs = np.unique(np.sort(pairs, axis=1), axis=0)
    degree = np.bincount(pairs.ravel(), minlength=len(x)).clip(1)[:, None]
    for _ in range(2000 if not seen.all() else 0):
        sums = np.zeros_like(x)
        np.add.at(sums, pairs[:, 0], x[pairs[:, 1]])
        np.add.at(sums, pairs[:, 1], x[pairs[:, 0]])
        means = sums / degree
        change = float(np.abs(means[~seen] - x[~seen]).max())
        x[~seen] = means[~seen]
        if change < 1e-5:
            break
    return x


def _events(
    scene: Scene,
    tracks: Mapping[str, _Track],
    first_stamp: int,
    n_settle_frames: int,
    frames: int,
    grasping: Sequence[str],
) -> list[tuple[Event, ...]]:
    """Return the events of each frame: grippers close at their first pose, wait while settling, then follow the poses.

    Grippers that hold particles already do not close again.
    """
    period = scene.period * 1e9
    events: list[tuple[Event, ...]] = []
    for k in range(frames):
        stamp = first_stamp + max(k + 1 - n_settle_frames, 0) * period
        frame_events: list[Event] = []
        for name, track in tracks.items():
            if not k or k >= n_settle_frames:
                frame_events.append(Target(name, *track.pose_at(stamp)))
            if not k and name not in grasping and track.is_closed(first_stamp):
                frame_events.append(Grasp(name, True))
            grasps = track.grasps if k >= n_settle_frames else ()
            frame_events += [Grasp(name, closed) for time, closed in grasps if stamp - period < time <= stamp]
        events.append(tuple(frame_events))
    return events


def _stamp(header: Any) -> int:
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)
