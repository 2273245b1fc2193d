# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Joint states of the arm of config/robot_fold.yaml: it takes the towel's edge, and folds the towel.

Start the cloth first, as docs/tutorials/robot_fold.md says, then this. The option --slower 3 triples all times.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import rclpy
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation, Slerp
from sensor_msgs.msg import JointState

from cloth_sim_ros import Scene
from cloth_sim_ros.scene.parameters import parameter_file
from cloth_sim_ros.scene.robot.links import RobotLinks, scene_with_links, without_links

CONFIG = Path(__file__).resolve().parent.parent / "config"
#: Distance from the hand's origin to the middle of the pads [m].
REACH = 0.085
#: Time [s]; place of the middle of the pads x, z [m], y = 0; angle of the hand from upwards to the left [deg]; distance
#: of each finger from the middle [m].
WAYPOINTS = np.array(
    [
        (0.0, 0.115, -0.12, 0.0, 0.035),
        (1.0, 0.115, -0.12, 0.0, 0.035),
        (2.0, 0.115, -0.040, 0.0, 0.035),
        (3.0, 0.115, -0.040, 0.0, 0.0),
        (5.0, 0.16, 0.05, 90.0, 0.0),
        (7.5, 0.05, 0.14, 150.0, 0.0),
        (9.0, -0.06, 0.12, 180.0, 0.0),
        (10.5, -0.12, 0.045, 180.0, 0.0),
        (11.5, -0.12, 0.045, 180.0, 0.025),
        (13.0, -0.12, 0.16, 180.0, 0.025),
    ]
)


def arm(folder: Path = CONFIG) -> RobotLinks:
    """Return the arm of the scene."""
    values = parameter_file.read(folder / "robot_fold.yaml", strict=True)
    alone = Scene.from_parameters(without_links(values), folder=folder)
    return scene_with_links(alone, values, folder=folder)[1]


def joints_at(links: RobotLinks, position: np.ndarray, rotation: Rotation, start: np.ndarray) -> np.ndarray:
    """Return the seven joints [rad] that bring the pads to a position [m] and a rotation, next to a start."""

    def residuals(joints: np.ndarray) -> np.ndarray:
        pose = links.link_pose("hand", np.append(joints, 0.0))
        hand = Rotation.from_quat(pose[3:])
        error = pose[:3] + hand.apply([0.0, 0.0, REACH]) - position
        return np.concatenate([10.0 * error, 3.0 * (rotation.inv() * hand).as_rotvec(), 0.02 * (joints - start)])

    lower, upper = np.array([(-2.9, -1.8, -2.9, -3.1, -2.9, 0.0, -2.9), (2.9, 1.8, 2.9, -0.07, 2.9, 3.7, 2.9)])
    return least_squares(residuals, np.clip(start, lower + 1e-3, upper - 1e-3), bounds=(lower, upper)).x


def path(links: RobotLinks) -> CubicSpline:
    """Return the joints' positions over time: [rad], and [m] for the finger."""
    times = WAYPOINTS[:, 0]
    # The fingers open along x while the hand points up, and along z while it points to the left.
    turns = Slerp(times, Rotation.from_euler("zy", [(-90.0, -angle) for angle in WAYPOINTS[:, 3]], degrees=True))
    joints, knots, samples = (
        np.array([0.87, 1.72, -1.14, -1.66, -1.37, 1.16, 0.85]),
        np.arange(0.0, WAYPOINTS[-1, 0] + 0.1, 0.25),
        [],
    )
    for t in knots:
        index = min(np.searchsorted(times, t, side="right") - 1, len(times) - 2)
        part = (t - times[index]) / (times[index + 1] - times[index])
        part *= part * (3.0 - 2.0 * part)  # at rest at each waypoint
        x, z, _, opening = (WAYPOINTS[index] + part * (WAYPOINTS[index + 1] - WAYPOINTS[index]))[1:]
        turn = turns(times[index] + part * (times[index + 1] - times[index]))
        joints = joints_at(links, np.array([x, 0.0, z]), turn, joints)
        samples.append([*joints, opening])
    return CubicSpline(knots, samples)


def main() -> None:
    """Publish 200 joint states a second."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--slower", type=float, default=1.0, help="factor of all times")
    slower = parser.parse_args().slower
    links = arm()
    joints = path(links)
    rclpy.init()
    node = rclpy.create_node("my_arm")
    states = node.create_publisher(JointState, "/joint_states", 10)
    while not states.get_subscription_count():  # the cloth waits for the first state
        time.sleep(0.1)
    start = time.monotonic()
    while (t := (time.monotonic() - start) / slower) < WAYPOINTS[-1, 0]:
        message = JointState(name=list(links.joint_names), position=joints(t).tolist())
        message.header.stamp = node.get_clock().now().to_msg()
        states.publish(message)
        time.sleep(0.005)
    print("the arm has folded the towel", flush=True)
    rclpy.shutdown()


if __name__ == "__main__":
    main()
