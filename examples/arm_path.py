# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Path of an arm's joints by inverse kinematics of waypoints of its hand, for fold_towel.py and its neighbours."""

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation, Slerp

#: Distance from the hand's origin to the middle of the pads [m], limits of the joints [rad], and a first guess.
REACH = 0.085
LIMITS = np.array([(-2.9, -1.8, -2.9, -3.1, -2.9, 0.0, -2.9), (2.9, 1.8, 2.9, -0.07, 2.9, 3.7, 2.9)])
GUESS = np.array([0.87, 1.72, -1.14, -1.66, -1.37, 1.16, 0.85])


def joints_at(links, arm, position, rotation, start):
    """Return joints [rad] of an arm that bring its pads to a position [m] and a rotation, next to a start."""
    positions = np.zeros(len(links.joint_names))
    indices = [links.joint_names.index(f"{arm}joint_{k}") for k in range(1, 8)]

    def residuals(joints):
        positions[indices] = joints
        pose = links.link_pose(f"{arm}hand", positions)
        hand = Rotation.from_quat(pose[3:])
        error = pose[:3] + hand.apply([0.0, 0.0, REACH]) - position
        return np.concatenate([10.0 * error, 3.0 * (rotation.inv() * hand).as_rotvec(), 0.02 * (joints - start)])

    return least_squares(residuals, np.clip(start, LIMITS[0] + 1e-3, LIMITS[1] - 1e-3), bounds=LIMITS).x


def arm_path(links, waypoints, *, arm="", y=0.0):
    """Return the positions of an arm's seven joints [rad] and of its finger [m] over time, a spline.

    Args:
        links: the robot's links.
        waypoints: rows of time [s], x and z of the middle of the pads [m], angle of the hand from upwards to the left
            [deg], and opening of the finger [m]. The hand stops at each.
        arm: prefix of the arm's names.
        y: that of the pads [m].
    """
    times, joints, samples = waypoints[:, 0], GUESS, []
    # The fingers open along x while the hand points up, and along z while it points to the left.
    turns = Slerp(times, Rotation.from_euler("zy", [(-90.0, -angle) for angle in waypoints[:, 3]], degrees=True))
    knots = np.arange(0.0, times[-1] + 0.1, 0.25)
    for t in knots:
        k = min(np.searchsorted(times, t, side="right") - 1, len(times) - 2)
        fraction = (t - times[k]) / (times[k + 1] - times[k])
        fraction *= fraction * (3.0 - 2.0 * fraction)
        t, x, z, _, opening = waypoints[k] + fraction * (waypoints[k + 1] - waypoints[k])
        joints = joints_at(links, arm, np.array([x, y, z]), turns(t), joints)
        samples.append([*joints, opening])
    return CubicSpline(knots, samples)
