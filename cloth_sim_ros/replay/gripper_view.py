# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Drawing of grippers: wire sphere, axes, commanded path, grasped particles."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.replay import colours
from cloth_sim_ros.replay.grippers import GripperTracks
from cloth_sim_ros.replay.rows import Moment, Rows

if TYPE_CHECKING:
    import rerun as rr

_AXES = np.eye(3, dtype=np.float32)
_AXIS_COLOURS = ((230, 80, 80), (90, 200, 90), (90, 140, 250))


def gripper_path(name: str) -> str:
    """Return the Rerun entity path of a gripper."""
    return f"/world/grippers/{name}"


def target_path(name: str) -> str:
    """Return the Rerun entity path of a gripper's targets."""
    return f"/world/targets/{name}"


def grasped_path(name: str) -> str:
    """Return the Rerun entity path of the particles that a gripper holds."""
    return f"/world/held/{name}"


class GripperView:
    """Drawing of a session's grippers in Rerun.

    Args:
        tracks: their poses and grasped particles.
        table: returns the rows of an entity path and archetype.
    """

    def __init__(self, tracks: GripperTracks, table: Callable[..., Rows]) -> None:
        self._tracks = tracks
        self._table = table
        self._shown: set[str] = set()

    def start(self, recording: rr.RecordingStream, size: float) -> None:
        """Log the components that do not change, such as line widths, once, for a scene of a size [m]."""
        import rerun as rr

        for name in self._tracks.tracks:
            path = gripper_path(name)
            wireframe, line_radii = rr.components.FillMode.MajorWireframe, [0.0012 * size]
            wires = rr.Ellipsoids3D.from_fields(fill_mode=wireframe, line_radii=line_radii)
            recording.log(f"{path}/body", wires, static=True)
            axes = rr.Arrows3D.from_fields(colors=_AXIS_COLOURS, radii=[0.0018 * size])
            recording.log(f"{path}/axes", axes, static=True)
            for point_path, colour, radius in (
                (target_path(name), colours.TRAIL, 0.0022 * size),
                (grasped_path(name), colours.GRASPED, 0.0055 * size),
            ):
                points = rr.Points3D.from_fields(colors=np.array([colour], np.uint32), radii=[radius])
                recording.log(point_path, points, static=True)

    def show(self, moment: Moment) -> None:
        """Add rows with the grippers' poses at a moment; one without a pose, as after a reset, is hidden."""
        import rerun as rr

        for name, track in self._tracks.tracks.items():
            if track.pose is None and name not in self._shown:
                continue
            self._shown.add(name)
            path = gripper_path(name)
            reach = self._tracks.radius if track.pose is not None else 0.0
            colour = colours.CLOSED_GRIPPER if track.closed else colours.OPEN_GRIPPER
            # The pads of a pinching gripper are drawn with the obstacles.
            sphere = np.full((1, 3), 0.0 if track.pinches else reach, np.float32)
            body = self._table(f"{path}/body", rr.Ellipsoids3D, ragged=("half_sizes",))
            body.add(moment, half_sizes=sphere, colors=np.uint32(colour))
            axes = self._table(f"{path}/axes", rr.Arrows3D, ragged=("vectors",))
            axes.add(moment, vectors=2.0 * np.float32(reach) * _AXES)
            if track.pose is not None:
                translation, rotation = track.pose[:3].astype(np.float32), track.pose[3:].astype(np.float32)
                self._table(path, rr.Transform3D).add(moment, translation=translation, quaternion=rotation)
                target = self._table(target_path(name), rr.Points3D)
                target.add(moment, positions=track.target[:3].astype(np.float32))

    def grasped_positions(self, xyz: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
        """Return the positions (k, 3) [m] of each gripper's grasped particles, from those of all particles (n, 3)."""
        tracks = self._tracks.tracks.items()
        return {name: xyz[:0] if track.grasped is None else xyz[track.grasped] for name, track in tracks}

    def show_grasped(self, moment: Moment, grasped: dict[str, Any]) -> None:
        """Add rows with the positions (k, 3) [m] of grasped particles, by gripper, at a moment."""
        import rerun as rr

        for name, positions in grasped.items():
            self._table(grasped_path(name), rr.Points3D, ragged=("positions",)).add(moment, positions=positions)
