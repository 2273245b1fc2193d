# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Path of the joints for fold_towel.py, by inverse kinematics of places of the hand."""

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation, Slerp

#: Distance from the hand's origin to the middle of the pads [m], limits of the joints [rad], and a first guess.
REACH = 0.085
LIMITS = np.array([(-2.9, -1.8, -2.9, -3.1, -2.9, 0.0, -2.9), (2.9, 1.8, 2.9, -0.07, 2.9, 3.7, 2.9)])
GUESS = np.array([0.87, 1.72, -1.14, -1.66, -1.37, 1.16, 0.85])
#: Time [s]; middle of the pads x, z [m], y = 0; angle of the hand from upwards to the left [deg]; opening [m].
WAYPOINTS = np.array([
    (0.0, 0.115, -0.12, 0.0, 0.035),
    (1.0, 0.115, -0.12, 0.0, 0.035),
    (2.0, 0.115, -0.040, 0.0, 0.035),
    (3.0, 0.115, -0.040, 0.0, 0.0),
    (5.0, 0.16, 0.05, 90.0, 0.0),
    (7.5, 0.05, 0.14, 150.0, 0.0),
    (9.0, -0.06, 0.12, 180.0, 0.0),
    (10.5, -0.12, 0.045, 180.0, 0.0),
    (11.5, -0.12, 0.045, 180.0, 0.025),
    (13.0, -0.12, 0.16, 180.0, 0.025),
])  # fmt: skip


def joints_at(links, position, rotation, start):
    """Return joints [rad] that bring the pads to a position [m] and a rotation, next to a start."""

    def residuals(joints):
        pose = links.link_pose("hand", np.append(joints, 0.0))
        hand = Rotation.from_quat(pose[3:])
        error = pose[:3] + hand.apply([0.0, 0.0, REACH]) - position
        return np.concatenate([10.0 * error, 3.0 * (rotation.inv() * hand).as_rotvec(), 0.02 * (joints - start)])

    return least_squares(residuals, np.clip(start, LIMITS[0] + 1e-3, LIMITS[1] - 1e-3), bounds=LIMITS).x


def path(links):
    """Return the joints' positions over time: [rad], and [m] for the finger."""
    times, joints, samples = WAYPOINTS[:, 0], GUESS, []
    # The fingers open along x while the hand points up, and along z while it points to the left.
    turns = Slerp(times, Rotation.from_euler("zy", [(-90.0, -angle) for angle in WAYPOINTS[:, 3]], degrees=True))
    knots = np.arange(0.0, times[-1] + 0.1, 0.25)
    for t in knots:
        k = min(np.searchsorted(times, t, side="right") - 1, len(times) - 2)
        fraction = (t - times[k]) / (times[k + 1] - times[k])
        fraction *= fraction * (3.0 - 2.0 * fraction)  # at rest at each waypoint
        t, x, z, _, opening = WAYPOINTS[k] + fraction * (WAYPOINTS[k + 1] - WAYPOINTS[k])
        joints = joints_at(links, np.array([x, 0.0, z]), turns(t), joints)
        samples.append([*joints, opening])
    return CubicSpline(knots, samples)
