# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Joint states of the robot of a scene, for fold_towel.py and its neighbours."""

import argparse
import time
from pathlib import Path

import rclpy
from sensor_msgs.msg import JointState

from cloth_sim_ros import Scene
from cloth_sim_ros.scene.parameters import parameter_file
from cloth_sim_ros.scene.robot.links import scene_with_links, without_links

CONFIG = Path(__file__).resolve().parent.parent / "config"


def publish(scene, path, done):
    """Publish 200 joint states a second, and print a text at the end.

    Args:
        scene: parameter file in config/.
        path: function that returns the joints' positions over time, a spline, from the robot's links.
        done: the text.
    """
    parser = argparse.ArgumentParser(description=f"Joint states for config/{scene}; start the cloth first.")
    parser.add_argument("--slower", type=float, default=1.0, help="factor of all times")
    slower = parser.parse_args().slower
    values = parameter_file.read(CONFIG / scene, strict=True)
    alone = Scene.from_parameters(without_links(values), folder=CONFIG)
    _, links = scene_with_links(alone, values, folder=CONFIG)
    joints = path(links)
    rclpy.init()
    node = rclpy.create_node("my_arm")
    states = node.create_publisher(JointState, "/joint_states", 10)
    while not states.get_subscription_count():  # the cloth waits for the first state
        time.sleep(0.1)
    start = time.monotonic()
    while (t := (time.monotonic() - start) / slower) < joints.x[-1]:
        message = JointState(name=list(links.joint_names), position=joints(t).tolist())
        message.header.stamp = node.get_clock().now().to_msg()
        states.publish(message)
        time.sleep(0.005)
    print(done, flush=True)
    rclpy.shutdown()
