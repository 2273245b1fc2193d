# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Drawing of obstacles from their recorded markers."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.replay.rows import Moment, Rows
from cloth_sim_ros.session.cdr import decode

if TYPE_CHECKING:
    import rerun as rr

_MARKERS = "visualization_msgs/msg/MarkerArray"
#: visualization_msgs/Marker: kinds and actions.
_CUBE, _SPHERE, _CYLINDER, _TRIANGLES = 1, 2, 3, 11
_DELETE, _DELETE_ALL = 2, 3


def obstacle_path(namespace: str, marker_id: int) -> str:
    """Return the Rerun entity path of an obstacle's marker, from the marker's namespace and id."""
    return f"/world/obstacles/{namespace.rpartition('/')[2]}/{marker_id}"


class ObstacleView:
    """Drawing of a session's obstacles in Rerun.

    Args:
        recording: Rerun stream.
        table: returns the rows of an entity path and archetype.
    """

    def __init__(self, recording: rr.RecordingStream, table: Callable[..., Rows]) -> None:
        self._recording = recording
        self._table = table
        #: Encoded geometry by path and kind of marker; None if hidden.
        self._shown: dict[tuple[str, int], bytes | None] = {}

    def show(self, moment: Moment, data: bytes | memoryview) -> None:
        """Add rows with the markers of a serialized MarkerArray at a moment. Raises SessionError for other bytes.

        Raises:
            SessionError: if the bytes are not one.
        """
        import rerun as rr

        for marker in decode(data, _MARKERS).markers:
            if marker.action == _DELETE_ALL:
                self._hide(moment, list(self._shown))
                continue
            path = obstacle_path(marker.ns, marker.id)
            if marker.action == _DELETE:
                self._hide(moment, [key for key in self._shown if key[0] == path])
                continue
            geometry = _geometry(marker)
            if geometry is None:
                continue
            key, shape_bytes = (path, marker.type), b"".join(array.tobytes() for array in geometry.values())
            if self._shown.get(key) != shape_bytes:
                self._hide(moment, [shown for shown in self._shown if shown[0] == path and shown != key])
                self._draw(moment, key, geometry, marker.color)
                self._shown[key] = shape_bytes
            p, q = marker.pose.position, marker.pose.orientation
            translation, quaternion = np.array([p.x, p.y, p.z], np.float32), np.array([q.x, q.y, q.z, q.w], np.float32)
            self._table(path, rr.Transform3D).add(moment, translation=translation, quaternion=quaternion)

    def _draw(
        self, moment: Moment, key: tuple[str, int], geometry: dict[str, NDArray[np.float32]], colour: Any
    ) -> None:
        path, kind = key
        if key not in self._shown:
            self._recording.log(path, _static_components(kind, colour), static=True)
        self._table(path, _archetype(kind), ragged=tuple(geometry)).add(moment, **geometry)

    def _hide(self, moment: Moment, keys: list[tuple[str, int]]) -> None:
        for path, kind in keys:
            if self._shown[path, kind] is not None:
                nothing = {name: array[:0] for name, array in _EMPTY[kind].items()}
                self._table(path, _archetype(kind), ragged=tuple(nothing)).add(moment, **nothing)
                self._shown[path, kind] = None


_EMPTY: dict[int, dict[str, NDArray[np.float32]]] = {
    _CUBE: {"half_sizes": np.zeros((0, 3), np.float32)},
    _SPHERE: {"half_sizes": np.zeros((0, 3), np.float32)},
    _CYLINDER: {"lengths": np.zeros(0, np.float32), "radii": np.zeros(0, np.float32)},
    _TRIANGLES: {"vertex_positions": np.zeros((0, 3), np.float32), "vertex_normals": np.zeros((0, 3), np.float32)},
}


def _archetype(kind: int) -> Any:
    import rerun as rr

    return {_CUBE: rr.Boxes3D, _SPHERE: rr.Ellipsoids3D, _CYLINDER: rr.Cylinders3D, _TRIANGLES: rr.Mesh3D}[kind]


def _static_components(kind: int, colour: Any) -> Any:
    """Return the Rerun components of a marker that do not change: colour and fill mode."""
    import rerun as rr

    rgba = np.clip(np.nan_to_num([[colour.r, colour.g, colour.b, colour.a]]), 0.0, 1.0) * 255.0
    packed_colour = np.ascontiguousarray(rgba.round().astype(np.uint8)).view(">u4")[:, 0].astype(np.uint32)
    if kind == _TRIANGLES:
        return rr.Mesh3D.from_fields(albedo_factor=packed_colour)
    return _archetype(kind).from_fields(fill_mode=rr.components.FillMode.Solid, colors=packed_colour)


def _geometry(marker: Any) -> dict[str, NDArray[np.float32]] | None:
    """Return the Rerun components of a marker's shape, arrays by name; None for kinds that are not drawn."""
    size = np.array([marker.scale.x, marker.scale.y, marker.scale.z], np.float32)
    if marker.type in (_CUBE, _SPHERE):
        return {"half_sizes": 0.5 * size[None]}
    if marker.type == _CYLINDER:
        return {"lengths": size[2:], "radii": 0.5 * size[:1]}
    if marker.type != _TRIANGLES:
        return None
    # Corners of an incomplete triangle are left out.
    points = marker.points[: len(marker.points) // 3 * 3]
    corners = np.array([[point.x, point.y, point.z] for point in points], np.float32).reshape(-1, 3) * size
    sides = corners.reshape(-1, 3, 3)
    normals = np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1), np.float32(1e-30))[:, None]
    return {"vertex_positions": corners, "vertex_normals": np.repeat(normals, 3, axis=0)}
