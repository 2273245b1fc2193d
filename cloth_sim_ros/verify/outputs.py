# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Comparison of clouds, wrenches, transforms and topology with the re-run, by bytes."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.sheets.normals import vertex_normals
from cloth_sim_ros.scene.cameras import optical_frames
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.scene.sections import PointsParameters
from cloth_sim_ros.session import messages
from cloth_sim_ros.session.cdr import Cloud, decode, decode_cloud, decode_mesh, encode
from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.part import Message
from cloth_sim_ros.simulation.frame import Frame
from cloth_sim_ros.simulation.simulation import Simulation
from cloth_sim_ros.verify.verdict import Findings

#: Last part of the cloth's TF frame, after the node's name.
_CLOTH = "cloth"
#: Tolerance of the centre of mass: numpy's order of summation depends on the processor [m].
_CENTRE_TOLERANCE = 1e-9
#: Alignment to which CDR may pad the end of a message [bytes].
_PADDING = 4
#: Sizes of the encapsulation header and of a stamp [bytes].
_CDR_HEADER_SIZE, _STAMP_SIZE = 4, 8
#: Size of the numbers of a wrench [bytes].
_WRENCH_SIZE = 48


def same_bytes(recorded: bytes, expected: bytes) -> bool:
    """Return True if two encoded messages are equal up to a few bytes of padding at the end of one."""
    if recorded == expected:
        return True
    short, long = sorted((recorded, expected), key=len)
    return len(long) - len(short) < _PADDING and long.startswith(short)


def same_content(recorded: bytes, expected: bytes, type_name: str) -> bool:
    """Return True if two messages are equal up to padding. Raises SessionError if the first cannot be read.

    Middlewares leave padding uninitialised.
    """
    if same_bytes(recorded, expected):
        return True
    if len(recorded) >= len(expected) + _PADDING:
        return False
    return encode(decode(recorded, type_name), type_name) == encode(decode(expected, type_name), type_name)


class CloudCheck:
    """Comparison of recorded clouds, bytes and points, with the re-run.

    Args:
        scene: effective when the file was opened.
        findings: collects the differences.
    """

    def __init__(self, scene: Scene, findings: Findings) -> None:
        self._frame_id, self._shape, self._findings = scene.frame_id, scene.shape, findings
        self._triangles = scene.sheet.triangles()
        #: Fields of the first scene: a study keeps them; a node follows the current scene.
        self._first_fields = scene.points
        self._encoders: dict[PointsParameters, messages.CloudEncoder] = {}
        #: Expected header by recorded header that equals it up to padding.
        self._equivalent_headers: dict[bytes, bytes] = {}

    def compare(self, message: Message, simulation: Simulation, stamp: int) -> bool:
        """Compare a cloud with the last frame, due at a ROS time [ns]; report; return True if positions are equal."""
        state, fields, differs_by_normals = simulation.state, simulation.scene.points, False
        for points in dict.fromkeys((fields, self._first_fields)):
            encoder = self._encoder(points)
            normals = vertex_normals(state.x, self._triangles) if points.normal else None
            expected = encoder.encode(state.x, stamp, state.v if points.velocity else None, normals)
            if self._is_same(message.data, expected, encoder.points_offset):
                return True
            if points.normal:
                data = encoder.with_normals_of(message.data, expected)
                differs_by_normals = differs_by_normals or self._is_same(data, expected, encoder.points_offset)
        try:
            recorded = decode_cloud(message.data)
        except SessionError as error:
            self._findings.add_difference("cloud", f"its cloud cannot be read: {error}")
            return False
        if not self._compare_header(recorded, stamp):
            return False
        if _differing_particles(recorded.xyz, state.x).size:
            self._report_positions(recorded.xyz, state.x.T.astype(recorded.xyz.dtype))
            return False
        if recorded.velocity is not None and fields.velocity:
            differing = _differing_particles(recorded.velocity, state.v)
            if differing.size:
                reason = f"its cloud, by the velocity of particle {differing[0]}"
                self._findings.add_difference("cloud", reason, rounding=True)
                return True
        # Normals follow from positions before their rounding.
        kind = "normals" if differs_by_normals else "layout of its points"
        self._findings.add_difference("cloud", f"its cloud, by the {kind}", rounding=differs_by_normals)
        return True

    def _is_same(self, recorded: bytes, expected: bytes, start: int) -> bool:
        """Return True if two encoded clouds are equal up to padding in their headers. `start`: offset of the points."""
        if same_bytes(recorded, expected):
            return True
        stamp_end = _CDR_HEADER_SIZE + _STAMP_SIZE
        if recorded[:stamp_end] != expected[:stamp_end] or not same_bytes(recorded[start:], expected[start:]):
            return False
        header, expected_header = recorded[stamp_end:start], expected[stamp_end:start]
        if self._equivalent_headers.get(header) == expected_header:
            return True
        try:
            is_same = same_content(recorded, expected, messages.CLOUD)
        except SessionError:
            return False
        if is_same:
            self._equivalent_headers = {header: expected_header}
        return is_same

    def _encoder(self, points: PointsParameters) -> messages.CloudEncoder:
        if points not in self._encoders:
            height, width = self._shape
            encoder = messages.CloudEncoder(frame_id=self._frame_id, height=height, width=width, **points.fields)
            self._encoders[points] = encoder
        return self._encoders[points]

    def _compare_header(self, cloud: Cloud, stamp: int) -> bool:
        height, width = self._shape
        n_points = height * width
        if len(cloud.xyz) != n_points:
            self._findings.add_difference("cloud", f"its cloud has {len(cloud.xyz)} points, the cloth {n_points}")
            return False
        for name, recorded, expected in (
            ("stamp", cloud.stamp, stamp),
            ("frame_id", cloud.frame_id, self._frame_id),
            ("height x width", f"{cloud.height} x {cloud.width}", f"{height} x {width}"),
        ):
            if recorded != expected:
                reason = f"its cloud, by its {name} ({recorded} is recorded, {expected} is due)"
                self._findings.add_difference("cloud", reason)
                return False
        return True

    def _report_positions(self, recorded: NDArray[np.floating], expected: NDArray[np.floating]) -> None:
        distances = np.linalg.norm(recorded.astype(np.float64) - expected, axis=1)
        worst = int(np.argmax(np.where(np.isfinite(distances), distances, np.inf)))
        deviation = float(distances[worst]) if math.isfinite(distances[worst]) else math.inf
        verdict = self._findings.verdict
        verdict.largest_deviation = max(verdict.largest_deviation, deviation)
        reason = f"its cloud, by {deviation:.3g} m at particle {worst}"
        self._findings.add_difference("cloud", reason, rounding=math.isfinite(deviation))


def _differing_particles(recorded: NDArray[np.floating], expected: Array) -> NDArray[np.intp]:
    """Return the particles whose recorded vectors (n, 3) differ in bits from the re-run's (3, n) in that precision."""
    bits = np.dtype(f"u{recorded.dtype.itemsize}")
    return np.flatnonzero((recorded.view(bits) != expected.T.astype(recorded.dtype).view(bits)).any(axis=1))


def compare_wrench(message: Message, wrench: Array, *, frame_id: str, stamp: int, findings: Findings) -> None:
    """Compare a recorded wrench with that of the re-run, 6 numbers [N, N m]; report a difference."""
    expected = messages.wrench_bytes(wrench, frame_id=frame_id, stamp=stamp)
    # Layout after the stamp: length and text of the frame_id, padding, numbers.
    name_end = _CDR_HEADER_SIZE + _STAMP_SIZE + 4 + len(frame_id.encode()) + 1
    recorded_ends = message.data[:name_end], message.data[-_WRENCH_SIZE:]
    if recorded_ends == (expected[:name_end], expected[-_WRENCH_SIZE:]) and len(message.data) == len(expected):
        return
    reason = f"the wrench on {message.topic.split('/')[-2]}"
    try:
        content = decode(message.data, messages.WRENCH)
    except SessionError as error:
        findings.add_difference("wrench", f"{reason} cannot be read: {error}")
        return
    header = _header_difference(content.header, frame_id, stamp)
    if header:
        findings.add_difference("wrench", f"{reason}, by {header}")
        return
    recorded = [getattr(part, axis) for part in (content.wrench.force, content.wrench.torque) for axis in "xyz"]
    if np.array(recorded).tobytes() != np.ascontiguousarray(wrench, dtype=np.float64).tobytes():
        findings.add_difference("wrench", reason, rounding=True)


def is_topology_of(message: Message, scene: Scene) -> bool:
    """Return True if a recorded topology has the triangles and the rest shape of a scene."""
    return same_bytes(message.data, messages.mesh_bytes(scene.sheet.triangles(), scene.sheet.positions()))


def compare_topology(message: Message, scene: Scene, findings: Findings) -> None:
    """Compare recorded triangles and rest shape with the scene's; report a difference."""
    triangles, rest_positions = scene.sheet.triangles(), scene.sheet.positions()
    if is_topology_of(message, scene):
        return
    try:
        recorded = decode_mesh(message.data)
    except SessionError as error:
        findings.add_difference("topology", f"the topology cannot be read: {error}")
        return
    if not np.array_equal(recorded.triangles, triangles):
        findings.add_difference("topology", "the topology, by its triangles")
    elif recorded.vertices.shape != rest_positions.shape:
        counts = f"{len(recorded.vertices)} points, the cloth {len(rest_positions)}"
        findings.add_difference("topology", f"the topology has {counts}")
    else:
        worst = float(np.abs(recorded.vertices - rest_positions).max(initial=0.0))
        reason = f"the topology, by {worst:.3g} m of its rest shape"
        findings.add_difference("topology", reason, rounding=worst < _CENTRE_TOLERANCE)


def compare_transforms(message: Message, node: str, simulation: Simulation, stamp: int, findings: Findings) -> None:
    """Compare transforms of centre of mass, placed grippers and cameras with the re-run; report a difference."""
    frames = _transforms(node.strip("/"), simulation)
    parent = simulation.scene.frame_id
    if same_bytes(message.data, messages.transforms_bytes(frames, frame_id=parent, stamp=stamp)):
        return
    try:
        recorded = decode(message.data, messages.TRANSFORMS).transforms
    except SessionError as error:
        findings.add_difference("transform", f"its transforms cannot be read: {error}")
        return
    if [transform.child_frame_id for transform in recorded] != [name for name, _ in frames]:
        findings.add_difference("transform", "its transforms, by the names of their frames")
        return
    for transform, (name, pose) in zip(recorded, frames, strict=True):
        header_error = _header_difference(transform.header, parent, stamp)
        if header_error:
            findings.add_difference("transform", f"its transform of {name}, by {header_error}")
            return
        translation, rotation = transform.transform.translation, transform.transform.rotation
        recorded_pose = [translation.x, translation.y, translation.z, rotation.x, rotation.y, rotation.z, rotation.w]
        limit = _CENTRE_TOLERANCE if name.endswith(f"/{_CLOTH}") else 0.0
        if not all(abs(a - b) <= limit for a, b in zip(recorded_pose, pose, strict=True)):
            findings.add_difference("transform", f"its transform of {name}", rounding=True)
            return


def wrenches(scene: Scene, frame: Frame) -> list[tuple[str, Array]]:
    """Return pairs of name and wrench [N, N m] of a frame, of grippers, then of obstacles that are no robot's links."""
    gripper_wrenches = list(zip(scene.gripper_names, frame.wrenches, strict=True))
    of_obstacles = zip(scene.obstacle_names, frame.obstacle_wrenches, strict=True)
    links = scene.link_names
    return [*gripper_wrenches, *((name, wrench) for name, wrench in of_obstacles if name not in links)]


def _transforms(prefix: str, simulation: Simulation) -> list[tuple[str, Sequence[float]]]:
    masses, grippers = simulation.model.masses, simulation.grippers
    centre = (simulation.state.x * masses).sum(axis=1) / simulation.model.mass
    frames: list[tuple[str, Sequence[float]]] = [(f"{prefix}/{_CLOTH}", [*centre.tolist(), 0.0, 0.0, 0.0, 1.0])]
    poses = grippers.poses().tolist()
    frames += [(f"{prefix}/{name}", poses[k]) for k, name in enumerate(grippers.names) if grippers.is_placed(k)]
    return [*frames, *optical_frames(prefix, simulation.scene.views)]


def _header_difference(header: object, frame_id: str, stamp: int) -> str:
    """Return the difference in a message's header, stamp or frame_id, as text; empty if none."""
    time = header.stamp  # type: ignore[attr-defined]
    recorded_stamp = time.sec * 10**9 + time.nanosec
    if recorded_stamp != stamp:
        return f"its stamp ({recorded_stamp} is recorded, {stamp} is due)"
    recorded_frame_id = header.frame_id  # type: ignore[attr-defined]
    return "" if recorded_frame_id == frame_id else f"its frame_id ({recorded_frame_id} is recorded, {frame_id} is due)"
