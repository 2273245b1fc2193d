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
    assert action.wait_for_server(timeout_sec=30.0), "no action within 30 s; does cloth_sim run with gripper.action?"

    def go(y: float, z: float, end_y: float, end_z: float) -> None:
        """Publish targets on the way between two positions in the plane x = 0 [m] for a second."""
        for share in (k / 100 for k in range(1, 101)):
            message = PoseStamped()
            message.pose.orientation.w = 1.0
            message.pose.position.y, message.pose.position.z = y + share * (end_y - y), z + share * (end_z - z)
            poses.publish(message)
            time.sleep(0.01)

    def command(position: float) -> None:
        goal = GripperCommand.Goal()
        goal.command.position = position  # of the joint [m]
        sent = action.send_goal_async(goal)
        rclpy.spin_until_future_complete(node, sent, timeout_sec=10.0)
        assert sent.result() and sent.result().accepted, "rejected; the log of cloth_sim says why"
        done = sent.result().get_result_async()
        rclpy.spin_until_future_complete(node, done, timeout_sec=60.0)
        result = done.result().result
        print(f"stalled {result.stalled}, reached {result.reached_goal}, {result.effort:.1f} N", flush=True)

    go(-0.7, -0.3, -0.7, -0.3)  # targets are lost until the nodes have discovered each other
    go(-0.7, -0.3, -0.425, -0.3)
    go(-0.425, -0.3, -0.425, -0.08)
    command(0.0)
    lift = TwistStamped()  # in the cloth's frame, now
    lift.twist.linear.y, lift.twist.linear.z = -0.1, 0.25
    for _ in range(100):
        twists.publish(lift)
        time.sleep(0.01)
    command(0.04)


main()
