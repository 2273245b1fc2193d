# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The smooth path of a gripper over one frame, from its present pose and velocity to its newest target."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from cloth_sim_ros.engine.binding import PATH_NUMBERS
from cloth_sim_ros.physics.angles import arctangent
from cloth_sim_ros.physics.forces.force import Array


def normalised(orientation: ArrayLike) -> Array:
    """Return the unit quaternion (x, y, z, w).

    Raises:
        ValueError: if it is not finite or has no length.
    """
    q = np.asarray(orientation, dtype=np.float64)
    length = 0.0
    if q.shape == (4,):
        x, y, z, w = q.tolist()
        length = math.sqrt(x * x + y * y + z * z + w * w)
    if not math.isfinite(length) or length < 1e-6:
        raise ValueError(
            f"orientation {np.asarray(orientation).tolist()} is no quaternion x, y, z, w of a length above 0"
        )
    return q / length


def product(a: Sequence[float], b: Sequence[float]) -> tuple[float, float, float, float]:
    """Return the quaternion product a b, (x, y, z, w): the rotation b followed by a."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def rotation_vector(start: Sequence[float], end: Sequence[float]) -> Array:
    """Return the rotation vector [rad], shape (3,), of the shortest turn from one unit quaternion to another."""
    x, y, z, w = product(end, (-start[0], -start[1], -start[2], start[3]))
    if w < 0.0:
        x, y, z, w = -x, -y, -z, -w
    sine = math.sqrt(x * x + y * y + z * z)
    # atan(sine / w) / sine -> 1 as the turn vanishes.
    scale = 2.0 * arctangent(sine, w) / sine if sine > 1e-12 else 2.0
    return np.array([scale * x, scale * y, scale * z])


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
    place, end = pose.tolist(), target.tolist()
    turn = [end[i] - place[i] for i in range(3)] + rotation_vector(place[3:], end[3:]).tolist()
    begin, before = twist.tolist(), last_turn.tolist()
    row, end_twist = [0.0] * PATH_NUMBERS, [0.0] * 6
    row[0] = t
    row[1:4], row[13:17] = place[:3], place[3:]
    for part, first in ((0, 4), (3, 17)):
        d, d0 = turn[part : part + 3], before[part : part + 3]
        square = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
        shared = d[0] * d0[0] + d[1] * d0[1] + d[2] * d0[2]
        kept = min(1.0, max(0.0, shared / square)) if square > 0.0 else 0.0
        for i in range(3):
            mean, v = d[i] / duration, begin[part + i]
            last = mean * kept
            row[first + i] = v
            row[first + 3 + i] = (3.0 * mean - 2.0 * v - last) / duration
            row[first + 6 + i] = (v + last - 2.0 * mean) / (duration * duration)
            end_twist[part + i] = last
    return np.array(row), np.array(end_twist), np.array(turn)
