# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The arm of config/robot_drape.yaml takes the towel's edge, and hangs the towel over a bar.

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
    (5.0, 0.20, 0.10, 60.0, 0.0),
    (7.0, 0.28, 0.30, 60.0, 0.0),
    (8.5, 0.35, 0.25, 45.0, 0.0),
    (9.5, 0.37, 0.13, 20.0, 0.0),
    (10.5, 0.345, 0.045, 10.0, 0.0),
    (11.5, 0.345, 0.045, 10.0, 0.012),
    (13.0, 0.365, -0.08, 10.0, 0.012),
])  # fmt: skip


def path(links):
    """Return the joints' positions over time: [rad], and [m] for the finger."""
    return arm_path(links, WAYPOINTS)


if __name__ == "__main__":
    publish("robot_drape.yaml", path, "the arm has hung the towel over the bar")
