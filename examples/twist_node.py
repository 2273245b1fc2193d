# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A ROS node that grasps the cloth's lower right corner and leads it by velocities, as a joystick would.

Start the cloth first (`cloth_sim --ros-args -p gripper.twist_max_speed:=0.5`), then this.
"""

import time

import rclpy
from geometry_msgs.msg import PointStamped, TwistStamped
from std_srvs.srv import SetBool

GRIPPER = "/cloth_sim/gripper"


def main() -> None:
    """Grasp, lift, swing sideways, release."""
    rclpy.init()
    node = rclpy.create_node("my_joystick")
    points = node.create_publisher(PointStamped, f"{GRIPPER}/point", 10)
    twists = node.create_publisher(TwistStamped, f"{GRIPPER}/twist", 10)
    close = node.create_client(SetBool, f"{GRIPPER}/close")
    if not close.wait_for_service(timeout_sec=30.0):
        raise SystemExit(f"no service {GRIPPER}/close within 30 s; does cloth_sim run?")

    def set_closed(closed: bool) -> None:
        future = close.call_async(SetBool.Request(data=closed))
        rclpy.spin_until_future_complete(node, future, timeout_sec=10.0)
        answer = future.result()
        print(answer.message if answer else "no answer within 10 s", flush=True)

    def lead(seconds: float, vx: float, vz: float) -> None:
        """Publish a velocity [m/s] 50 times a second: the gripper stops 0.1 s after the last one."""
        for _ in range(round(seconds * 50)):
            message = TwistStamped()  # an empty frame_id is the cloth's own, a zero stamp means now
            message.twist.linear.x, message.twist.linear.z = vx, vz
            twists.publish(message)
            time.sleep(0.02)

    for _ in range(100):  # a gripper is nowhere before its first target
        message = PointStamped()
        message.point.x, message.point.z = 0.5, 0.5
        points.publish(message)
        time.sleep(0.01)
    set_closed(True)
    lead(1.5, 0.0, 0.25)
    lead(1.0, -0.3, 0.0)
    set_closed(False)
    rclpy.shutdown()


if __name__ == "__main__":
    main()
