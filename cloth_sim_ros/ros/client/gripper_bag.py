# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Scripts of grippers from the poses and grasps in a bag."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import attrs
import numpy as np

from cloth_sim_ros.simulation.gripper_script import GripperScript, ScriptError, TimedGrasp

_POSE, _BOOL = "geometry_msgs/msg/PoseStamped", "std_msgs/msg/Bool"
#: Topics of a gripper's poses, the first one preferred: its commands, or its measured poses.
_LEAVES = ("target", "pose")
_NAME = re.compile(rf"(?:.*/)?(?P<gripper>[^/]+)/(?P<leaf>{'|'.join(_LEAVES)})")

#: Log time [ns] and bytes of each message.
_Messages = list[tuple[int, bytes]]


def bag_scripts(path: Path, *, gripper: str | None = None, topic: str | None = None) -> list[GripperScript]:
    """Read poses and grasps in a bag as scripts, one for each gripper; time 0 is the earliest pose of all.

    The poses of a gripper are on `<gripper>/target`, or on `<gripper>/pose`, and its grasps (Bool) on
    `<gripper>/grasp`. Without grasps it is closed from its first pose on. Sessions have these topics too.

    Args:
        path: a bag's folder, or a file: MCAP, or SQLite.
        gripper: the only gripper to be read; by default all.
        topic: topic of its poses (PoseStamped); then `gripper` is the name of the gripper that plays them.

    Raises:
        ScriptError: naming the file and the fault.
    """
    from cloth_sim_ros.session.errors import SessionError

    try:
        poses, grasps = _read_messages(path)
        topics = _select_topics(poses, gripper, topic)
        scripts = {name: _script(name, topics[name], poses[topics[name]], grasps) for name in topics}
    except (SessionError, ScriptError) as error:
        raise ScriptError(str(error) if str(path) in str(error) else f"{path}: {error}") from error
    start = min(first for first, _ in scripts.values())
    return [_delayed(script, 1e-9 * (first - start)) for first, script in scripts.values()]


def _read_messages(path: Path) -> tuple[dict[str, _Messages], dict[str, _Messages]]:
    """Return the (log time [ns], bytes) lists of pose topics (PoseStamped), and of grasp topics (Bool), by topic."""
    from cloth_sim_ros.session.bag import bag_files, bag_messages

    by_kind: dict[str, dict[str, _Messages]] = {_POSE: {}, _BOOL: {}}
    for file in bag_files(path):
        for name, kind, log_time, data in bag_messages(file):
            if kind in by_kind:
                by_kind[kind].setdefault(name, []).append((log_time, data))
    return by_kind[_POSE], by_kind[_BOOL]


def _select_topics(poses: Mapping[str, _Messages], gripper: str | None, topic: str | None) -> dict[str, str]:
    """Return {gripper: topic of its poses}; ScriptError if the choice is empty or ambiguous."""
    if topic is not None:
        if topic not in poses:
            raise ScriptError(f"there is no topic '{topic}' of poses (PoseStamped); there are {_listed(poses)}")
        match = _NAME.fullmatch(topic)
        return {gripper or (match["gripper"] if match else "gripper"): topic}
    topics: dict[str, str] = {}
    for leaf in _LEAVES:
        of_leaf: dict[str, str] = {}
        for name in poses:
            match = _NAME.fullmatch(name)
            if match is None or match["leaf"] != leaf or gripper not in (None, match["gripper"]):
                continue
            if match["gripper"] in of_leaf:
                raise ScriptError(
                    f"two topics are named after it: {of_leaf[match['gripper']]}, {name}; select by --topic"
                )
            of_leaf[match["gripper"]] = name
        topics = of_leaf | topics
    if not topics:
        of_gripper = f"<gripper>/{_LEAVES[0]}" if gripper is None else f"{gripper}/{_LEAVES[0]}"
        raise ScriptError(
            f"no topic ends in {of_gripper} (PoseStamped); select one by --topic; there are {_listed(poses)}"
        )
    return topics


def _listed(topics: Mapping[str, _Messages]) -> str:
    return ", ".join(sorted(topics)) or "none"


def _script(
    gripper: str, topic: str, messages: _Messages, grasps: Mapping[str, _Messages]
) -> tuple[int, GripperScript]:
    """Build a gripper's script from its messages; return the stamp of the first pose [ns], and the script."""
    from cloth_sim_ros.session.cdr import decode

    rows = dict[int, list[float]]()
    logged = dict[int, int]()
    frames = set[str]()
    for log_time, data in messages:
        message = decode(data, _POSE)
        stamp = int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec) or log_time
        p, q = message.pose.position, message.pose.orientation
        rows[stamp], logged[stamp] = [p.x, p.y, p.z, q.x, q.y, q.z, q.w], log_time
        frames.add(message.header.frame_id)
    if len(frames) > 1:
        raise ScriptError(f"poses on {topic} are in several frames: {', '.join(sorted(frames))}")
    stamps = sorted(rows)
    seconds = [1e-9 * (stamp - stamps[0]) for stamp in stamps]
    try:
        script = GripperScript.from_poses(
            seconds, [rows[stamp] for stamp in stamps], gripper=gripper, closed=True, frame_id=frames.pop()
        )
    except ScriptError as error:
        raise ScriptError(f"{topic}: {error}") from error
    timed = _grasps(gripper, topic, [logged[stamp] for stamp in stamps], seconds, grasps)
    return stamps[0], script if timed is None else attrs.evolve(script, grasps=timed)


def _grasps(
    gripper: str, topic: str, logged: Sequence[int], seconds: Sequence[float], grasps: Mapping[str, _Messages]
) -> tuple[TimedGrasp, ...] | None:
    """Return the grasps of a gripper at their script times, or None if the bag has none.

    A Bool has no stamp. Its time is that of the poses with the same log time, because both are sent by one node.
    """
    from cloth_sim_ros.session.cdr import decode

    match = _NAME.fullmatch(topic)
    prefix = topic[: -len(match["leaf"])] if match else f"{topic}/"
    messages = grasps.get(f"{prefix}grasp") or grasps.get(f"/{gripper}/grasp")
    if not messages:
        return None
    order = np.argsort(np.array(logged), kind="stable")
    times = np.array(logged, dtype=np.int64)[order]
    first = times[0]
    log_times = [(log_time - first) * 1e-9 for log_time, _ in messages]
    played = np.interp(log_times, (times - first) * 1e-9, np.array(seconds)[order]).tolist()
    entries = [
        TimedGrasp(time=time, closed=bool(decode(data, _BOOL).data))
        for time, (_, data) in zip(played, messages, strict=True)
    ]
    return tuple(sorted(entries, key=lambda entry: entry.time))


def _delayed(script: GripperScript, delay: float) -> GripperScript:
    """Return a script whose waypoints and grasps come later by a delay [s]."""
    if not delay:
        return script
    return attrs.evolve(
        script,
        waypoints=tuple(attrs.evolve(waypoint, time=waypoint.time + delay) for waypoint in script.waypoints),
        grasps=tuple(attrs.evolve(grasp, time=grasp.time + delay) for grasp in script.grasps),
    )
