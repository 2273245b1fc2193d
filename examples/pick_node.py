# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A ROS node that picks the towel of config/pinch_action.yaml by the gripper's action and lifts it by velocities.

Start the cloth first (`cloth_sim --ros-args --params-file config/pinch_action.yaml`), then this. It needs control_msgs.
"""

import time

import rclpy
from control_msgs.action import GripperCommand
from geometry_msgs.msg import PoseStamped, TwistStamped
from rclpy.action import ActionClient

GRIPPER = "/cloth_sim/gripper"


def main() -> None:
    """Approach, close, lift, open."""
    rclpy.init()
    node = rclpy.create_node("my_robot")
    poses = node.create_publisher(PoseStamped, f"{GRIPPER}/target", 10)
    twists = node.create_publisher(TwistStamped, f"{GRIPPER}/twist", 10)
    action = ActionClient(node, GripperCommand, f"{GRIPPER}/gripper_cmd")
    if not action.wait_for_server(timeout_sec=30.0):
        raise SystemExit(f"no action {GRIPPER}/gripper_cmd within 30 s; does cloth_sim run with gripper.action?")

    def go(seconds: float, start: tuple[float, float, float], end: tuple[float, float, float]) -> None:
        """Publish 100 targets a second on the way from one position [m] to another."""
        for k in range(count := round(seconds * 100)):
            message = PoseStamped()
            message.pose.orientation.w = 1.0
            p, share = message.pose.position, (k + 1) / count
            p.x, p.y, p.z = (a + share * (b - a) for a, b in zip(start, end, strict=True))
            poses.publish(message)
            time.sleep(0.01)

    def command(position: float) -> None:
        """Move the pads to a position of the joint [m], and print the result."""
        goal = GripperCommand.Goal()
        goal.command.position = position
        sent = action.send_goal_async(goal)
        rclpy.spin_until_future_complete(node, sent, timeout_sec=10.0)
        if not sent.result() or not sent.result().accepted:
            raise SystemExit("the goal is rejected; the log of cloth_sim says why")
        done = sent.result().get_result_async()
        rclpy.spin_until_future_complete(node, done, timeout_sec=60.0)
        result = done.result().result
        print(f"stalled {result.stalled}, reached {result.reached_goal}, {result.effort:.1f} N", flush=True)

    before, below, around = (0.0, -0.7, -0.3), (0.0, -0.425, -0.3), (0.0, -0.425, -0.08)
    go(1.0, before, before)  # targets are lost until the nodes have discovered each other
    go(1.0, before, below)
    go(1.0, below, around)
    command(0.0)
    for _ in range(100):
        message = TwistStamped()  # in the cloth's frame, now
        message.twist.linear.y, message.twist.linear.z = -0.1, 0.25
        twists.publish(message)
        time.sleep(0.01)
    command(0.04)
    rclpy.shutdown()


if __name__ == "__main__":
    main()
