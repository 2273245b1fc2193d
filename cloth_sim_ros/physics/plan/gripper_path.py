# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Smooth paths of grippers over one frame, and quaternion arithmetic.

A path leads from the present pose and velocity to the newest target.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cloth_sim_ros.engine.binding import PATH_NUMBERS, address, check, float64_address, library
from cloth_sim_ros.physics.arithmetic.angles import sine_and_cosine
from cloth_sim_ros.physics.model.forces.force import Array

#: Minimum length of a quaternion that gives a direction.
_MIN_QUATERNION_LENGTH = 1e-6


def normalized(orientation: ArrayLike) -> Array:
    """Return a quaternion (x, y, z, w) scaled to length 1, as an array, shape (4,); refuse one without length.

    Raises:
        ValueError: if its length is below 1e-6, or its square is not finite.
    """
    q = np.asarray(orientation, dtype=np.float64)
    if q.shape != (4,):
        raise _quaternion_error(q.tolist())
    return np.array(unit_quaternion(q.tolist()))


def unit_quaternion(orientation: Sequence[float]) -> tuple[float, float, float, float]:
    """Return what `normalized` does, as a tuple (x, y, z, w); five times as fast.

    Raises:
        ValueError: if its length is below 1e-6, or its square is not finite.
    """
    length = 0.0
    if len(orientation) == 4:
        x, y, z, w = orientation
        length = math.sqrt(x * x + y * y + z * z + w * w)
    if not math.isfinite(length) or length < _MIN_QUATERNION_LENGTH:
        raise _quaternion_error(orientation)
    return x / length, y / length, z / length, w / length


def _quaternion_error(orientation: Any) -> ValueError:
    return ValueError(
        f"orientation {np.asarray(orientation).tolist()} is no quaternion x, y, z, w of a length from "
        f"{_MIN_QUATERNION_LENGTH:g} to 1e154; the identity is 0, 0, 0, 1"
    )


def quaternion_product(a: Sequence[float], b: Sequence[float]) -> tuple[float, float, float, float]:
    """Return the quaternion product a b, (x, y, z, w): the rotation b followed by a."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def rotation_vector(start: Sequence[float], end: Sequence[float]) -> list[float]:
    """Return the rotation vector [rad], 3 numbers, of the shortest rotation from one unit quaternion to another."""
    out = np.empty(3)
    quaternions = [np.array(orientation, dtype=np.float64) for orientation in (start, end)]
    addresses = [float64_address("orientation", array, (4,)) for array in quaternions]
    check(library().cloth_rotation_vector(*addresses, address(out)))
    rotation: list[float] = out.tolist()
    return rotation


def rotated_by(orientation: Sequence[float], rotation: Sequence[float]) -> list[float]:
    """Return a unit quaternion (x, y, z, w) rotated further, in the world's frame, by a vector of at most pi [rad]."""
    x, y, z = rotation
    angle = math.sqrt(x * x + y * y + z * z)
    sine, cosine = sine_and_cosine(0.5 * angle)
    # sin(angle / 2) / angle -> 1/2 as the angle vanishes.
    scale = sine / angle if angle > 1e-12 else 0.5
    product = quaternion_product((scale * x, scale * y, scale * z, cosine), orientation)
    quaternion: list[float] = normalized(product).tolist()
    return quaternion


def rotation_matrix(orientation: Array) -> Array:
    """Return the 3x3 rotation matrix of a unit quaternion (x, y, z, w)."""
    x, y, z, w = orientation
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def to_body_frame(pose: Array, points: Array) -> Array:
    """Return points (3, m) [m] of the world's frame in that of a body with a pose, 7 numbers; shape (m, 3)."""
    x, y, z = points - pose[:3, None]
    rotation = rotation_matrix(pose[3:])
    return np.stack([rotation[0, i] * x + rotation[1, i] * y + rotation[2, i] * z for i in range(3)], axis=1)


def body_points(poses: Array, points: Array) -> Array:
    """Return the world positions [m] of points (n, 3) that are fixed in bodies with poses (n, 7), shape (n, 3)."""
    x, y, z = points.T[:, :, None]
    rows = rotation_matrix(poses[:, 3:].T)
    rotated: Array = rows[:, 0].T * x + rows[:, 1].T * y + rows[:, 2].T * z
    return poses[:, :3] + rotated


def _step_poses(row: Array, t: float, h: float) -> tuple[list[Array], list[list[float]]]:
    """Return the two poses of a body on its path, at the start t and the end t + h of a step [s].

    Returns:
        Two positions [m] and two unit quaternions (x, y, z, w).
    """
    positions, quaternions = [], []
    for moment in (t - float(row[0]), t + h - float(row[0])):
        displacement, rotation = (
            moment * (row[k : k + 3] + moment * (row[k + 3 : k + 6] + moment * row[k + 6 : k + 9])) for k in (4, 17)
        )
        positions.append(row[1:4] + displacement)
        quaternions.append(rotated_by(row[13:17].tolist(), rotation.tolist()))
    return positions, quaternions


def step_displacement(row: Array, t: float, h: float) -> list[float]:
    """Return the displacement [m] and rotation vector [rad] of a body on its path over a step, 6 numbers.

    Args:
        row: the body's path, PATH_NUMBERS.
        t: time at the start of the step [s].
        h: length of the step [s].
    """
    (start, end), quaternions = _step_poses(row, t, h)
    return [*(end - start).tolist(), *rotation_vector(*quaternions)]


def rigid_velocities(row: Array, t: float, h: float, x: Array) -> Array:
    """Return the mean velocities [m/s] over a step of particles that move rigidly with a body, shape (3, n).

    Args:
        row: the body's path, PATH_NUMBERS.
        t: time at the start of the step [s].
        h: length of the step [s].
        x: positions at the start [m], shape (3, n).
    """
    positions, quaternions = _step_poses(row, t, h)
    start_matrix, end_matrix = (rotation_matrix(np.array(quaternion)) for quaternion in quaternions)
    offsets = x - positions[0][:, None]
    # Sums by component: a matrix library would choose the order of summation.
    local = [sum(start_matrix[i, k] * offsets[i] for i in range(3)) for k in range(3)]
    end = np.stack([positions[1][i] + sum(end_matrix[i, k] * local[k] for k in range(3)) for i in range(3)])
    return np.ascontiguousarray((end - x) / h)


class PathPlanner:
    """Planner of smooth paths of grippers and obstacles to their targets, one for a simulation, frame by frame."""

    def __init__(self) -> None:
        # Arrays that the last frame returned, and their addresses: the next call mostly takes them.
        self._last_arrays: tuple[Array | None, ...] = (None, None, None)
        self._last_addresses = (0, 0, 0)

    def plan(
        self, t: float, duration: float, poses: Array, twists: Array, previous: Array, targets: Array
    ) -> tuple[Array, Array, Array, list[float]]:
        """Return cubic paths to the targets over one frame, end twists, displacements, and changes of these.

        The end velocity is the part of this frame's mean velocity that agrees with that of the last frame. A steady
        stream of targets is followed without ripple. A jump arrives at rest without overshoot (docs/design.md).

        Args:
            t: time at the start of the frame [s].
            duration: length of the frame [s].
            poses: positions [m] and unit quaternions (x, y, z, w), shape (count, 7).
            twists: velocities [m/s] and angular velocities [rad/s], shape (count, 6).
            previous: displacements [m] and rotation vectors [rad] over the last frame, shape (count, 6).
            targets: poses at the end of the frame, shape (count, 7).

        Returns:
            Paths, shape (count, PATH_NUMBERS); twists at the end, shape (count, 6); displacements [m] and rotation
            vectors [rad] over the frame, shape (count, 6); largest change of each displacement along an axis since the
            last frame [m].
        """
        count = len(poses)
        pose_shape, twist_shape = (count, 7), (count, 6)
        addresses, last_arrays = self._last_addresses, self._last_arrays
        if not (poses is last_arrays[0] and twists is last_arrays[1] and previous is last_arrays[2]):
            twist_addresses = (
                float64_address("twists", twists, twist_shape),
                float64_address("before", previous, twist_shape),
            )
            addresses = float64_address("poses", poses, pose_shape), *twist_addresses
        target_address = float64_address("targets", targets, pose_shape)
        paths, motion, changes = np.empty((count, PATH_NUMBERS)), np.empty((2, count, 6)), np.empty(count)
        outputs = (address(paths), address(motion), address(changes)) if count else (0, 0, 0)
        next_addresses = outputs[1], outputs[1] + 48 * count
        inputs = count, t, duration, *addresses, target_address
        check(library().cloth_paths(*inputs, outputs[0], *next_addresses, outputs[2]))
        end_twists, displacements = motion[0], motion[1]
        self._last_arrays = targets, end_twists, displacements
        self._last_addresses = target_address, *next_addresses
        return paths, end_twists, displacements, changes.tolist()


def plan_paths(
    t: float, duration: float, poses: Array, twists: Array, previous: Array, targets: Array
) -> tuple[Array, Array, Array, list[float]]:
    """Return for a single frame what `PathPlanner.plan` does: paths, end twists, displacements, changes."""
    return PathPlanner().plan(t, duration, poses, twists, previous, targets)
