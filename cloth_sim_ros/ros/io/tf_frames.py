# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Transformation of commands into the cloth's coordinate frame by tf2."""

from __future__ import annotations

from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.time import Time

from cloth_sim_ros.physics.plan.gripper_path import normalized, quaternion_product, rotation_matrix
from cloth_sim_ros.ros.io.messages import read_stamp
from cloth_sim_ros.scene.frame_ids import fault

#: Largest age of the newest transform relative to a command's stamp [ns]: a command comes before its transform.
_MAX_TRANSFORM_AGE = 100_000_000

Pose = tuple[tuple[float, ...], tuple[float, ...] | None]


class FrameError(ValueError):
    """A pose that can't be transformed into the cloth's frame; the message says why."""


class FrameTransformer:
    """Transforms poses into the cloth's frame.

    The first pose in another frame imports tf2 and subscribes to /tf.
    """

    def __init__(self, node: Node, frame_id: str) -> None:
        self._node, self._frame_id = node, frame_id
        self._tf2: Any = None
        self._buffer: Any = None
        self._listener: Any = None
        self._transform_stamp = 0
        #: True if tf2 could not be imported. A second import would cost time in each frame of a following gripper.
        self._is_tf2_missing = False

    def to_cloth(
        self, frame_id: str, position: tuple[float, ...], orientation: tuple[float, ...] | None, stamp: int
    ) -> Pose:
        """Return position [m] and orientation (or None) in the cloth's frame.

        Args:
            frame_id: frame of the command; empty means the cloth's.
            position: 3 numbers [m].
            orientation: quaternion x, y, z, w, or None.
            stamp: ROS time of the command [ns]; zero for the newest transform. If the transform at the stamp is not
                known yet, the newest one is used if it is at most 0.1 s older.

        Raises:
            FrameError: if the name is invalid in tf2, or no transform connects the frames.
        """
        if frame_id in ("", self._frame_id):
            return position, orientation
        if words := fault(frame_id):
            raise FrameError(f"its frame_id is {frame_id!r}; {words}")
        try:
            translation, rotation = self._lookup(frame_id, stamp)
        except FrameError:
            if not stamp:
                raise
            translation, rotation = self._lookup(frame_id, 0)
            if not 0 < stamp - self._transform_stamp <= _MAX_TRANSFORM_AGE:
                raise
        new_position = rotation_matrix(rotation) @ np.asarray(position) + translation
        new_orientation = (
            None if orientation is None else quaternion_product(rotation.tolist(), normalized(orientation).tolist())
        )
        return tuple(new_position.tolist()), new_orientation

    def newest(self, frame_id: str) -> tuple[tuple[float, ...], tuple[float, ...], int]:
        """Return the newest position [m], orientation x, y, z, w and stamp [ns] of a frame in the cloth's frame.

        Raises:
            FrameError: if no transform connects the frames.
        """
        translation, rotation = self._lookup(frame_id, 0)
        return tuple(translation.tolist()), tuple(rotation.tolist()), self._transform_stamp

    def clear(self) -> None:
        """Clear the dynamic transforms, because the clock was set back; static ones stay."""
        if self._buffer is not None:
            self._buffer.clear()

    def _lookup(self, frame_id: str, stamp: int) -> tuple[np.ndarray, np.ndarray]:
        self._start_listener(frame_id)
        try:
            answer = self._buffer.lookup_transform(self._frame_id, frame_id, Time(nanoseconds=stamp))
        except self._tf2.TransformException as error:
            raise FrameError(
                f"no transform from '{frame_id}' to the cloth's frame '{self._frame_id}': {error}"
            ) from error
        self._transform_stamp = read_stamp(answer.header.stamp)
        t, r = answer.transform.translation, answer.transform.rotation
        return np.array([t.x, t.y, t.z]), normalized([r.x, r.y, r.z, r.w])

    def _start_listener(self, frame_id: str) -> None:
        if self._buffer is not None:
            return
        if not self._is_tf2_missing:
            try:
                import tf2_ros
            except ImportError:
                self._is_tf2_missing = True
        if self._is_tf2_missing:
            raise FrameError(
                f"'{frame_id}' is not the cloth's frame '{self._frame_id}', and tf2_ros, which would transform it, is "
                f"not installed: sudo apt install ros-jazzy-tf2-ros-py, or give poses in '{self._frame_id}'"
            )
        self._tf2, self._buffer = tf2_ros, tf2_ros.Buffer()
        self._listener = tf2_ros.TransformListener(self._buffer, self._node)
