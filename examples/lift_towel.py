# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The two arms of config/robot_lift.yaml take two corners of the towel, and lift the towel off the table.

Start the cloth first, as docs/tutorials/robot_fold.md says, then this. The option --slower 3 triples all times.
"""

import numpy as np
from arm_path import arm_path
from arm_states import publish
from scipy.interpolate import CubicSpline

#: Time [s]; middle of the pads x, z [m], y = ±0.12; angle of the hands from upwards to the left [deg]; opening [m].
WAYPOINTS = np.array([
    (0.0, 0.115, -0.12, 0.0, 0.035),
    (1.0, 0.115, -0.12, 0.0, 0.035),
    (2.0, 0.115, -0.040, 0.0, 0.035),
    (3.0, 0.115, -0.040, 0.0, 0.0),
    (5.0, 0.16, 0.05, 90.0, 0.0),
    (7.0, 0.10, 0.20, 150.0, 0.0),
    (8.5, 0.10, 0.35, 180.0, 0.0),
    (9.5, 0.10, 0.35, 180.0, 0.0),
])  # fmt: skip
#: The right arm is the mirror image of the left one: the joints that turn the other way.
MIRROR = np.array([-1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0])


def path(links):
    """Return the positions of the joints of both arms over time: [rad], and [m] for the fingers."""
    left = arm_path(links, WAYPOINTS, arm="left_", y=0.12)
    joints = [*(f"joint_{k}" for k in range(1, 8)), "finger"]
    order = [links.joint_names.index(f"{arm}_{joint}") for arm in ("left", "right") for joint in joints]
    samples = np.empty((len(left.x), len(order)))
    samples[:, order] = np.hstack([left(left.x), MIRROR * left(left.x)])
    return CubicSpline(left.x, samples)


if __name__ == "__main__":
    publish("robot_lift.yaml", path, "the arms have lifted the towel")
