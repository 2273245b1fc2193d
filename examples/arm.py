# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Joint states of the arm of config/robot_arm.yaml: it takes the cloth's right edge between its fingers, and pulls it.

Start the cloth first, as docs/tutorials/robot.md says, then this.
"""

import math
import time

import numpy as np
import rclpy
from sensor_msgs.msg import JointState

NAMES = ["shoulder", "elbow", "wrist", "finger"]
#: Lengths from shoulder to elbow and from elbow to fingertips, and the shoulder's place (x, z) [m].
UPPER, FORE, SHOULDER = 0.3, 0.395, (0.7, 0.45)
#: Time [s], place of the fingertips (x, z) [m], distance of each finger from the middle [m].
WAYPOINTS = np.array(
    [
        (0.0, 0.43, 0.72, 0.03),
        (1.0, 0.43, 0.72, 0.03),
        (3.0, 0.225, 0.72, 0.03),
        (4.0, 0.225, 0.72, 0.0),
        (7.0, 0.28, 0.68, 0.0),
        (8.0, 0.28, 0.68, 0.0),
    ]
)


def joints(t: float) -> list[float]:
    """Return the positions of the joints at a time [s]: [rad], and [m] for the finger."""
    x, z, finger = (float(np.interp(t, WAYPOINTS[:, 0], WAYPOINTS[:, k])) for k in (1, 2, 3))
    dx, dz = x - SHOULDER[0], z - SHOULDER[1]
    bend = math.acos((dx * dx + dz * dz - UPPER**2 - FORE**2) / (2.0 * UPPER * FORE))
    shoulder = math.atan2(dx, dz) + math.atan2(FORE * math.sin(bend), UPPER + FORE * math.cos(bend))
    return [shoulder, -bend, 0.0, finger]


def main() -> None:
    """Publish 200 joint states a second."""
    rclpy.init()
    node = rclpy.create_node("my_arm")
    states = node.create_publisher(JointState, "/joint_states", 10)
    while not states.get_subscription_count():  # the cloth waits for the first state
        time.sleep(0.1)
    for k in range(200 * int(WAYPOINTS[-1, 0]) + 1):
        message = JointState(name=NAMES, position=joints(k / 200))
        message.header.stamp = node.get_clock().now().to_msg()
        states.publish(message)
        time.sleep(0.005)
    print("the arm has pulled", flush=True)
    rclpy.shutdown()


if __name__ == "__main__":
    main()
