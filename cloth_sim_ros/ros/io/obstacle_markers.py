# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Obstacles as a visualization_msgs/MarkerArray for RViz and the replay."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from geometry_msgs.msg import Point, Pose, Quaternion, Vector3
from numpy.typing import NDArray
from rclpy.serialization import serialize_message
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from cloth_sim_ros.physics.contact.obstacles import Obstacle
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.gripper_path import rotation_matrix
from cloth_sim_ros.ros.io.messages import set_stamp

#: Width and height of the slab that shows a plane, which is its upper side [m].
PLANE_SIZE = (10.0, 0.002)
_COLOUR, _GROUND = ColorRGBA(r=0.45, g=0.5, b=0.58, a=1.0), ColorRGBA(r=0.24, g=0.26, b=0.3, a=1.0)


class ObstacleMarkers:
    """Markers of obstacles, with namespaces `<node>/<obstacle>` so that one display shows several cloths.

    Args:
        solids: the obstacles.
        frame_id: coordinate frame.
        node: the node's full name.
        removed: names of obstacles whose markers are to be deleted.
    """

    def __init__(self, solids: Sequence[Obstacle], *, frame_id: str, node: str, removed: Sequence[str] = ()) -> None:
        #: For each marker: index of its obstacle, the marker, and its position in the obstacle's frame [m].
        self._parts: list[tuple[int, Marker, NDArray[np.float64]]] = []
        for k, solid in enumerate(solids):
            for index, (marker, offset) in enumerate(_markers(solid)):
                marker.ns, marker.id, marker.action = f"{node}/{solid.name}", index, Marker.ADD
                # Planes are darker than the objects on them.
                marker.color = _GROUND if solid.shape == "plane" else _COLOUR
                marker.header.frame_id = frame_id
                self._parts.append((k, marker, offset))
        self._removed = [
            Marker(ns=f"{node}/{name}", id=index, action=Marker.DELETE)
            for name in removed
            for index in range(_MAX_MARKERS)
        ]
        for marker in self._removed:
            marker.header.frame_id = frame_id

    def serialized(self, poses: Array, stamp: int) -> bytes:
        """Return the CDR bytes for poses (obstacle_count, 7) at a ROS time [ns]."""
        for k, marker, offset in self._parts:
            set_stamp(marker.header.stamp, stamp)
            marker.pose = _pose(poses[k], offset)
        for marker in self._removed:
            set_stamp(marker.header.stamp, stamp)
        return bytes(
            serialize_message(MarkerArray(markers=[*self._removed, *(marker for _, marker, _ in self._parts)]))
        )


#: Markers of one obstacle at most: a capsule has three.
_MAX_MARKERS = 3


def _markers(solid: Obstacle) -> list[tuple[Marker, NDArray[np.float64]]]:
    """Return the markers of an obstacle and their positions in its frame [m], shape (3,)."""
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


def _pose(pose: Array, offset: NDArray[np.float64]) -> Pose:
    x, y, z = (pose[:3] + rotation_matrix(pose[3:]) @ offset).tolist()
    qx, qy, qz, qw = pose[3:].tolist()
    return Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))
