# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Comparison of recorded markers of obstacles and pads with the re-run."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.contact.obstacles import Obstacle
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.gripper_path import body_points
from cloth_sim_ros.session.cdr import decode, encode, message_class
from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.part import Message
from cloth_sim_ros.simulation.bodies.bodies import solids_and_poses
from cloth_sim_ros.simulation.simulation import Simulation
from cloth_sim_ros.verify.outputs import same_bytes
from cloth_sim_ros.verify.verdict import Findings

MARKERS = "visualization_msgs/msg/MarkerArray"
#: Width and height of the slab that shows a plane; its upper side is the plane [m].
_PLANE = (10.0, 0.002)
_COLOUR, _GROUND = (0.45, 0.5, 0.58, 1.0), (0.24, 0.26, 0.3, 1.0)
_CUBE, _SPHERE, _CYLINDER, _TRIANGLES = 1, 2, 3, 11
_ADD, _DELETE = 0, 2
#: Maximum number of markers of one obstacle: a capsule has three.
_MAX_MARKERS = 3
#: Tolerance of a marker's position: numpy's rounding depends on the processor [m].
_POSITION_TOLERANCE = 1e-9
#: Marker numbers that locate stamps and poses in an encoded message.
_MARKED_SECOND, _MARKED_POSITION = 0x5AC3_0000, 1.2345e222


class MarkerCheck:
    """Comparison of the recorded markers of obstacles and pads with the re-run.

    Args:
        node: resolved name of the node.
        simulation: in its state at the beginning of a file.
        findings: collects the differences.
    """

    def __init__(self, node: str, simulation: Simulation, findings: Findings) -> None:
        self._node, self._findings = node, findings
        self._frame_id = simulation.scene.frame_id
        solids, self._poses = solids_and_poses(simulation.obstacles, simulation.pinching)
        self._names = [solid.name for solid in solids]
        #: Names that a message may delete: all obstacles so far.
        self._known: set[str] = set(self._names)
        self._removed: tuple[str, ...] | None = None
        self._deleted: tuple[str, ...] = ()
        #: True if the file had markers so far: a node deletes only markers that it has sent.
        self._sent = False
        self._layouts: dict[tuple[str, ...], _MarkerLayout] = {}

    @property
    def names(self) -> list[str]:
        """Names of the current obstacles and pads."""
        return self._names

    def observe_frame(self, simulation: Simulation) -> tuple[bool, bool]:
        """Update with a frame of the re-run; return two flags: bodies were added or removed, and markers are due."""
        solids, poses = solids_and_poses(simulation.obstacles, simulation.pinching)
        names = [solid.name for solid in solids]
        changed = names != self._names
        if changed:
            self._removed = self._deleted = tuple(name for name in self._names if name not in names)
            self._known.update(names)
            self._names, self._layouts = names, {}
        moved = changed or not np.array_equal(poses, self._poses)
        self._poses = poses
        return changed, moved

    def compare(self, message: Message, simulation: Simulation, stamp: int | None, *, changed: bool = False) -> None:
        """Compare a marker message with the current obstacles and pads; report the first difference.

        Args:
            message: the markers.
            simulation: in its current state.
            stamp: expected ROS time of the markers [ns]; None if unknown.
            changed: True if this frame added or removed obstacles.
        """
        is_first, self._sent = not self._sent, True
        if stamp is not None and self._layout(simulation, self._deleted).is_same(message.data, self._poses, stamp):
            return
        try:
            recorded = decode(message.data, MARKERS).markers
        except SessionError as error:
            self._findings.add_difference("marker message", f"the markers of obstacles cannot be read: {error}")
            return
        if not recorded:
            if self._names or self._deleted:
                self._findings.add_difference("marker message", "the markers of obstacles: there is none")
            return
        deleted = [marker.ns.removeprefix(f"{self._node}/") for marker in recorded if marker.action == _DELETE]
        deleted_names = tuple(dict.fromkeys(deleted))
        deletion_error = self._deletion_error(deleted_names, changed and not (is_first and not deleted_names))
        if deletion_error:
            self._findings.add_difference("marker message", f"the markers of obstacles, by {deletion_error}")
            return
        self._deleted = deleted_names
        if stamp is None:
            time = recorded[0].header.stamp
            stamp = min(time.sec * 10**9 + time.nanosec, message.publish_time)
        layout = self._layout(simulation, deleted_names)
        if layout.is_same(message.data, self._poses, stamp):
            return
        reason = _difference(recorded, decode(layout.encode(self._poses, stamp), MARKERS).markers)
        if not reason:
            layout.learn_padding(message.data)
        if reason == _APPEARANCE and self._findings.verdict.environment:
            self._findings.count_not_compared(message.topic, "colours, by other code")
        elif reason:
            text = f"the markers of obstacles, by {reason}"
            self._findings.add_difference("marker message", text, rounding=_MOVED in reason)

    def _deletion_error(self, deleted_names: tuple[str, ...], changed: bool) -> str:
        if changed and self._removed is not None and set(deleted_names) != set(self._removed):
            return f"those that are gone ({', '.join(deleted_names) or 'none'} is recorded)"
        present = [name for name in deleted_names if name in self._names]
        unknown = [name for name in deleted_names if self._removed is not None and name not in self._known]
        return f"{(present or unknown)[0]}, which is not gone" if present or unknown else ""

    def _layout(self, simulation: Simulation, deleted_names: tuple[str, ...]) -> _MarkerLayout:
        if deleted_names not in self._layouts:
            solids, _ = solids_and_poses(simulation.obstacles, simulation.pinching)
            names = {"frame_id": self._frame_id, "node": self._node}
            self._layouts[deleted_names] = _MarkerLayout(solids, **names, deleted_names=deleted_names)
        return self._layouts[deleted_names]


class _MarkerLayout:
    """Encoder of MarkerArray messages of one set of bodies, which differ in stamps and poses only."""

    def __init__(self, solids: Sequence[Obstacle], *, frame_id: str, node: str, deleted_names: Sequence[str]) -> None:
        markers = []
        for name in deleted_names:
            markers += [_marker(ns=f"{node}/{name}", id=k, action=_DELETE) for k in range(_MAX_MARKERS)]
        #: Index of the obstacle of each marker, and the marker's offset in the obstacle's frame [m].
        self._parts: list[tuple[int, NDArray[np.float64]]] = []
        for k, solid in enumerate(solids):
            for marker_index, (fields, offset) in enumerate(_marker_parts(solid)):
                colour = _GROUND if solid.shape == "plane" else _COLOUR
                marker = _marker(ns=f"{node}/{solid.name}", id=marker_index, action=_ADD, colour=colour, **fields)
                marker.pose.position.x = _MARKED_POSITION * (1 + len(self._parts))
                markers.append(marker)
                self._parts.append((k, offset))
        for marker_index, marker in enumerate(markers):
            marker.header.frame_id = frame_id
            marker.header.stamp.sec = _MARKED_SECOND + marker_index
        self._data = bytearray(encode(message_class(MARKERS)(markers=markers), MARKERS))
        self._stamp_offsets, start = [], 0
        for marker_index in range(len(markers)):
            start = self._data.index(struct.pack("<i", _MARKED_SECOND + marker_index), start)
            self._stamp_offsets.append(start)
        self._pose_offsets, start = [], 0
        for marker_index in range(len(self._parts)):
            start = self._data.index(struct.pack("<d", _MARKED_POSITION * (1 + marker_index)), start)
            self._pose_offsets.append(start)

        #: Padding bytes between fields; a middleware leaves them uninitialised.
        self._padding = np.zeros(len(self._data), dtype=np.bool_)

    def is_same(self, recorded: bytes, poses: Array, stamp: int) -> bool:
        """Return True if a message equals the markers of `poses` at a ROS time [ns], up to known padding."""
        expected = self.encode(poses, stamp)
        if same_bytes(recorded, expected):
            return True
        if len(recorded) != len(expected):
            return False
        return not (self._differing_bytes(recorded) & ~self._padding).any()

    def learn_padding(self, recorded: bytes) -> None:
        """Learn which bytes are padding, from a message whose fields equal those of the last `encode`."""
        if len(recorded) == len(self._data):
            differing = self._differing_bytes(recorded)
            for start in self._pose_offsets:
                differing[start : start + 56] = False
            self._padding |= differing

    def _differing_bytes(self, recorded: bytes) -> NDArray[np.bool_]:
        return np.frombuffer(recorded, np.uint8) != np.frombuffer(self._data, np.uint8)

    def encode(self, poses: Array, stamp: int) -> bytes:
        """Encode the markers for poses (obstacle_count, 7) at a ROS time [ns]."""
        time = struct.pack("<iI", *divmod(stamp, 10**9))
        for start in self._stamp_offsets:
            self._data[start : start + 8] = time
        numbers = poses[[k for k, _ in self._parts]]
        numbers[:, :3] = body_points(numbers, np.array([offset for _, offset in self._parts]).reshape(-1, 3))
        for start, pose in zip(self._pose_offsets, numbers.tolist(), strict=True):
            struct.pack_into("<7d", self._data, start, *pose)
        return bytes(self._data)


_APPEARANCE, _MOVED = "their looks", "m of its place"


def _difference(recorded: Sequence[Any], expected: Sequence[Any]) -> str:
    names, expected_names = ([(m.ns, m.id, m.action) for m in markers] for markers in (recorded, expected))
    if names != expected_names:
        return "their names"
    reason = ""
    for marker, expected_marker in zip(recorded, expected, strict=True):
        if marker.header != expected_marker.header:
            return f"the header of {marker.ns}"
        distance = float(np.abs(_components(marker.pose) - _components(expected_marker.pose)).max())
        if not distance <= _POSITION_TOLERANCE:
            return f"{distance:.3g} {_MOVED}, of {marker.ns}"
        scale, expected_scale = _components(marker.scale), _components(expected_marker.scale)
        is_same_size = np.allclose(scale, expected_scale, rtol=0, atol=_POSITION_TOLERANCE)
        if marker.type != expected_marker.type or not is_same_size:
            return f"the size of {marker.ns}"
        if _coordinates(marker.points) != _coordinates(expected_marker.points):
            return f"the mesh of {marker.ns}"
        expected_marker.pose, expected_marker.scale = marker.pose, marker.scale
        if encode(marker, "visualization_msgs/msg/Marker") != encode(expected_marker, "visualization_msgs/msg/Marker"):
            reason = _APPEARANCE
    return reason


def _components(value: Any) -> NDArray[np.float64]:
    """Return the numbers of a ROS pose, point or vector as an array."""
    if hasattr(value, "orientation"):
        return np.concatenate([_components(value.position), _components(value.orientation)])
    return np.array([getattr(value, axis) for axis in "xyzw" if hasattr(value, axis)])


def _coordinates(points: Sequence[Any]) -> list[list[float]]:
    return [_components(point).tolist() for point in points]


def _marker_parts(solid: Obstacle) -> list[tuple[dict[str, Any], NDArray[np.float64]]]:
    """Return, for each marker of an obstacle, its type, size and points, and its offset in the obstacle's frame [m]."""
    origin = np.zeros(3)
    if solid.shape == "plane":
        width, height = _PLANE
        return [({"type": _CUBE, "scale": (width, width, height)}, np.array([0.0, 0.0, -0.5 * height]))]
    if solid.shape == "box":
        return [({"type": _CUBE, "scale": tuple(solid.size)}, origin)]
    if solid.shape == "sphere":
        return [({"type": _SPHERE, "scale": (2.0 * solid.size[0],) * 3}, origin)]
    if solid.shape in ("cylinder", "capsule"):
        radius, length = solid.size
        width = 2.0 * radius
        parts = [({"type": _CYLINDER, "scale": (width, width, length)}, origin)]
        if solid.shape == "capsule":
            ends = np.array([0.0, 0.0, -0.5 * length]), np.array([0.0, 0.0, 0.5 * length])
            parts += [({"type": _SPHERE, "scale": (width,) * 3}, end) for end in ends]
        return parts
    assert solid.vertices is not None
    assert solid.triangles is not None
    points = solid.vertices[solid.triangles.ravel()].tolist()
    return [({"type": _TRIANGLES, "scale": (1.0, 1.0, 1.0), "points": points}, origin)]


def _marker(
    *,
    ns: str,
    id: int,
    action: int,
    type: int = 0,
    scale: Sequence[float] = (0.0, 0.0, 0.0),
    colour: Sequence[float] = (0.0, 0.0, 0.0, 0.0),
    points: Sequence[Sequence[float]] = (),
) -> Any:
    message_type, point = message_class, message_class("geometry_msgs/msg/Point")

    def header() -> Any:
        stamp = message_type("builtin_interfaces/msg/Time")(sec=0, nanosec=0)
        return message_type("std_msgs/msg/Header")(stamp=stamp, frame_id="")

    empty = np.empty(0, dtype=np.uint8)
    return message_type("visualization_msgs/msg/Marker")(
        header=header(),
        ns=ns,
        id=id,
        type=type,
        action=action,
        pose=message_type("geometry_msgs/msg/Pose")(
            position=point(x=0.0, y=0.0, z=0.0),
            orientation=message_type("geometry_msgs/msg/Quaternion")(x=0.0, y=0.0, z=0.0, w=1.0),
        ),
        scale=message_type("geometry_msgs/msg/Vector3")(**dict(zip("xyz", map(float, scale), strict=True))),
        color=message_type("std_msgs/msg/ColorRGBA")(**dict(zip("rgba", colour, strict=True))),
        lifetime=message_type("builtin_interfaces/msg/Duration")(sec=0, nanosec=0),
        frame_locked=False,
        points=[point(x=x, y=y, z=z) for x, y, z in points],
        colors=[],
        texture_resource="",
        texture=message_type("sensor_msgs/msg/CompressedImage")(header=header(), format="", data=empty),
        uv_coordinates=[],
        text="",
        mesh_resource="",
        mesh_file=message_type("visualization_msgs/msg/MeshFile")(filename="", data=empty),
        mesh_use_embedded_materials=False,
    )
