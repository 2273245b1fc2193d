# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Topics ~/keypoints and ~/coverage: ground truth for perception, computed for subscribers only.

They are not recorded, because they follow from positions and parameters.
"""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import Point, Pose, PoseArray, Quaternion
from rclpy.node import Node
from rclpy.serialization import serialize_message
from std_msgs.msg import Float64

from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.gripper_path import normalized
from cloth_sim_ros.ros.io.messages import set_stamp
from cloth_sim_ros.ros.io.output import NEWEST_QOS, Output, RecordSink
from cloth_sim_ros.scene.coverage import Coverage
from cloth_sim_ros.scene.keypoints import KeypointPoses
from cloth_sim_ros.simulation.simulation import Simulation


class KeypointTopic:
    """Publisher of the cloth's keypoint poses on ~/keypoints, in the order of the parameter `keypoints`.

    Args:
        node: the node.
        simulation: the cloth; its scene has keypoints.
        sink: records other outputs.
    """

    def __init__(self, node: Node, simulation: Simulation, sink: RecordSink) -> None:
        self._simulation, self.poses = simulation, KeypointPoses(simulation.scene)
        self.output = Output(node, PoseArray, "~/keypoints", sink, qos=NEWEST_QOS)

    def send(self, stamp: int) -> None:
        """Publish the poses of the keypoints at a ROS time [ns], if the topic has subscribers."""
        if not self.output.has_subscribers:
            return
        message = PoseArray()
        message.header.frame_id = self._simulation.scene.frame_id
        set_stamp(message.header.stamp, stamp)
        message.poses = [
            Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))
            for x, y, z, qx, qy, qz, qw in self.poses.compute(self._simulation.state.x).tolist()
        ]
        self.output.publish(bytes(serialize_message(message)))


class CoverageTopic:
    """Publisher on ~/coverage of the area of a plane that the cloth covers [m^2].

    Args:
        node: the node.
        simulation: the cloth; its scene has a `coverage.obstacle`.
        sink: records other outputs.
    """

    def __init__(self, node: Node, simulation: Simulation, sink: RecordSink) -> None:
        self._simulation, self.coverage = simulation, Coverage(simulation.scene)
        self._description = simulation.scene.described[self.coverage.obstacle]
        self.output = Output(node, Float64, "~/coverage", sink, qos=NEWEST_QOS)

    def send(self, _stamp: int) -> None:
        """Publish the covered area [m^2], a Float64 without stamp, if the topic has subscribers."""
        if self.output.has_subscribers:
            scene = self._simulation.scene
            # The size of an obstacle may change while obstacles does not name it.
            if scene.described[self.coverage.obstacle] != self._description:
                self.coverage = Coverage(scene)
                self._description = scene.described[self.coverage.obstacle]
            area = self.coverage.area(self._simulation.state.x, self._pose())
            self.output.publish(bytes(serialize_message(Float64(data=area))))

    def _pose(self) -> Array:
        """Return the pose (7,) of the obstacle with the plane: present, or as described if it is not in the scene."""
        name, obstacles = self.coverage.obstacle, self._simulation.obstacles
        if obstacles is not None and name in obstacles.names:
            pose: Array = obstacles.poses()[obstacles.names.index(name)]
            return pose
        description = self._simulation.scene.described[name]
        return np.array([*description.position, *normalized(description.orientation)])


def ground_truth_topics(node: Node, simulation: Simulation, sink: RecordSink) -> list[KeypointTopic | CoverageTopic]:
    """Create the publishers of ~/keypoints and ~/coverage that the scene asks for; return them, perhaps none."""
    topics: list[KeypointTopic | CoverageTopic] = []
    if any(simulation.scene.keypoints):
        topics.append(KeypointTopic(node, simulation, sink))
    if simulation.scene.coverage.obstacle:
        topics.append(CoverageTopic(node, simulation, sink))
    return topics
