# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Poses and grasped particles of the grippers, from the recorded events."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.replay.opening import Opening
from cloth_sim_ros.session.frame_record import FrameRecord

Floats = NDArray[np.float64]


class GripperTrack:
    """Pose, target and grasped particles of one gripper, frame by frame, from recorded events.

    A gripper reaches its target at the end of each frame in which time passes, unless the frame's record has another
    pose. Like in the simulation, it grasps the free particles within its radius when it closes. Their positions come
    from the previous cloud.
    """

    def __init__(
        self,
        name: str,
        *,
        pose: Floats | None,
        target: Floats,
        closed: bool,
        grasped: NDArray[np.int64],
        pinches: bool = False,
    ) -> None:
        self.name = name
        #: True if it closes pads and therefore grasps no particles.
        self.pinches = pinches
        #: Position [m] and quaternion x, y, z, w, shape (7,); None before its first target.
        self.pose = None if pose is None else pose.copy()
        self.target = target.copy()
        self.closed = closed
        #: Indices of the grasped particles; None if no cloud shows their positions at the grasp.
        self.grasped: NDArray[np.intp] | None = grasped.astype(np.intp)

    def set_target(self, position: Floats, orientation: Floats | None) -> None:
        """Set the target position [m] and orientation; the first target places the gripper there."""
        self.target[:3] = position
        if orientation is not None:
            length = np.linalg.norm(orientation)
            if not length > 0.0:
                raise ValueError(f"an orientation has the length {length:g}")
            self.target[3:] = orientation / length
        if self.pose is None:
            self.pose = self.target.copy()

    def end_frame(self, pose: Floats | None, *, is_stopped: bool) -> None:
        """Move the gripper to its pose at the end of a frame: the recorded one, or its target.

        Args:
            pose: recorded pose at the end, shape (7,); None if none is recorded.
            is_stopped: True if the gripper is stopped until it has a new target.
        """
        if pose is not None:
            self.pose = pose
            if is_stopped:
                self.target = pose.copy()
        elif self.pose is not None:
            self.pose = self.target.copy()

    def close(self, xyz: NDArray[np.floating] | None, free: NDArray[np.bool_], radius: float) -> None:
        """Close the gripper; `grasped` becomes the free particles within `radius` [m], or None if `xyz` (n, 3) is."""
        if self.closed:
            return
        self.closed = True
        if self.pose is None or self.pinches:
            return
        self.grasped = None
        if xyz is not None:
            in_reach = np.linalg.norm(xyz - self.pose[:3], axis=1) <= radius
            self.grasped = np.flatnonzero(in_reach & free)

    def open(self) -> None:
        """Open the gripper and release its particles."""
        self.closed = False
        self.grasped = np.zeros(0, dtype=np.intp)


class GripperTracks:
    """Poses, targets and grasped particles of all grippers of a session, frame by frame."""

    def __init__(self, opening: Opening, anchored: NDArray[np.intp]) -> None:
        #: Maximum distance at which a gripper grasps particles [m].
        self.radius = opening.gripper_radius
        self._free = np.ones(len(opening.positions), dtype=bool)
        self.set_anchored(anchored)
        self.tracks = {
            start.name: GripperTrack(
                start.name,
                pose=start.pose,
                target=start.target,
                closed=start.closed,
                grasped=start.grasped,
                pinches=start.pinches,
            )
            for start in opening.grippers
        }

    def set_anchored(self, particles: NDArray[np.intp]) -> None:
        """Set the anchored particles, which grippers do not grasp."""
        self._free[:] = True
        self._free[particles] = False

    def advance(
        self, record: FrameRecord, positions_before: Callable[[], NDArray[np.floating] | None]
    ) -> list[int | None]:
        """Apply a frame's recorded events to `tracks`; return the number of particles grasped after each event.

        Args:
            record: record of the frame.
            positions_before: returns the particles' positions (n, 3) [m] before it; None if no cloud shows them.

        Returns:
            For each event the number of particles that its gripper holds after it; None if unknown, or for events
            without a gripper.
        """
        counts: list[int | None] = []
        for event in record.events:
            kind = event.get("kind")
            track = self.tracks.get(str(event.get("gripper", "")))
            if kind == "target" and track is not None:
                orientation = event.get("orientation")
                track.set_target(np.array(event["position"]), None if orientation is None else np.array(orientation))
            elif kind == "grasp" and track is not None:
                if event["closed"]:
                    track.close(positions_before(), self._free, self.radius)
                else:
                    track.open()
            elif kind == "set_parameters":
                self.radius = float(event["values"].get("gripper.radius", self.radius))
            elif kind == "reset":
                self._reset()
            counts.append(None if track is None or track.grasped is None else len(track.grasped))
        # Not by the number of steps: a sleeping cloth takes none while time passes.
        if not record.paused or any(event.get("kind") == "step" for event in record.events):
            poses, stopped = record.extras.get("poses", {}), record.extras.get("halted", ())
            for name, track in self.tracks.items():
                pose = np.array(poses[name], dtype=np.float64) if name in poses else None
                track.end_frame(pose, is_stopped=name in stopped)
        return counts

    def _reset(self) -> None:
        nowhere = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
        none = np.zeros(0, dtype=np.int64)
        for name, track in self.tracks.items():
            self.tracks[name] = GripperTrack(
                name, pose=None, target=nowhere, closed=False, grasped=none, pinches=track.pinches
            )
