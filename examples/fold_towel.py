# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The arm of config/robot_fold.yaml takes the towel's edge, and folds the towel.

Start the cloth first, as docs/tutorials/robot_fold.md says, then this. The option --slower 3 triples all times.
"""

import numpy as np
from arm_path import arm_path
from arm_states import publish

#: Time [s]; middle of the pads x, z [m], y = 0; angle of the hand from upwards to the left [deg]; opening [m].
WAYPOINTS = np.array([
    (0.0, 0.115, -0.12, 0.0, 0.035),
    (1.0, 0.115, -0.12, 0.0, 0.035),
    (2.0, 0.115, -0.040, 0.0, 0.035),
    (3.0, 0.115, -0.040, 0.0, 0.0),
    (5.0, 0.16, 0.05, 90.0, 0.0),
    (7.5, 0.05, 0.14, 150.0, 0.0),
    (9.0, -0.06, 0.12, 180.0, 0.0),
    (10.5, -0.12, 0.056, 180.0, 0.0),
    (11.5, -0.12, 0.056, 180.0, 0.025),
    (13.0, -0.12, 0.16, 180.0, 0.025),
])  # fmt: skip


def path(links):
    """Return the joints' positions over time: [rad], and [m] for the finger."""
    return arm_path(links, WAYPOINTS)


if __name__ == "__main__":
    publish("robot_fold.yaml", path, "the arm has folded the towel")
