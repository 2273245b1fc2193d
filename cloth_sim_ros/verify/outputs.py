# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Comparison of clouds, wrenches, transforms and topology with the re-run, by bytes."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.scene.sections import Points
from cloth_sim_ros.session import messages
from cloth_sim_ros.session.cdr import Cloud, decode, decode_cloud, decode_surface, encode
from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.part import Message
from cloth_sim_ros.simulation.frame import Frame
from cloth_sim_ros.simulation.simulation import Simulation
from cloth_sim_ros.verify.verdict import Findings

#: Last part of the cloth's TF frame, after the node's name.
_CLOTH = "cloth"
#: Tolerance of the centre of mass: numpy's order of summation depends on the processor [m].
_CENTRE = 1e-9
#: Alignment to which CDR may pad the end of a message [bytes].
_FILLED = 4
#: Sizes of the encapsulation header and of a stamp [bytes].
_CDR, _STAMP = 4, 8
#: Size of the numbers of a wrench [bytes].
_NUMBERS = 48


def same_bytes(recorded: bytes, again: bytes) -> bool:
    """Return True if two messages are equal up to the padding at their ends."""
    if recorded == again:
        return True
    short, long = sorted((recorded, again), key=len)
    return len(long) - len(short) < _FILLED and long.startswith(short)


def same_content(recorded: bytes, again: bytes, type_name: str) -> bool:
    """Return True if two messages are equal up to padding, which middlewares leave uninitialised.

    Raises SessionError if the first one cannot be read.
    """
    if same_bytes(recorded, again):
        return True
    return len(recorded) < len(again) + _FILLED and encode(decode(recorded, type_name), type_name) == encode(
        decode(again, type_name), type_name
    )


class CloudCheck:
    """Compares clouds.

    Args:
        scene: effective when the file was opened.
        findings: collects the differences.
    """

    def __init__(self, scene: Scene, findings: Findings) -> None:
        self._frame_id, self._shape, self._findings = scene.frame_id, scene.shape, findings
        #: Fields of the first scene: a study keeps them; a node follows the current scene.
        self._first = scene.points
        self._bytes: dict[Points, messages.CloudBytes] = {}
        #: Expected header by recorded header that equals it up to padding.
        self._heads: dict[bytes, bytes] = {}

    def compare(self, message: Message, simulation: Simulation, stamp: int) -> bool:
        """Compare a cloud with the last frame at a ROS time [ns]; return True if the positions are equal."""
        state, fields = simulation.state, simulation.scene.points
        for points in dict.fromkeys((fields, self._first)):
            layout = self._again(points)
            if self._is_same(
                message.data, layout.at(state.x, stamp, state.v if points.velocity else None), layout.start
            ):
                return True
        try:
            recorded = decode_cloud(message.data)
        except SessionError as error:
            self._findings.difference("cloud", f"its cloud cannot be read: {error}")
            return False
        if not self._compare_header(recorded, stamp):
            return False
        if _different(recorded.xyz, state.x).size:
            self._tell_positions(recorded.xyz, state.x.T.astype(recorded.xyz.dtype))
            return False
        if recorded.velocity is not None and fields.velocity:
            wrong = _different(recorded.velocity, state.v)
            if wrong.size:
                self._findings.difference("cloud", f"its cloud, by the velocity of particle {wrong[0]}", rounding=True)
                return True
        self._findings.difference("cloud", "its cloud, by the layout of its points")
        return True

    def _is_same(self, recorded: bytes, again: bytes, start: int) -> bool:
        """Return True if two clouds are equal up to padding before the points, which begin at offset `start`."""
        if same_bytes(recorded, again):
            return True
        if not same_bytes(recorded[start:], again[start:]) or recorded[: _CDR + _STAMP] != again[: _CDR + _STAMP]:
            return False
        head, wanted = recorded[_CDR + _STAMP : start], again[_CDR + _STAMP : start]
        if self._heads.get(head) == wanted:
            return True
        try:
            same = same_content(recorded, again, messages.CLOUD)
        except SessionError:
            return False
        if same:
            self._heads = {head: wanted}
        return same

    def _again(self, points: Points) -> messages.CloudBytes:
        if points not in self._bytes:
            height, width = self._shape
            self._bytes[points] = messages.CloudBytes(
                frame_id=self._frame_id, height=height, width=width, velocity=points.velocity, double=points.double
            )
        return self._bytes[points]

    def _compare_header(self, cloud: Cloud, stamp: int) -> bool:
        height, width = self._shape
        points = height * width
        if len(cloud.xyz) != points:
            self._findings.difference("cloud", f"its cloud has {len(cloud.xyz)} points, the cloth {points}")
            return False
        for name, recorded, again in (
            ("stamp", cloud.stamp, stamp),
            ("frame_id", cloud.frame_id, self._frame_id),
            ("height x width", f"{cloud.height} x {cloud.width}", f"{height} x {width}"),
        ):
            if recorded != again:
                self._findings.difference("cloud", f"its cloud, by its {name} ({recorded} is recorded, {again} is due)")
                return False
        return True

    def _tell_positions(self, recorded: NDArray[np.floating], again: NDArray[np.floating]) -> None:
        away = np.linalg.norm(recorded.astype(np.float64) - again, axis=1)
        worst = int(np.argmax(np.where(np.isfinite(away), away, np.inf)))
        deviation = float(away[worst]) if math.isfinite(away[worst]) else math.inf
        verdict = self._findings.verdict
        verdict.largest_deviation = max(verdict.largest_deviation, deviation)
        self._findings.difference(
            "cloud",
            f"its cloud, by {deviation:.3g} m at particle {worst}",
            rounding=math.isfinite(deviation),
        )


def _different(recorded: NDArray[np.floating], again: Array) -> NDArray[np.intp]:
    """Return the particles whose recorded vectors (n, 3) differ in bits from the re-run's (3, n) in that precision."""
    bits = np.dtype(f"u{recorded.dtype.itemsize}")
    return np.flatnonzero((recorded.view(bits) != again.T.astype(recorded.dtype).view(bits)).any(axis=1))


def compare_wrench(message: Message, wrench: Array, *, frame_id: str, stamp: int, findings: Findings) -> None:
    """Compare a recorded wrench with that of the re-run: 6 numbers [N, N m]."""
    again = messages.wrench_bytes(wrench, frame_id=frame_id, stamp=stamp)
    # Layout after the stamp: length and text of the frame_id, padding, numbers.
    name = _CDR + _STAMP + 4 + len(frame_id.encode()) + 1
    same_ends = message.data[:name] == again[:name] and message.data[-_NUMBERS:] == again[-_NUMBERS:]
    if same_ends and len(message.data) == len(again):
        return
    reason = f"the wrench on {message.topic.split('/')[-2]}"
    try:
        content = decode(message.data, messages.WRENCH)
    except SessionError as error:
        findings.difference("wrench", f"{reason} cannot be read: {error}")
        return
    header = _header_difference(content.header, frame_id, stamp)
    if header:
        findings.difference("wrench", f"{reason}, by {header}")
        return
    recorded = [getattr(part, axis) for part in (content.wrench.force, content.wrench.torque) for axis in "xyz"]
    if np.array(recorded).tobytes() != np.ascontiguousarray(wrench, dtype=np.float64).tobytes():
        findings.difference("wrench", reason, rounding=True)


def compare_topology(message: Message, scene: Scene, findings: Findings) -> None:
    """Compare the recorded triangles and rest shape with the scene's."""
    triangles, places = scene.sheet.triangles(), scene.sheet.positions()
    if same_bytes(message.data, messages.mesh_bytes(triangles, places)):
        return
    try:
        recorded = decode_surface(message.data)
    except SessionError as error:
        findings.difference("topology", f"the topology cannot be read: {error}")
        return
    if not np.array_equal(recorded.triangles, triangles):
        findings.difference("topology", "the topology, by its triangles")
    elif recorded.vertices.shape != places.shape:
        findings.difference("topology", f"the topology has {len(recorded.vertices)} points, the cloth {len(places)}")
    else:
        worst = float(np.abs(recorded.vertices - places).max(initial=0.0))
        findings.difference("topology", f"the topology, by {worst:.3g} m of its rest shape", rounding=worst < _CENTRE)


def compare_transforms(message: Message, node: str, simulation: Simulation, stamp: int, findings: Findings) -> None:
    """Compare recorded transforms: of the cloth's centre of mass, and of each placed gripper."""
    frames = _transforms(node.strip("/"), simulation)
    parent = simulation.scene.frame_id
    if same_bytes(message.data, messages.transforms_bytes(frames, frame_id=parent, stamp=stamp)):
        return
    try:
        recorded = decode(message.data, messages.TRANSFORMS).transforms
    except SessionError as error:
        findings.difference("transform", f"its transforms cannot be read: {error}")
        return
    if [one.child_frame_id for one in recorded] != [name for name, _ in frames]:
        findings.difference("transform", "its transforms, by the names of their frames")
        return
    for one, (name, pose) in zip(recorded, frames, strict=True):
        header = _header_difference(one.header, parent, stamp)
        if header:
            findings.difference("transform", f"its transform of {name}, by {header}")
            return
        place, turn = one.transform.translation, one.transform.rotation
        told = [place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w]
        limit = _CENTRE if name.endswith(f"/{_CLOTH}") else 0.0
        if not all(abs(a - b) <= limit for a, b in zip(told, pose, strict=True)):
            findings.difference("transform", f"its transform of {name}", rounding=True)
            return


def wrenches(scene: Scene, frame: Frame) -> list[tuple[str, Array]]:
    """Return names and wrenches [N, N m] of a frame for each gripper and each obstacle."""
    found = list(zip(scene.gripper_names, frame.wrenches, strict=True))
    return [*found, *zip(scene.obstacle_names, frame.loads, strict=True)]


def _transforms(prefix: str, simulation: Simulation) -> list[tuple[str, Sequence[float]]]:
    masses, grippers = simulation.model.masses, simulation.grippers
    centre = (simulation.state.x * masses).sum(axis=1) / simulation.model.mass
    frames: list[tuple[str, Sequence[float]]] = [(f"{prefix}/{_CLOTH}", [*centre.tolist(), 0.0, 0.0, 0.0, 1.0])]
    poses = grippers.poses().tolist()
    frames += [(f"{prefix}/{name}", poses[k]) for k, name in enumerate(grippers.names) if grippers.is_placed(k)]
    return frames


def _header_difference(header: object, frame_id: str, stamp: int) -> str:
    """Return the wrong part of a header, as text; empty if none."""
    time = header.stamp  # type: ignore[attr-defined]
    told = time.sec * 10**9 + time.nanosec
    if told != stamp:
        return f"its stamp ({told} is recorded, {stamp} is due)"
    found = header.frame_id  # type: ignore[attr-defined]
    return "" if found == frame_id else f"its frame_id ({found} is recorded, {frame_id} is due)"
