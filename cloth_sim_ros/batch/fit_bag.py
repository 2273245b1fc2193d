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

from cloth_sim_ros.batch.fit_held import SPAN, HeldParticles, check_distinct, find_held, parse_all_held, rest_held
from cloth_sim_ros.batch.fit_motion import GripperPath, check_rest
from cloth_sim_ros.batch.fit_parameters import FitError
from cloth_sim_ros.batch.fit_recording import Recording, visible
from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.gripper_path import rotation_matrix
from cloth_sim_ros.physics.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Event, Grasp, Target
from cloth_sim_ros.simulation.grippers import Grippers

_CLOUD, _POSE, _BOOL = "sensor_msgs/msg/PointCloud2", "geometry_msgs/msg/PoseStamped", "std_msgs/msg/Bool"
#: Names of a cloud's field with the particle index, and numpy types of PointField's integer types.
_NUMBERS, _KINDS = ("index", "id", "particle"), {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4"}
#: Longest accepted recording [s].
LONGEST = 3600.0


@attrs.define(kw_only=True)
class _Track:
    """Recorded poses and grasps of a gripper."""

    #: Stamps of the poses [ns], in the order of the file.
    stamps: list[int] = attrs.field(factory=list)
    #: Positions [m] and quaternions x, y, z, w.
    poses: list[list[float]] = attrs.field(factory=list)
    #: Stamps [ns] of its grasps, and true if closed.
    grasps: list[tuple[int, bool]] = attrs.field(factory=list)

    def at(self, stamp: float) -> tuple[list[float], list[float]]:
        """Return position [m] and quaternion at a stamp [ns], linear between poses and constant outside them."""
        order = np.argsort(np.array(self.stamps), kind="stable")
        times, poses = np.array(self.stamps, dtype=np.float64)[order], np.array(self.poses)[order]
        k = int(np.clip(np.searchsorted(times, stamp, side="right") - 1, 0, max(len(times) - 2, 0)))
        after = min(k + 1, len(times) - 1)
        span = times[after] - times[k]
        share = float(np.clip((stamp - times[k]) / span, 0.0, 1.0)) if span > 0.0 else 0.0
        one, two = poses[k], poses[after].copy()
        if float(one[3:] @ two[3:]) < 0.0:
            two[3:] *= -1.0
        pose = (1.0 - share) * one + share * two
        pose[3:] /= np.sqrt(float(pose[3:] @ pose[3:]))
        return pose[:3].tolist(), pose[3:].tolist()


def _path(track: _Track, start: int) -> GripperPath:
    """Return the path of a gripper over the time since a stamp [ns]."""
    order = np.argsort(np.array(track.stamps), kind="stable")
    times = np.asarray(1e-9 * (np.array(track.stamps, dtype=np.int64)[order] - start), dtype=np.float64)
    return GripperPath(times=times, places=np.array(track.poses)[order, :3])


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
    settle: float = 4.0,
    matched: bool = True,
    held: Mapping[str, str] | None = None,
    begin: float = 0.0,
) -> Recording:
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
    named = parse_all_held(scene, held or {})
    if not (np.isfinite(settle) and 0.0 <= settle <= LONGEST):
        raise FitError(f"--settle is {settle:g} s; it must be from 0 to {LONGEST:g}")
    heard = _heard(paths)
    cloud_topic = _one(
        [name for name, (kind, _) in heard.items() if kind == _CLOUD], topic, "clouds (PointCloud2)", "--topic NAME"
    )
    tracks = {name: _track(heard, name, dict(poses or {}).get(name)) for name in scene.gripper_names}
    unknown = [name for name in poses or {} if name not in tracks]
    if unknown:
        raise FitError(f"--pose names '{unknown[0]}'; the scene's grippers are {', '.join(tracks) or 'none'}")
    count = len(scene.initial_positions())
    seen = sorted(
        (_cloud(data, time, scene, count, matched) for time, data in heard[cloud_topic][1]), key=lambda entry: entry[0]
    )
    stamps = np.array([stamp for stamp, _ in seen], dtype=np.int64)
    if not stamps.size:
        raise FitError(f"{paths[0]} holds no cloud on {cloud_topic}")
    if not (np.isfinite(begin) and 0.0 <= begin <= 1e-9 * (stamps[-1] - stamps[0])):
        raise FitError(
            f"--from is {begin:g} s; it must be from 0 to {1e-9 * (stamps[-1] - stamps[0]):.2f}, the last cloud"
        )
    late = stamps >= stamps[0] + round(1e9 * begin) - 1_000_000
    seen, stamps = [entry for entry, is_late in zip(seen, late, strict=True) if is_late], stamps[late]
    first = np.concatenate([[True], np.diff(stamps) > 0])
    seconds = (stamps[first] - stamps[0]) * 1e-9
    clouds = [cloud for (_, cloud), new in zip(seen, first, strict=True) if new]
    if seconds[-1] > LONGEST:
        raise FitError(f"clouds span {seconds[-1]:.0f} s; the limit is {LONGEST:g} s. Stamp all messages by one clock")
    for name, track in tracks.items():
        if min(track.stamps) > stamps[-1] or max(track.stamps) < stamps[0] - 60 * 10**9:
            raise FitError(
                f"poses of gripper '{name}' and clouds do not overlap in time: stamps of "
                f"{min(track.stamps) * 1e-9:.3f} to {max(track.stamps) * 1e-9:.3f} s and {stamps[0] * 1e-9:.3f} to "
                f"{stamps[-1] * 1e-9:.3f} s; stamp both by one clock"
            )
    lead = max(round(settle * scene.rate), 1)
    frames = lead + seconds * scene.rate
    start = int(stamps[0])
    closed = _closed(scene, tracks, start)
    open_ones = [name for name in named if name not in closed]
    if open_ones:
        raise FitError(f"--held names '{open_ones[0]}', which is open at the first cloud")
    led = {name: _path(tracks[name], start) for name in closed}
    check_rest(clouds if matched else (), seconds, scene.sheet.positions(), led)
    state, held_particles = _start(
        scene, clouds, seconds, matched, {name: tracks[name] for name in closed}, start, named
    )
    return Recording(
        name=", ".join(Path(path).name for path in paths),
        scene=scene,
        state=state,
        events=tuple(
            _events(
                scene, tracks, start, lead, int(np.ceil(frames[-1] - 1e-9)), [entry.gripper for entry in held_particles]
            )
        ),
        frames=frames,
        seconds=seconds,
        clouds=tuple(clouds),
        matched=matched,
        lead=lead,
        shifted=matched,
        held=tuple(held_particles),
    )


def _closed(scene: Scene, tracks: Mapping[str, _Track], begin: int) -> list[str]:
    """Return the grippers that hold particles at a stamp [ns]: closed by their last grasp, or without any grasp."""
    before = {name: [closed for time, closed in track.grasps if time <= begin] for name, track in tracks.items()}
    return [name for name, said in before.items() if not scene.pinches(name) and (not said or said[-1])]


def _heard(paths: Sequence[Path]) -> dict[str, tuple[str, list[tuple[int, bytes]]]]:
    """Read the messages of clouds, poses and grasps: for each topic, the type, log times [ns] and bytes."""
    from cloth_sim_ros.session.bag import bag_messages
    from cloth_sim_ros.session.errors import DamagedSessionError

    heard: dict[str, tuple[str, list[tuple[int, bytes]]]] = {}
    for path in paths:
        try:
            for topic, kind, time, data in bag_messages(path):
                if kind in (_CLOUD, _POSE, _BOOL):
                    heard.setdefault(topic, (kind, []))[1].append((time, data))
        except DamagedSessionError as error:
            raise FitError(str(error)) from error
    return heard


def _one(found: Sequence[str], asked: str | None, what: str, remedy: str) -> str:
    if asked is not None:
        if asked not in found:
            raise FitError(f"there is no topic '{asked}' of {what}; available: {', '.join(found) or 'none'}")
        return asked
    if len(found) != 1:
        raise FitError(f"{len(found)} topics hold {what}: {', '.join(found) or 'none'}; select one by {remedy}")
    return found[0]


def _track(heard: Mapping[str, tuple[str, list[tuple[int, bytes]]]], gripper: str, asked: str | None) -> _Track:
    from cloth_sim_ros.session.cdr import decode

    found = [name for name, (kind, _) in heard.items() if kind == _POSE]
    if asked is None:
        ending = [name for name in found if name.endswith((f"/{gripper}/target", f"/{gripper}/pose"))]
        found = ending or found
    topic = _one(found, asked, f"poses of gripper '{gripper}' (PoseStamped)", f"--pose {gripper}=TOPIC")
    track = _Track()
    for time, data in heard[topic][1]:
        message = decode(data, _POSE)
        p, q = message.pose.position, message.pose.orientation
        pose = [p.x, p.y, p.z, q.x, q.y, q.z, q.w]
        if not np.isfinite(pose).all() or not any(pose[3:]):
            raise FitError(f"a pose on {topic} is {pose}; it must be finite, with a unit quaternion")
        track.stamps.append(_stamp(message.header) or time)
        track.poses.append(pose)
    for name, (kind, messages) in heard.items():
        if kind == _BOOL and name.endswith(f"/{gripper}/grasp"):
            track.grasps = [(time, bool(decode(data, _BOOL).data)) for time, data in messages]
    return track


def _cloud(data: bytes, time: int, scene: Scene, count: int, matched: bool) -> tuple[int, NDArray[np.float64]]:
    """Return stamp [ns] and points [m] of a cloud; a matched cloud has a row for each particle, NaN if unseen."""
    from cloth_sim_ros.session.cdr import decode, decode_cloud

    cloud = decode_cloud(data)
    if cloud.frame_id not in ("", scene.frame_id):
        raise FitError(
            f"a cloud is given in frame '{cloud.frame_id}', the scene in '{scene.frame_id}'; transform it, or set "
            "frame_id"
        )
    points = np.array(cloud.xyz, dtype=np.float64)
    if not matched:
        return cloud.stamp or time, points[visible(points)]
    message = decode(data, _CLOUD)
    fields = [field for field in message.fields if field.name in _NUMBERS and field.datatype in _KINDS]
    if not fields:
        return cloud.stamp or time, points
    order = ">" if message.is_bigendian else "<"
    numbers = np.ndarray(
        (message.height, message.width),
        dtype=order + _KINDS[fields[0].datatype],
        buffer=np.ascontiguousarray(message.data),
        offset=fields[0].offset,
        strides=(message.row_step, message.point_step),
    ).ravel()
    wrong = np.flatnonzero((numbers < 0) | (numbers >= count))
    if wrong.size:
        raise FitError(
            f"a cloud's field '{fields[0].name}' names particle {numbers[wrong[0]]}; there are {count}, from index 0"
        )
    whole = np.full((count, 3), np.nan)
    whole[numbers.astype(np.int64)] = points
    return cloud.stamp or time, whole


def _start(
    scene: Scene,
    clouds: Sequence[Array],
    seconds: NDArray[np.float64],
    matched: bool,
    tracks: Mapping[str, _Track],
    begin: int,
    named: Mapping[str, Sequence[int]],
) -> tuple[State | None, list[HeldParticles]]:
    """Return an initial state near the first cloud, and the grasped particles.

    The cloth settles from this state. Gaps of a matched cloud are filled. Bare points deform the scene's flat sheet.
    Grasped particles lie at their gripper's origin, anchors at the scene's positions. The state is None if
    the cloud has no usable point.
    """
    rest, cloud = scene.initial_positions(), clouds[0]
    seen = cloud[visible(cloud)]
    if not len(seen) or (matched and len(cloud) != len(rest)):
        return None, []
    poses = {name: track.at(begin) for name, track in tracks.items()}
    selected: list[HeldParticles] = []
    if matched:
        x = cloud.copy()
        for name, track in tracks.items():
            used = _held_clouds(clouds, seconds, track, begin)
            at = [[value for part in track.at(begin + 1e9 * seconds[k]) for value in part] for k in used]
            selection, local = find_held(scene, name, [clouds[k] for k in used], at, named.get(name, ()))
            position, turn = poses[name]
            particles = list(selection.particles)
            x[particles] = np.array(position) + local[particles] @ np.array(rotation_matrix(np.array(turn))).T
            selected.append(selection)
        anchors = scene.anchored_particles()
        x[anchors] = rest[anchors]
        x = _filled(x, scene.sheet.triangles())
    else:
        selected = [rest_held(scene, name, poses[name][0], named.get(name, ())) for name in tracks]
        x = _bent(rest, seen, {selection.particles[0]: np.array(poses[selection.gripper][0]) for selection in selected})
        anchors = scene.anchored_particles()
        x[anchors] = rest[anchors]
    state = State(x, cloth=scene.starting_state().cloth)
    check_distinct(selected)
    grippers = Grippers(scene.gripper_names, state)
    for selection in selected:
        grippers.set_target(Target(selection.gripper, *poses[selection.gripper]))
        grippers.take(selection.gripper, np.setdiff1d(selection.particles, anchors))
    return state, selected


def _held_clouds(clouds: Sequence[Array], seconds: NDArray[np.float64], track: _Track, begin: int) -> NDArray[np.int64]:
    """Return the indices of the clouds of the first second before a gripper opens: they show its grasped particles."""
    opens = [1e-9 * (time - begin) for time, closed in track.grasps if time > begin and not closed]
    whole = [len(cloud) == len(clouds[0]) for cloud in clouds]
    return np.flatnonzero((seconds <= SPAN) & (seconds < min(opens, default=np.inf)) & np.array(whole))


def _bent(rest: Array, points: Array, places: Mapping[int, Array]) -> Array:
    """Return a flat sheet, moved to the grasped particles and deformed along its normal to the nearest points."""
    from scipy.spatial import cKDTree

    x, held = rest.copy(), list(places)
    if held:
        away = np.sqrt(np.square(rest[:, None] - rest[held]).sum(axis=2))
        shares = 1.0 / np.square(np.maximum(away, 1e-6))
        shares /= shares.sum(axis=1, keepdims=True)
        x += shares @ (np.array([places[particle] for particle in held]) - rest[held])
    across = np.linalg.svd(rest - rest.mean(axis=0), full_matrices=False)[2][2]
    _, near = cKDTree(points).query(x, k=min(8, len(points)))
    about = points[np.asarray(near).reshape(len(x), -1)].mean(axis=1)
    x = np.asarray(x + ((about - x) @ across)[:, None] * across)
    for particle, position in places.items():
        x[particle] = position
    return x


def _filled(cloud: Array, triangles: NDArray[np.integer]) -> Array:
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
        moved = sums / degree
        change = float(np.abs(moved[~seen] - x[~seen]).max())
        x[~seen] = moved[~seen]
        if change < 1e-5:
            break
    return x


def _events(
    scene: Scene, tracks: Mapping[str, _Track], begin: int, lead: int, frames: int, holding: Sequence[str]
) -> list[tuple[Event, ...]]:
    """Return the events of each frame: grippers close at their first pose, wait while settling, then follow the poses.

    Grippers that hold particles already do not close again.
    """
    period = scene.period * 1e9
    events: list[tuple[Event, ...]] = []
    for k in range(frames):
        stamp = begin + max(k + 1 - lead, 0) * period
        now: list[Event] = []
        for name, track in tracks.items():
            if not k or k >= lead:
                now.append(Target(name, *track.at(stamp)))
            before = [closed for time, closed in track.grasps if time <= begin]
            if not k and name not in holding and (not before or before[-1]):
                now.append(Grasp(name, True))
            now += [
                Grasp(name, closed) for time, closed in track.grasps if k >= lead and stamp - period < time <= stamp
            ]
        events.append(tuple(now))
    return events


def _stamp(header: Any) -> int:
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)
