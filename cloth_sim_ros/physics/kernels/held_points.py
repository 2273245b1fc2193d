# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Points held by grippers inside compiled loops: poses tabulated for every step of a run, and what each grip gives.

A point stands at p + R o, with p and R the position and rotation of its gripper and o the grip's offset in the
gripper's frame, and moves with the velocity of p plus the spin times R o (`grips.pose_at`).
"""

from __future__ import annotations

import numba
import numpy as np

from cloth_sim_ros.physics.kernels.grips import pose_at

POSE_NUMBERS = 18
"""Numbers of a pose: position, velocity, rotation matrix by rows, spin."""

BOOKED_NUMBERS = 7
"""What is booked for a grip: impulse [N s] and torque impulse about the gripper's pose [N m s] of the cloth on it, and
the work done on the cloth [J].
"""

_JIT = {"cache": True, "nogil": True, "error_model": "numpy"}


@numba.njit(**_JIT)
def tabulate_poses(paths, starts, t, step, poses):  # type: ignore[no-untyped-def]
    """Set poses (steps + 1, grippers, POSE_NUMBERS): at time t first, then at the middle of each step.

    Grippers that hold nothing, ``starts[g] == starts[g + 1]``, are left out.
    """
    rotation = np.empty((3, 3))
    for entry in range(poses.shape[0]):
        time = t + (entry - 0.5) * step if entry > 0 else t
        for g in range(paths.shape[0]):
            if starts[g] == starts[g + 1]:
                continue
            pose = poses[entry, g]
            pose_at(paths[g], time, pose[0:3], pose[3:6], rotation, pose[15:18])
            for i in range(3):
                for j in range(3):
                    pose[6 + 3 * i + j] = rotation[i, j]


@numba.njit(**_JIT)
def held_point(pose, offset):  # type: ignore[no-untyped-def]
    """Return the arm from the gripper to the held point [m], the point's place [m] and its velocity [m/s]."""
    ax = pose[6] * offset[0] + pose[7] * offset[1] + pose[8] * offset[2]
    ay = pose[9] * offset[0] + pose[10] * offset[1] + pose[11] * offset[2]
    az = pose[12] * offset[0] + pose[13] * offset[1] + pose[14] * offset[2]
    ux = pose[3] + pose[16] * az - pose[17] * ay
    uy = pose[4] + pose[17] * ax - pose[15] * az
    uz = pose[5] + pose[15] * ay - pose[16] * ax
    return (ax, ay, az), (pose[0] + ax, pose[1] + ay, pose[2] + az), (ux, uy, uz)


@numba.njit(**_JIT)
def book(booked, arm, speed, pull, dt):  # type: ignore[no-untyped-def]
    """Add to a grip's booked numbers what the force `pull` [N] on its point does in dt [s]."""
    px, py, pz = dt * pull[0], dt * pull[1], dt * pull[2]
    booked[0] += px
    booked[1] += py
    booked[2] += pz
    booked[3] += arm[1] * pz - arm[2] * py
    booked[4] += arm[2] * px - arm[0] * pz
    booked[5] += arm[0] * py - arm[1] * px
    booked[6] -= speed[0] * px + speed[1] * py + speed[2] * pz
