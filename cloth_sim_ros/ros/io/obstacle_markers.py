# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Obstacles as a visualization_msgs/MarkerArray for RViz and the replay."""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np
from geometry_msgs.msg import Point, Vector3
from numpy.typing import NDArray
from rclpy.serialization import serialize_message
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from cloth_sim_ros.physics.contact.obstacles import Obstacle
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.gripper_path import body_points

#: Width and height of the slab that shows a plane, which is its upper side [m].
PLANE_SIZE = (10.0, 0.002)
#: Numbers that locate stamps and poses in the bytes of a message.
_MARKED_SECOND, _MARKED_POSITION = 0x5AC3_0000, 1.2345e222
_COLOUR, _GROUND = ColorRGBA(r=0.45, g=0.5, b=0.58, a=1.0), ColorRGBA(r=0.24, g=0.26, b=0.3, a=1.0)


class ObstacleMarkers:
    """Serializer of obstacles as a MarkerArray; namespaces `<node>/<obstacle>` let one display show several cloths.

    Args:
        solids: the obstacles.
        frame_id: coordinate frame.
        node: the node's full name.
        removed: names of obstacles whose markers are to be deleted.
    """

    def __init__(self, solids: Sequence[Obstacle], *, frame_id: str, node: str, removed: Sequence[str] = ()) -> None:
        parts: list[tuple[int, Marker, NDArray[np.float64]]] = []
        for k, solid in enumerate(solids):
            for index, (marker, offset) in enumerate(_markers(solid)):
                marker.ns, marker.id, marker.action = f"{node}/{solid.name}", index, Marker.ADD
                # Planes are darker than the objects on them.
                marker.color = _GROUND if solid.shape == "plane" else _COLOUR
                marker.header.frame_id = frame_id
                marker.pose.position.x = _MARKED_POSITION * (1 + len(parts))
                parts.append((k, marker, offset))
        markers = [
            Marker(ns=f"{node}/{name}", id=index, action=Marker.DELETE)
            for name in removed
            for index in range(_MAX_MARKERS)
        ]
        markers += [marker for _, marker, _ in parts]
        for index, marker in enumerate(markers):
            marker.header.frame_id, marker.header.stamp.sec = frame_id, _MARKED_SECOND + index
        #: Index of the obstacle of each marker that is drawn, and its position in the obstacle's frame [m].
        self._obstacles = np.array([k for k, _, _ in parts], dtype=np.int64)
        self._offsets = np.array([offset for _, _, offset in parts]).reshape(-1, 3)
        # Messages differ in stamps and poses alone: to serialize all markers of a robot in each frame takes too long.
        data = bytes(serialize_message(MarkerArray(markers=markers)))
        seconds = [struct.pack("<i", _MARKED_SECOND + index) for index in range(len(markers))]
        positions = [struct.pack("<d", _MARKED_POSITION * (1 + index)) for index in range(len(parts))]
        self._data = np.frombuffer(data, np.uint8).copy()
        #: Indices of the bytes of each stamp and of each pose.
        self._stamps, self._poses = _byte_indices(data, seconds, 8), _byte_indices(data, positions, 56)

    def serialize(self, poses: Array, stamp: int) -> bytes:
        """Return the CDR bytes of the MarkerArray for poses (obstacle_count, 7) at a ROS time [ns]."""
        self._data[self._stamps] = np.frombuffer(struct.pack("<iI", *divmod(stamp, 10**9)), np.uint8)
        numbers = poses[self._obstacles].astype("<f8")
        numbers[:, :3] = body_points(numbers, self._offsets)
        self._data[self._poses] = numbers.view(np.uint8)
        return self._data.tobytes()


#: Markers of one obstacle at most: a capsule has three.
_MAX_MARKERS = 3


def _markers(solid: Obstacle) -> list[tuple[Marker, NDArray[np.float64]]]:
    """Return the markers of an obstacle, each with its position in the obstacle's frame [m], shape (3,)."""
    origin = np.zeros(3)
    match solid.shape:
        case "plane":
            width, height = PLANE_SIZE
            return [(_marker(Marker.CUBE, width, width, height), np.array([0.0, 0.0, -0.5 * height]))]
        case "box":
            return [(_marker(Marker.CUBE, *solid.size), origin)]
        case "sphere":
            return [(_marker(Marker.SPHERE, *[2.0 * solid.size[0]] * 3), origin)]
        case "cylinder" | "capsule":
            radius, length = solid.size
            width = 2.0 * radius
            markers = [(_marker(Marker.CYLINDER, width, width, length), origin)]
            if solid.shape == "capsule":
                for end in (-0.5, 0.5):
                    markers.append((_marker(Marker.SPHERE, width, width, width), np.array([0.0, 0.0, end * length])))
            return markers
    assert solid.vertices is not None
    assert solid.triangles is not None
    marker = _marker(Marker.TRIANGLE_LIST, 1.0, 1.0, 1.0)
    marker.points = [Point(x=x, y=y, z=z) for x, y, z in solid.vertices[solid.triangles.ravel()].tolist()]
    return [(marker, origin)]


def _marker(kind: int, x: float, y: float, z: float) -> Marker:
    return Marker(type=kind, scale=Vector3(x=x, y=y, z=z))


def _byte_indices(data: bytes, marks: Sequence[bytes], length: int) -> NDArray[np.int64]:
    """Return the indices of `length` bytes from each mark in data on, shape (marks, length); marks come in order."""
    starts, start = [], 0
    for mark in marks:
        start = data.index(mark, start)
        starts.append(start)
    return np.array(starts, dtype=np.int64)[:, None] + np.arange(length)
