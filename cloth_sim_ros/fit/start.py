# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Start of a simulation from a recording of a real cloth: its initial state, and the events of each frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.fit.grasped import (
    GRASP_SPAN,
    GraspedParticles,
    check_no_common_particle,
    find_grasped,
    find_grasped_at_rest,
    parse_all_grasped,
)
from cloth_sim_ros.fit.motion import GripperPath, check_grippers_rest, check_rest, moving_speed
from cloth_sim_ros.fit.parameters import FitError
from cloth_sim_ros.fit.recorded import MAX_DURATION, MAX_POSE_GAP, RecordedGripper, Recording
from cloth_sim_ros.fit.recording import FitRecording, visible_mask
from cloth_sim_ros.fit.screening import MAX_SCALE, MIN_SCALE, size_ratio
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.gripper_path import rotation_matrix
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.bodies.grippers import Grippers
from cloth_sim_ros.simulation.events import Event, Grasp, Target

#: Default of the settling time [s].
SETTLE_TIME = 4.0
#: Least fraction of visible particles of a cloud that gives the initial shape.
_MIN_VISIBLE = 0.3
#: Largest change of a coordinate [m], or of a quaternion's component, of a gripper that has not moved yet.
_STILL = 5e-3


def rest_recording(
    recording: Recording, scene: Scene, *, settle_time: float = SETTLE_TIME, grasped: Mapping[str, str] | None = None
) -> FitRecording:
    """Return a recording for a fit whose cloth settles, then hangs at rest at the first cloud. Raises FitError.

    Args:
        recording: clouds and gripper poses.
        scene: the cloth and its grippers.
        settle_time: settling time of the simulated cloth before the first cloud [s].
        grasped: grasped particles by gripper, such as ``12,13`` or ``top_left``; by default, found from the clouds.

    Raises:
        FitError: if the recording is unusable; the text names cause and remedy.
    """
    named_particles = parse_all_grasped(scene, grasped or {})
    n_settle_frames = settle_frame_count(scene, settle_time)
    tracks, start = recording.grippers, float(recording.times[0])
    seconds = recording.times - start
    closed = closed_grippers(scene, tracks, start, named_particles)
    paths = {name: gripper_path(tracks[name], start) for name in closed}
    check_rest(recording.clouds if recording.matched else (), seconds, scene.sheet.positions(), paths)
    closed_tracks = {name: tracks[name] for name in closed}
    state, selections = _initial_state(recording, scene, closed_tracks, named_particles)
    frames = n_settle_frames + seconds * scene.rate
    grasping = [entry.gripper for entry in selections]
    n_frames = int(np.ceil(frames[-1] - 1e-9))
    return FitRecording(
        name=recording.name,
        scene=scene,
        state=state,
        events=tuple(_events(scene, tracks, start, n_settle_frames, n_frames, grasping)),
        frames=frames,
        seconds=seconds,
        clouds=recording.clouds,
        matched=recording.matched,
        n_settle_frames=n_settle_frames,
        has_shift=recording.matched,
        grasped=tuple(selections),
    )


def motion_recording(
    recording: Recording,
    scene: Scene,
    selections: Sequence[GraspedParticles],
    *,
    settle_time: float = SETTLE_TIME,
    max_offset: float = 0.0,
) -> FitRecording:
    """Return a recording for a fit, simulated from before the first to after the last cloud. Raises FitError.

    The cloth hangs at rest in its grippers at the start. Clouds may be late or early by `max_offset`.

    Args:
        recording: clouds and gripper poses.
        scene: the cloth and its grippers.
        selections: grasped particles of each gripper that is closed at the start.
        settle_time: settling time of the simulated cloth before the start [s].
        max_offset: largest time offset of the clouds [s].

    Raises:
        FitError: if a gripper moves at the start, or its poses begin or end while it moves, far from the clouds' times.
    """
    n_settle_frames = settle_frame_count(scene, settle_time)
    start = start_time(recording, scene, max_offset)
    _check_coverage(recording, scene, max_offset)
    frames = n_settle_frames + (recording.times - start) * scene.rate
    n_frames = int(np.ceil(frames[-1] + max_offset * scene.rate - 1e-9))
    grasping = [selection.gripper for selection in selections]
    return FitRecording(
        name=recording.name,
        scene=scene,
        state=hanging_state(recording, scene, selections, start),
        events=tuple(_events(scene, recording.grippers, start, n_settle_frames, n_frames, grasping)),
        frames=frames,
        seconds=recording.times - recording.times[0],
        clouds=recording.clouds,
        matched=recording.matched,
        n_settle_frames=n_settle_frames,
        grasped=tuple(selections),
    )


def settle_frame_count(scene: Scene, settle_time: float) -> int:
    """Return the number of settling frames before the recording, at least 1. Raises FitError for an invalid time.

    Raises:
        FitError: if the time is out of its range.
    """
    if not (np.isfinite(settle_time) and 0.0 <= settle_time <= MAX_DURATION):
        raise FitError(f"--settle is {settle_time:g} s; it must be from 0 to {MAX_DURATION:g}")
    return max(round(settle_time * scene.rate), 1)


def start_time(recording: Recording, scene: Scene, max_offset: float) -> float:
    """Return when the simulation starts [s]: `max_offset` before the first cloud, or earlier. Raises FitError.

    If a gripper moves then, the simulation starts at the first pose.

    Raises:
        FitError: if a gripper moves at both times.
    """
    latest = float(recording.times[0]) - max_offset
    tracks = {name: track for name, track in recording.grippers.items() if not scene.pinches(name)}
    first_pose = min((float(track.times[0]) for track in tracks.values()), default=latest)
    error = None
    # Before its first pose a gripper counts as still, although nobody recorded it: its first pose is checked.
    for start in (latest, first_pose) if first_pose < latest else (max(latest, first_pose),):
        paths = {name: gripper_path(track, start) for name, track in tracks.items() if track.is_closed(start)}
        try:
            check_grippers_rest(paths)
        except FitError as refused:
            error = error or refused
        else:
            return min(start, latest)
    assert error is not None
    raise FitError(
        f"{recording.name}: {error}. Begin the recording before the robot moves, or start by --from when it hangs still"
    )


def _check_coverage(recording: Recording, scene: Scene, max_offset: float) -> None:
    """Raise FitError if a closed gripper's poses begin after the first cloud, or end before the last, in motion."""
    for name, track in recording.grippers.items():
        if scene.pinches(name):
            continue
        first, last = float(track.times[0]), float(track.times[-1])
        backwards = GripperPath(times=last - track.times[::-1], positions=track.positions[::-1])
        for seconds, end, path, text, option in (
            (first - recording.times[0], first, gripper_path(track, first), "begin {:.2f} s after the first", "--from"),
            (recording.times[-1] - last, last, backwards, "end {:.2f} s before the last", "--until"),
        ):
            if seconds <= MAX_POSE_GAP + max_offset or not track.is_closed(end):
                continue
            speed = moving_speed(path)
            if speed:
                raise FitError(
                    f"{recording.name}: the poses of gripper '{name}' {text.format(seconds)} cloud, and it moves at "
                    f"{1e3 * speed:.0f} mm/s there: poses are missing. Record them all, or omit clouds by {option}"
                )


def closed_grippers(
    scene: Scene, tracks: Mapping[str, RecordedGripper], time: float, named: Mapping[str, object]
) -> list[str]:
    """Return names of grippers without pads that are closed at a time [s]. Raises FitError if an open one is named.

    Raises:
        FitError: if an open gripper is named.
    """
    closed = [name for name, track in tracks.items() if not scene.pinches(name) and track.is_closed(time)]
    open_grippers = [name for name in named if name not in closed]
    if open_grippers:
        raise FitError(f"--held names '{open_grippers[0]}', which is open at the first cloud")
    return closed


def gripper_path(track: RecordedGripper, start: float) -> GripperPath:
    """Return a gripper's recorded positions as a path over the time since a start [s]."""
    return GripperPath(times=track.times - start, positions=track.positions)


def hanging_state(recording: Recording, scene: Scene, selections: Sequence[GraspedParticles], start: float) -> State:
    """Return the state from which the cloth settles: the first cloud's shape, moved to the closed grippers.

    The cloth settles from this state. A cloud with few visible particles, of another scale or of another number of
    points is replaced by the scene's initial shape.
    """
    rest_positions, cloud = scene.initial_positions(), recording.clouds[0]
    seen = visible_mask(cloud)
    is_whole = recording.matched and len(cloud) == len(rest_positions)
    poses = {selection.gripper: recording.grippers[selection.gripper].pose_at(start) for selection in selections}
    use_cloud = is_whole and bool(seen.mean() >= _MIN_VISIBLE)
    if use_cloud:
        ratio = size_ratio(cloud[seen], scene.sheet.positions()[seen])
        use_cloud = ratio is not None and MIN_SCALE <= ratio <= MAX_SCALE
    x = fill_gaps(cloud, scene.sheet.triangles()) if use_cloud else rest_positions.copy()
    if selections:
        shifts = [
            np.array(poses[selection.gripper][0]) - x[list(selection.particles)].mean(axis=0)
            for selection in selections
        ]
        x = x + np.mean(shifts, axis=0)
    for selection in selections:
        particles = list(selection.particles)
        if len(particles) > 1:
            x[particles] = _held_shape(recording, scene, selection, start, x[particles])
        x[particles] += np.array(poses[selection.gripper][0]) - x[particles].mean(axis=0)
    anchors = scene.anchored_particles()
    x[anchors] = rest_positions[anchors]
    return _grasping_state(scene, x, selections, poses)


def _held_shape(recording: Recording, scene: Scene, selection: GraspedParticles, start: float, x: Array) -> Array:
    """Return the offsets of one gripper's particles from their mean, with the distances of the rest shape [m], (n, 3).

    They are turned to the mean of the clouds before the gripper moves. A single noisy cloud would shorten or stretch
    the cloth for the whole motion.

    Args:
        recording: clouds and gripper poses.
        scene: the cloth.
        selection: the particles.
        start: time of the still beginning [s].
        x: their places in the first cloud [m], for a camera that does not show all of them, shape (n, 3).
    """
    particles, track = list(selection.particles), recording.grippers[selection.gripper]
    begin = np.concatenate(track.pose_at(start))
    seen = []
    for time, cloud in zip(recording.times, recording.clouds, strict=True):
        if float(np.abs(np.concatenate(track.pose_at(float(time))) - begin).max()) > _STILL:
            break
        if len(cloud) == len(scene.initial_positions()) and visible_mask(cloud[particles]).all():
            seen.append(cloud[particles])
    target = np.mean(seen, axis=0) if recording.matched and seen else x
    shape = scene.sheet.positions()[particles]
    shape = shape - shape.mean(axis=0)
    u, _, vt = np.linalg.svd((target - target.mean(axis=0)).T @ shape)
    rotation = u @ np.diag([1.0, 1.0, float(np.sign(np.linalg.det(u @ vt)))]) @ vt
    return np.asarray(shape @ rotation.T)


def _grasping_state(
    scene: Scene,
    x: Array,
    selections: Sequence[GraspedParticles],
    poses: Mapping[str, tuple[list[float], list[float]]],
) -> State:
    """Return a state with particles at positions x [m] and closed grippers at their poses."""
    check_no_common_particle(selections)
    state = State(x, cloth=scene.starting_state().cloth)
    grippers = Grippers(scene.gripper_names, state)
    for selection in selections:
        grippers.set_target(Target(selection.gripper, *poses[selection.gripper]))
        grippers.attach(selection.gripper, np.setdiff1d(selection.particles, scene.anchored_particles()))
    return state


def _initial_state(
    recording: Recording,
    scene: Scene,
    tracks: Mapping[str, RecordedGripper],
    named_particles: Mapping[str, Sequence[int]],
) -> tuple[State | None, list[GraspedParticles]]:
    """Return a state near the first cloud, from which the cloth settles, and the grasped particles.

    The cloth settles from this state. Gaps of a matched cloud are filled. Bare points deform the scene's flat sheet.
    Grasped particles lie at their gripper's origin, anchors at the scene's positions. The state is None if
    the cloud has no usable point.
    """
    clouds, start = recording.clouds, float(recording.times[0])
    rest_positions, cloud = scene.initial_positions(), clouds[0]
    seen = cloud[visible_mask(cloud)]
    if not len(seen) or (recording.matched and len(cloud) != len(rest_positions)):
        return None, []
    poses = {name: track.pose_at(start) for name, track in tracks.items()}
    grasped: list[GraspedParticles] = []
    if recording.matched:
        x = cloud.copy()
        for name, track in tracks.items():
            cloud_indices = _clouds_while_grasped(recording, track)
            grasped_clouds = [clouds[k] for k in cloud_indices]
            cloud_poses = [track.pose_at(float(recording.times[k])) for k in cloud_indices]
            local_poses = [(*position, *turn) for position, turn in cloud_poses]
            known = named_particles.get(name, ())
            selection, local_positions = find_grasped(scene, name, grasped_clouds, local_poses, known)
            position, turn = poses[name]
            particles = list(selection.particles)
            x[particles] = np.array(position) + local_positions[particles] @ np.array(rotation_matrix(np.array(turn))).T
            grasped.append(selection)
        anchors = scene.anchored_particles()
        x[anchors] = rest_positions[anchors]
        x = fill_gaps(x, scene.sheet.triangles())
    else:
        grasped = [find_grasped_at_rest(scene, name, poses[name][0], named_particles.get(name, ())) for name in tracks]
        positions = {selection.particles[0]: np.array(poses[selection.gripper][0]) for selection in grasped}
        x = _deform_sheet(rest_positions, seen, positions)
        anchors = scene.anchored_particles()
        x[anchors] = rest_positions[anchors]
    return _grasping_state(scene, x, grasped, poses), grasped


def _clouds_while_grasped(recording: Recording, track: RecordedGripper) -> NDArray[np.int64]:
    """Return the indices of the clouds in the first second, before a gripper opens: they show its grasp."""
    seconds, start = recording.times - recording.times[0], float(recording.times[0])
    opening_times = [time - start for time, closed in track.grasps if time > start and not closed]
    is_whole = [len(cloud) == len(recording.clouds[0]) for cloud in recording.clouds]
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


def fill_gaps(cloud: Array, triangles: NDArray[np.integer]) -> Array:
    """Return a cloud in which hidden particles lie at the mean of their neighbours (Jacobi iteration)."""
    x, seen = cloud.copy(), visible_mask(cloud)
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
    tracks: Mapping[str, RecordedGripper],
    start: float,
    n_settle_frames: int,
    frames: int,
    grasping: Sequence[str],
) -> list[tuple[Event, ...]]:
    """Return the events of each frame: grippers close at their first pose, wait while settling, then follow the poses.

    Grippers that hold particles already do not close again.
    """
    period = scene.period
    events: list[tuple[Event, ...]] = []
    for k in range(frames):
        now = start + max(k + 1 - n_settle_frames, 0) * period
        frame_events: list[Event] = []
        for name, track in tracks.items():
            if not k or k >= n_settle_frames:
                frame_events.append(Target(name, *track.pose_at(now)))
            if not k and name not in grasping and track.is_closed(start):
                frame_events.append(Grasp(name, True))
            grasps = track.grasps if k >= n_settle_frames else ()
            frame_events += [Grasp(name, closed) for time, closed in grasps if now - period < time <= now]
        events.append(tuple(frame_events))
    return events
