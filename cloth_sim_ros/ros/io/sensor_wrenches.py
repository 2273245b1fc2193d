# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Wrenches of grippers as a force-torque sensor at the flange reports them: in its own frame, about its origin."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node

from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.gripper_path import normalized, quaternion_product, rotation_matrix
from cloth_sim_ros.ros.io.messages import wrench_message
from cloth_sim_ros.ros.io.output import Output, RecordSink
from cloth_sim_ros.simulation.simulation import Simulation

#: Name of the topic below that of its gripper.
TOPIC = "ft_sensor_wrench"


class SensorWrenches:
    """Publisher of each gripper's wrench as a force-torque sensor would report it, on ~/<gripper>/ft_sensor_wrench.

    The topic is not recorded, because it follows from ~/<gripper>/wrench and the pose.

    Args:
        node: the node.
        simulation: the cloth.
        sink: records other outputs.
    """

    def __init__(self, node: Node, simulation: Simulation, sink: RecordSink) -> None:
        self._simulation, names = simulation, simulation.scene.gripper_names
        self._frames = [simulation.scene.gripper.sensor_frame.replace("{gripper}", name) for name in names]
        self._outputs = [Output(node, WrenchStamped, f"~/{name}/{TOPIC}", sink) for name in names]

    def send(self, wrenches: Array, stamp: int) -> None:
        """Publish a frame's wrenches (gripper_count, 6) as sensors report them, at a ROS time [ns], if subscribed."""
        if not any(output.has_subscribers for output in self._outputs):
            return
        gripper, poses = self._simulation.scene.gripper, self._simulation.grippers.poses()
        for output, frame_id, pose, wrench in zip(self._outputs, self._frames, poses, wrenches, strict=True):
            if output.has_subscribers:
                sensed = sensor_wrench(wrench, pose, gripper.sensor_position, gripper.sensor_orientation)
                output.publish(wrench_message(sensed, frame_id=frame_id, stamp=stamp))


def sensor_wrench(wrench: Array, pose: Array, position: tuple[float, ...], orientation: tuple[float, ...]) -> Array:
    """Transform a wrench from a gripper's origin and the cloth's axes to a sensor's origin and axes, shape (6,).

    Args:
        wrench: force [N] and torque [N m], shape (6,).
        pose: of the gripper: position [m] and quaternion x, y, z, w.
        position: of the sensor in the gripper's frame [m].
        orientation: of the sensor in the gripper's frame, a quaternion.
    """
    lever = rotation_matrix(pose[3:]) @ np.asarray(position, dtype=np.float64)
    axes = rotation_matrix(normalized(quaternion_product(pose[3:].tolist(), normalized(orientation).tolist())))
    force, torque = wrench[:3], wrench[3:] - np.cross(lever, wrench[:3])
    return np.concatenate([axes.T @ force, axes.T @ torque])
