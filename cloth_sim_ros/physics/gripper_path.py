# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The smooth path of a gripper over one frame, from its present pose and velocity to its newest target."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from cloth_sim_ros.physics.kernels.grips import PATH_COLUMNS
from cloth_sim_ros.physics.terms.base import Array


def normalised(orientation: ArrayLike) -> Array:
    """Return the unit quaternion (x, y, z, w).

    Raises:
        ValueError: if it is not finite or has no length.
    """
    q = np.asarray(orientation, dtype=np.float64)
    length = float(np.sqrt(np.sum(q * q))) if q.shape == (4,) else 0.0
    if not np.isfinite(length) or length < 1e-6:
        raise ValueError(
            f"orientation {np.asarray(orientation).tolist()} is no quaternion x, y, z, w of a length above 0"
        )
    return q / length


def product(a: Array, b: Array) -> Array:
    """Return the quaternion product a b, (x, y, z, w): the rotation b followed by a."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return np.array(
        [
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ]
    )


def rotation_vector(start: Array, end: Array) -> Array:
    """Return the rotation vector [rad], shape (3,), of the shortest turn from one unit quaternion to another."""
    x, y, z, w = product(end, np.array([-start[0], -start[1], -start[2], start[3]]))
    if w < 0.0:
        x, y, z, w = -x, -y, -z, -w
    sine = float(np.sqrt(x * x + y * y + z * z))
    # atan2(sine, w) / sine -> 1 as the turn vanishes.
    scale = 2.0 * float(np.arctan2(sine, w)) / sine if sine > 1e-12 else 2.0
    return scale * np.array([x, y, z])


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


def path_row(
    t: float, duration: float, pose: Array, twist: Array, last_turn: Array, target: Array
) -> tuple[Array, Array, Array]:
    """Return the path over one frame, the twist at its end, and this frame's displacement and turn.

    A cubic from pose and twist to the target. Its end velocity is the part of this frame's mean velocity that the last
    frame had too:
    a steady stream of targets is followed without ripple, a jump arrives at rest without overshoot. See docs/design.md.

    Args:
        t: time of the frame's start [s].
        duration: length of the frame [s].
        pose: position [m] and unit quaternion x, y, z, w, shape (7,).
        twist: velocity [m/s] and angular velocity [rad/s], shape (6,).
        last_turn: displacement [m] and rotation vector [rad] over the frame before, shape (6,).
        target: pose at the frame's end, shape (7,).
    """
    turn = np.concatenate([target[:3] - pose[:3], rotation_vector(pose[3:], target[3:])])
    row = np.zeros(PATH_COLUMNS)
    row[0] = t
    row[1:4] = pose[:3]
    row[13:17] = pose[3:]
    end_twist = np.zeros(6)
    for part, first in ((slice(0, 3), 4), (slice(3, 6), 17)):
        d = turn[part]
        square = float(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
        before = last_turn[part]
        shared = float(d[0] * before[0] + d[1] * before[1] + d[2] * before[2])
        end = d / duration * (min(1.0, max(0.0, shared / square)) if square > 0.0 else 0.0)
        begin = twist[part]
        row[first : first + 3] = begin
        row[first + 3 : first + 6] = (3.0 * d / duration - 2.0 * begin - end) / duration
        row[first + 6 : first + 9] = (begin + end - 2.0 * d / duration) / duration**2
        end_twist[part] = end
    return row, end_twist, turn
