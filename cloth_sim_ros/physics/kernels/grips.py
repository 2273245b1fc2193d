# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Kernels of grips: gripper pose on its path, and zero-length springs (S4) from held particles to points of the
gripper.

A path is a row of PATH_COLUMNS numbers: its start time t0; position coefficients p0, p1, p2, p3 of p0 + p1 s + p2 s^2 +
p3 s^3 with
s = t - t0; the orientation q0 (x, y, z, w) at s = 0; rotation vector coefficients r1, r2, r3. The orientation is exp(r1
s + r2 s^2 + r3 s^3) q0.
"""

from __future__ import annotations

import numba
import numpy as np

PATH_COLUMNS = 26
_JIT = {"cache": True, "nogil": True, "error_model": "numpy"}


@numba.njit(**_JIT)
def pose_at(path, t, position, velocity, rotation, spin):  # type: ignore[no-untyped-def]
    """Set position (3,), velocity (3,), rotation matrix (3, 3) and angular velocity (3,) of a path at time t."""
    s = t - path[0]
    r = np.empty(3)
    rate = np.empty(3)
    for i in range(3):
        position[i] = path[1 + i] + s * (path[4 + i] + s * (path[7 + i] + s * path[10 + i]))
        velocity[i] = path[4 + i] + s * (2.0 * path[7 + i] + s * 3.0 * path[10 + i])
        r[i] = s * (path[17 + i] + s * (path[20 + i] + s * path[23 + i]))
        rate[i] = path[17 + i] + s * (2.0 * path[20 + i] + s * 3.0 * path[23 + i])
    angle2 = r[0] * r[0] + r[1] * r[1] + r[2] * r[2]
    angle = np.sqrt(angle2)
    # sin(a)/a, (1 - cos a)/a^2, (a - sin a)/a^3, by series where they cancel.
    if angle > 1e-3:
        f1 = np.sin(angle) / angle
        f2 = (1.0 - np.cos(angle)) / angle2
        f3 = (angle - np.sin(angle)) / (angle2 * angle)
    else:
        f1 = 1.0 - angle2 / 6.0 * (1.0 - angle2 / 20.0)
        f2 = 0.5 - angle2 / 24.0 * (1.0 - angle2 / 30.0)
        f3 = 1.0 / 6.0 - angle2 / 120.0 * (1.0 - angle2 / 42.0)
    qx = path[13]
    qy = path[14]
    qz = path[15]
    qw = path[16]
    start = np.empty((3, 3))
    start[0, 0] = 1.0 - 2.0 * (qy * qy + qz * qz)
    start[0, 1] = 2.0 * (qx * qy - qz * qw)
    start[0, 2] = 2.0 * (qx * qz + qy * qw)
    start[1, 0] = 2.0 * (qx * qy + qz * qw)
    start[1, 1] = 1.0 - 2.0 * (qx * qx + qz * qz)
    start[1, 2] = 2.0 * (qy * qz - qx * qw)
    start[2, 0] = 2.0 * (qx * qz - qy * qw)
    start[2, 1] = 2.0 * (qy * qz + qx * qw)
    start[2, 2] = 1.0 - 2.0 * (qx * qx + qy * qy)
    cross = np.empty(3)
    for j in range(3):
        # Rodrigues: R c = c + f1 r x c + f2 r x (r x c), a column at a time.
        c0 = start[0, j]
        c1 = start[1, j]
        c2 = start[2, j]
        cross[0] = r[1] * c2 - r[2] * c1
        cross[1] = r[2] * c0 - r[0] * c2
        cross[2] = r[0] * c1 - r[1] * c0
        rotation[0, j] = c0 + f1 * cross[0] + f2 * (r[1] * cross[2] - r[2] * cross[1])
        rotation[1, j] = c1 + f1 * cross[1] + f2 * (r[2] * cross[0] - r[0] * cross[2])
        rotation[2, j] = c2 + f1 * cross[2] + f2 * (r[0] * cross[1] - r[1] * cross[0])
    # Angular velocity: left Jacobian of the rotation group times dr/dt.
    cross[0] = r[1] * rate[2] - r[2] * rate[1]
    cross[1] = r[2] * rate[0] - r[0] * rate[2]
    cross[2] = r[0] * rate[1] - r[1] * rate[0]
    spin[0] = rate[0] + f2 * cross[0] + f3 * (r[1] * cross[2] - r[2] * cross[1])
    spin[1] = rate[1] + f2 * cross[1] + f3 * (r[2] * cross[0] - r[0] * cross[2])
    spin[2] = rate[2] + f2 * cross[2] + f3 * (r[0] * cross[1] - r[1] * cross[0])


@numba.njit(**_JIT)
def grip_forces(paths, starts, particles, offsets, stiffness, damping, t, x, v, f, wrenches):  # type: ignore[no-untyped-def]
    """Add grip forces to f (3, n) and set wrenches (g, 7): force and torque on each gripper about its pose, and power
    put in.

    Grips of gripper g are ``particles[starts[g]:starts[g + 1]]`` with ``offsets`` (m, 3) in the gripper's frame.
    """
    position = np.empty(3)
    velocity = np.empty(3)
    rotation = np.empty((3, 3))
    spin = np.empty(3)
    arm = np.empty(3)
    pull = np.empty(3)
    for g in range(paths.shape[0]):
        for i in range(7):
            wrenches[g, i] = 0.0
        if starts[g] == starts[g + 1]:
            continue
        pose_at(paths[g], t, position, velocity, rotation, spin)
        for e in range(starts[g], starts[g + 1]):
            p = particles[e]
            for i in range(3):
                arm[i] = (
                    rotation[i, 0] * offsets[e, 0] + rotation[i, 1] * offsets[e, 1] + rotation[i, 2] * offsets[e, 2]
                )
            for i in range(3):
                j = (i + 1) % 3
                k = (i + 2) % 3
                gv = velocity[i] + spin[j] * arm[k] - spin[k] * arm[j]
                pull[i] = stiffness[e] * (x[i, p] - position[i] - arm[i]) + damping[e] * (v[i, p] - gv)
                f[i, p] -= pull[i]
                wrenches[g, i] += pull[i]
                wrenches[g, 6] -= pull[i] * gv
            for i in range(3):
                j = (i + 1) % 3
                k = (i + 2) % 3
                wrenches[g, 3 + i] += arm[j] * pull[k] - arm[k] * pull[j]


@numba.njit(**_JIT)
def grip_energy(paths, starts, particles, offsets, stiffness, damping, t, x, v):  # type: ignore[no-untyped-def]
    """Return the elastic energy of the grips [J] and the power that their damping dissipates [W]."""
    position = np.empty(3)
    velocity = np.empty(3)
    rotation = np.empty((3, 3))
    spin = np.empty(3)
    arm = np.empty(3)
    energy = 0.0
    lost = 0.0
    for g in range(paths.shape[0]):
        if starts[g] == starts[g + 1]:
            continue
        pose_at(paths[g], t, position, velocity, rotation, spin)
        for e in range(starts[g], starts[g + 1]):
            p = particles[e]
            for i in range(3):
                arm[i] = (
                    rotation[i, 0] * offsets[e, 0] + rotation[i, 1] * offsets[e, 1] + rotation[i, 2] * offsets[e, 2]
                )
            for i in range(3):
                j = (i + 1) % 3
                k = (i + 2) % 3
                away = x[i, p] - position[i] - arm[i]
                slip = v[i, p] - velocity[i] - spin[j] * arm[k] + spin[k] * arm[j]
                energy += 0.5 * stiffness[e] * away * away
                lost += damping[e] * slip * slip
    return energy, lost
