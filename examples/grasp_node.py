# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A ROS node that grasps the cloth's lower right corner, lifts it by 0.4 m, and releases it.

Start the cloth first (`cloth_sim`), then this.
"""

import time

import rclpy
from geometry_msgs.msg import PointStamped
from std_srvs.srv import SetBool

GRIPPER = "/cloth_sim/gripper"


def main() -> None:
    """Grasp, lift, release."""
    rclpy.init()
    node = rclpy.create_node("my_robot")
    points = node.create_publisher(PointStamped, f"{GRIPPER}/point", 10)
    close = node.create_client(SetBool, f"{GRIPPER}/close")
    if not close.wait_for_service(timeout_sec=30.0):
        raise SystemExit(f"no service {GRIPPER}/close within 30 s; does cloth_sim run?")

    def move(seconds: float, low: float, high: float) -> None:
        """Publish 100 targets a second, from the lower to the upper height [m] above the corner's position."""
        for k in range(count := round(seconds * 100)):
            message = PointStamped()  # an empty frame_id is the cloth's own, a zero stamp means now
            message.point.x, message.point.z = 0.5, low + (high - low) * (k + 1) / count
            points.publish(message)
            time.sleep(0.01)

    def set_closed(closed: bool) -> None:
        future = close.call_async(SetBool.Request(data=closed))
        rclpy.spin_until_future_complete(node, future, timeout_sec=10.0)
        answer = future.result()
        print(answer.message if answer else "no answer within 10 s", flush=True)

    move(1.0, 0.5, 0.5)  # to the corner; targets are lost until the nodes have discovered each other
    set_closed(True)
    move(2.0, 0.5, 0.9)
    set_closed(False)
    rclpy.shutdown()


if __name__ == "__main__":
    main()
