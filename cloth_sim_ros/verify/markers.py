# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Comparison of recorded markers of obstacles and pads with the re-run."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.gripper_path import rotation_matrix
from cloth_sim_ros.physics.obstacles import Obstacle
from cloth_sim_ros.session.cdr import decode, encode, message_class
from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.part import Message
from cloth_sim_ros.simulation.simulation import Simulation
from cloth_sim_ros.simulation.surroundings import solids_and_poses
from cloth_sim_ros.verify.outputs import same_bytes
from cloth_sim_ros.verify.verdict import Findings

MARKERS = "visualization_msgs/msg/MarkerArray"
#: Width and height of the slab that shows a plane; its upper side is the plane [m].
_PLANE = (10.0, 0.002)
_COLOUR, _GROUND = (0.45, 0.5, 0.58, 1.0), (0.24, 0.26, 0.3, 1.0)
_CUBE, _SPHERE, _CYLINDER, _TRIANGLES = 1, 2, 3, 11
_ADD, _DELETE = 0, 2
#: Maximum number of markers of one obstacle: a capsule has three.
_MOST = 3
#: Tolerance of a marker's position: numpy's rounding depends on the processor [m].
_NEAR = 1e-9
#: Marker numbers that locate stamps and poses in an encoded message.
_MARKED_SECOND, _MARKED_PLACE = 0x5AC3_0000, 1.2345e222


class MarkerCheck:
    """Compares markers. A node sends them when an obstacle has moved or was added or removed.

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
        self._gone: tuple[str, ...] = ()
        #: True if the file had markers so far: a node deletes only markers that it has sent.
        self._sent = False
        self._layouts: dict[tuple[str, ...], _Layout] = {}

    @property
    def names(self) -> list[str]:
        """Names of the current obstacles and pads."""
        return self._names

    def follow(self, simulation: Simulation) -> tuple[bool, bool]:
        """Update with a frame of the re-run; return True if the obstacles changed, and True if markers are due."""
        solids, poses = solids_and_poses(simulation.obstacles, simulation.pinching)
        names = [solid.name for solid in solids]
        changed = names != self._names
        if changed:
            self._removed = self._gone = tuple(name for name in self._names if name not in names)
            self._known.update(names)
            self._names, self._layouts = names, {}
        moved = changed or not np.array_equal(poses, self._poses)
        self._poses = poses
        return changed, moved

    def compare(self, message: Message, simulation: Simulation, stamp: int | None, *, changed: bool = False) -> None:
        """Compare markers with the current obstacles.

        Args:
            message: the markers.
            simulation: in its current state.
            stamp: expected ROS time of the markers [ns]; None if unknown.
            changed: True if this frame added or removed obstacles.
        """
        first, self._sent = not self._sent, True
        if stamp is not None and self._again(simulation, self._gone).is_same(message.data, self._poses, stamp):
            return
        try:
            recorded = decode(message.data, MARKERS).markers
        except SessionError as error:
            self._findings.difference("marker message", f"the markers of obstacles cannot be read: {error}")
            return
        if not recorded:
            if self._names or self._gone:
                self._findings.difference("marker message", "the markers of obstacles: there is none")
            return
        told = tuple(dict.fromkeys(one.ns.removeprefix(f"{self._node}/") for one in recorded if one.action == _DELETE))
        wrong = self._wrong_gone(told, changed and not (first and not told))
        if wrong:
            self._findings.difference("marker message", f"the markers of obstacles, by {wrong}")
            return
        self._gone = told
        if stamp is None:
            time = recorded[0].header.stamp
            stamp = min(time.sec * 10**9 + time.nanosec, message.publish_time)
        layout = self._again(simulation, told)
        if layout.is_same(message.data, self._poses, stamp):
            return
        reason = _difference(recorded, decode(layout.at(self._poses, stamp), MARKERS).markers)
        if not reason:
            layout.learn_gaps(message.data)
        if reason == _LOOKS and self._findings.verdict.environment:
            self._findings.not_compared(message.topic, "colours, by other code")
        elif reason:
            self._findings.difference(
                "marker message", f"the markers of obstacles, by {reason}", rounding=_MOVED in reason
            )

    def _wrong_gone(self, told: tuple[str, ...], changed: bool) -> str:
        if changed and self._removed is not None and set(told) != set(self._removed):
            return f"those that are gone ({', '.join(told) or 'none'} is recorded)"
        there = [name for name in told if name in self._names]
        unknown = [name for name in told if self._removed is not None and name not in self._known]
        return f"{(there or unknown)[0]}, which is not gone" if there or unknown else ""

    def _again(self, simulation: Simulation, gone: tuple[str, ...]) -> _Layout:
        if gone not in self._layouts:
            solids, _ = solids_and_poses(simulation.obstacles, simulation.pinching)
            self._layouts[gone] = _Layout(solids, frame_id=self._frame_id, node=self._node, gone=gone)
        return self._layouts[gone]


class _Layout:
    """Encoder of visualization_msgs/MarkerArray messages that differ in stamps and poses only."""

    def __init__(self, solids: Sequence[Obstacle], *, frame_id: str, node: str, gone: Sequence[str]) -> None:
        markers = [_marker(ns=f"{node}/{name}", id=number, action=_DELETE) for name in gone for number in range(_MOST)]
        #: Index of the obstacle of each marker, and the marker's offset in the obstacle's frame [m].
        self._parts: list[tuple[int, NDArray[np.float64]]] = []
        for k, solid in enumerate(solids):
            for number, (fields, place) in enumerate(_parts(solid)):
                colour = _GROUND if solid.shape == "plane" else _COLOUR
                markers.append(_marker(ns=f"{node}/{solid.name}", id=number, action=_ADD, colour=colour, **fields))
                markers[-1].pose.position.x = _MARKED_PLACE * (1 + len(self._parts))
                self._parts.append((k, place))
        for number, marker in enumerate(markers):
            marker.header.frame_id = frame_id
            marker.header.stamp.sec = _MARKED_SECOND + number
        self._data = bytearray(encode(message_class(MARKERS)(markers=markers), MARKERS))
        self._stamps, start = [], 0
        for number in range(len(markers)):
            start = self._data.index(struct.pack("<i", _MARKED_SECOND + number), start)
            self._stamps.append(start)
        self._places, start = [], 0
        for number in range(len(self._parts)):
            start = self._data.index(struct.pack("<d", _MARKED_PLACE * (1 + number)), start)
            self._places.append(start)

        #: Padding bytes between fields; a middleware leaves them uninitialised.
        self._gaps = np.zeros(len(self._data), dtype=np.bool_)

    def is_same(self, recorded: bytes, poses: Array, stamp: int) -> bool:
        """Return True if a message equals the markers of `poses` at a ROS time [ns], up to known padding."""
        again = self.at(poses, stamp)
        if same_bytes(recorded, again):
            return True
        if len(recorded) != len(again):
            return False
        return not (self._unlike(recorded) & ~self._gaps).any()

    def learn_gaps(self, recorded: bytes) -> None:
        """Learn the padding of a message whose fields equal those of the last `encode`."""
        if len(recorded) == len(self._data):
            found = self._unlike(recorded)
            for start in self._places:
                found[start : start + 56] = False
            self._gaps |= found

    def _unlike(self, recorded: bytes) -> NDArray[np.bool_]:
        return np.frombuffer(recorded, np.uint8) != np.frombuffer(self._data, np.uint8)

    def at(self, poses: Array, stamp: int) -> bytes:
        """Encode the markers for poses (obstacle_count, 7) at a ROS time [ns]."""
        time = struct.pack("<iI", *divmod(stamp, 10**9))
        for start in self._stamps:
            self._data[start : start + 8] = time
        for start, (k, place) in zip(self._places, self._parts, strict=True):
            pose = poses[k]
            at = (pose[:3] + rotation_matrix(pose[3:]) @ place).tolist()
            struct.pack_into("<7d", self._data, start, *at, *pose[3:].tolist())
        return bytes(self._data)


_LOOKS, _MOVED = "their looks", "m of its place"


def _difference(recorded: Sequence[Any], again: Sequence[Any]) -> str:
    if [(one.ns, one.id, one.action) for one in recorded] != [(one.ns, one.id, one.action) for one in again]:
        return "their names"
    found = ""
    for one, other in zip(recorded, again, strict=True):
        if one.header != other.header:
            return f"the header of {one.ns}"
        away = float(np.abs(_numbers(one.pose) - _numbers(other.pose)).max())
        if not away <= _NEAR:
            return f"{away:.3g} {_MOVED}, of {one.ns}"
        if one.type != other.type or not np.allclose(_numbers(one.scale), _numbers(other.scale), rtol=0, atol=_NEAR):
            return f"the size of {one.ns}"
        if [_numbers(point).tolist() for point in one.points] != [_numbers(point).tolist() for point in other.points]:
            return f"the mesh of {one.ns}"
        other.pose, other.scale = one.pose, one.scale
        if encode(one, "visualization_msgs/msg/Marker") != encode(other, "visualization_msgs/msg/Marker"):
            found = _LOOKS
    return found


def _numbers(value: Any) -> NDArray[np.float64]:
    """Return the numbers of a pose, point or vector."""
    if hasattr(value, "orientation"):
        return np.concatenate([_numbers(value.position), _numbers(value.orientation)])
    return np.array([getattr(value, axis) for axis in "xyzw" if hasattr(value, axis)])


def _parts(solid: Obstacle) -> list[tuple[dict[str, Any], NDArray[np.float64]]]:
    """Return type, size and points of the markers of an obstacle, and their offsets in its frame [m]."""
    here = np.zeros(3)
    if solid.shape == "plane":
        width, height = _PLANE
        return [({"type": _CUBE, "scale": (width, width, height)}, np.array([0.0, 0.0, -0.5 * height]))]
    if solid.shape == "box":
        return [({"type": _CUBE, "scale": tuple(solid.size)}, here)]
    if solid.shape == "sphere":
        return [({"type": _SPHERE, "scale": (2.0 * solid.size[0],) * 3}, here)]
    if solid.shape in ("cylinder", "capsule"):
        radius, length = solid.size
        width = 2.0 * radius
        found: list[tuple[dict[str, Any], NDArray[np.float64]]] = [
            ({"type": _CYLINDER, "scale": (width, width, length)}, here)
        ]
        if solid.shape == "capsule":
            found += [
                ({"type": _SPHERE, "scale": (width,) * 3}, np.array([0.0, 0.0, side * length])) for side in (-0.5, 0.5)
            ]
        return found
    assert solid.vertices is not None
    assert solid.triangles is not None
    points = solid.vertices[solid.triangles.ravel()].tolist()
    return [({"type": _TRIANGLES, "scale": (1.0, 1.0, 1.0), "points": points}, here)]


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
    of, point = message_class, message_class("geometry_msgs/msg/Point")

    def header() -> Any:
        return of("std_msgs/msg/Header")(stamp=of("builtin_interfaces/msg/Time")(sec=0, nanosec=0), frame_id="")

    empty = np.empty(0, dtype=np.uint8)
    return of("visualization_msgs/msg/Marker")(
        header=header(),
        ns=ns,
        id=id,
        type=type,
        action=action,
        pose=of("geometry_msgs/msg/Pose")(
            position=point(x=0.0, y=0.0, z=0.0),
            orientation=of("geometry_msgs/msg/Quaternion")(x=0.0, y=0.0, z=0.0, w=1.0),
        ),
        scale=of("geometry_msgs/msg/Vector3")(**dict(zip("xyz", map(float, scale), strict=True))),
        color=of("std_msgs/msg/ColorRGBA")(**dict(zip("rgba", colour, strict=True))),
        lifetime=of("builtin_interfaces/msg/Duration")(sec=0, nanosec=0),
        frame_locked=False,
        points=[point(x=x, y=y, z=z) for x, y, z in points],
        colors=[],
        texture_resource="",
        texture=of("sensor_msgs/msg/CompressedImage")(header=header(), format="", data=empty),
        uv_coordinates=[],
        text="",
        mesh_resource="",
        mesh_file=of("visualization_msgs/msg/MeshFile")(filename="", data=empty),
        mesh_use_embedded_materials=False,
    )
