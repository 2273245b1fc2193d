# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The smooth path of a gripper over one frame, from its present pose and velocity to its newest target."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from cloth_sim_ros.physics.angles import arctangent, sine_and_cosine
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


def rotation_vector(start: Sequence[float], end: Sequence[float]) -> Sequence[float]:
    """Return the rotation vector [rad], 3 numbers, of the shortest turn from one unit quaternion to another."""
    x, y, z, w = product(end, (-start[0], -start[1], -start[2], start[3]))
    if w < 0.0:
        x, y, z, w = -x, -y, -z, -w
    sine = math.sqrt(x * x + y * y + z * z)
    # atan(sine / w) / sine -> 1 as the turn vanishes.
    scale = 2.0 * arctangent(sine, w) / sine if sine > 1e-12 else 2.0
    return scale * x, scale * y, scale * z


def turned_by(orientation: Sequence[float], rotation: Sequence[float]) -> list[float]:
    """Return a unit quaternion (x, y, z, w) turned by a rotation vector of at most pi [rad]."""
    x, y, z = rotation
    angle = math.sqrt(x * x + y * y + z * z)
    sine, cosine = sine_and_cosine(0.5 * angle)
    # sin(angle / 2) / angle -> 1/2 as the turn vanishes.
    scale = sine / angle if angle > 1e-12 else 0.5
    found: list[float] = normalised(product((scale * x, scale * y, scale * z, cosine), orientation)).tolist()
    return found


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
    t: float,
    duration: float,
    pose: Sequence[float],
    twist: Sequence[float],
    last_turn: Sequence[float],
    target: Sequence[float],
) -> tuple[list[float], list[float], list[float]]:
    """Return the path over one frame, the twist at its end, and this frame's displacement and turn.

    A cubic from pose and twist to the target. Its end velocity is the part of this frame's mean velocity that the last
    frame had too: a steady stream of targets is followed without ripple, a jump arrives at rest without overshoot. See
    docs/design.md. Lists go in and out: for so few numbers arrays would take several times as long.

    Args:
        t: time of the frame's start [s].
        duration: length of the frame [s].
        pose: position [m] and unit quaternion x, y, z, w.
        twist: velocity [m/s] and angular velocity [rad/s], 6 numbers.
        last_turn: displacement [m] and rotation vector [rad] over the frame before, 6 numbers.
        target: pose at the frame's end.
    """
    moved = [target[i] - pose[i] for i in range(3)]
    turned = rotation_vector(pose[3:], target[3:])
    way, end = _cubic(moved, twist[:3], last_turn[:3], duration)
    turning, end_spin = _cubic(turned, twist[3:], last_turn[3:], duration)
    return [t, *pose[:3], *way, *pose[3:], *turning], [*end, *end_spin], [*moved, *turned]


def _cubic(
    way: Sequence[float], start: Sequence[float], before: Sequence[float], duration: float
) -> tuple[list[float], list[float]]:
    """Return the coefficients, 9 numbers, of a cubic that goes a way over a duration from a start velocity, and its end
    velocity. The frame before went another way.
    """
    (dx, dy, dz), (bx, by, bz) = way, before
    square = dx * dx + dy * dy + dz * dz
    shared = dx * bx + dy * by + dz * bz
    kept = min(1.0, max(0.0, shared / square)) if square > 0.0 else 0.0
    mean = [d / duration for d in way]
    last = [m * kept for m in mean]
    second = [(3.0 * m - 2.0 * v - e) / duration for m, v, e in zip(mean, start, last, strict=True)]
    third = [(v + e - 2.0 * m) / (duration * duration) for m, v, e in zip(mean, start, last, strict=True)]
    return [*start, *second, *third], last
