# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Publisher of TF frames of the grippers and the cloth."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence

from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy

from cloth_sim_ros.ros.io.messages import CDR, SECOND, pad_to_multiple
from cloth_sim_ros.ros.io.output import Output, RecordSink
from cloth_sim_ros.scene.cameras import optical_frames
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.simulation.simulation import Simulation

#: The profile of tf2's own broadcaster.
TF_QOS = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
#: Name of the cloth's frame, below the node's name like those of the grippers.
CLOTH_FRAME = "cloth"


class TfBroadcaster:
    """Publisher of the frames of grippers, cloth and cameras on /tf while `tf.publish` is set.

    The frames are `<node>/<gripper>`, `<node>/cloth` at the centre of mass, and `<node>/<camera>_optical_frame`.

    Args:
        node: the node.
        simulation: the cloth.
        sink: records the messages.
    """

    def __init__(self, node: Node, simulation: Simulation, sink: RecordSink) -> None:
        self._node, self._simulation, self._sink = node, simulation, sink
        self._prefix = node.get_fully_qualified_name().strip("/")
        self.output: Output | None = None
        self._was_enabled = False

    def send(self, stamp: int) -> None:
        """Publish the present frames with a ROS time [ns] as stamp, if `tf.publish` is set and /tf has consumers."""
        enabled = self._simulation.scene.tf.publish
        if enabled and not self._was_enabled:
            self._open()
        self._was_enabled = enabled
        if enabled and self.output is not None and self.output.has_consumers:
            parent = self._simulation.scene.frame_id
            self.output.send(transforms_bytes(self._transforms(), frame_id=parent, stamp=stamp), stamp)

    def _open(self) -> None:
        """Create the publisher of /tf, or log an error, once each time that `tf.publish` is set."""
        if self.output is not None:
            return
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError:
            self._node.get_logger().error(
                "tf.publish is set, and tf2_msgs is not installed: no frames are sent; "
                "sudo apt install ros-jazzy-tf2-msgs"
            )
            return
        try:
            self.output = Output(self._node, TFMessage, "/tf", self._sink, qos=TF_QOS, droppable=True)
        except ParameterError as error:
            self._node.get_logger().error(f"no frames are sent: {error}")

    def _transforms(self) -> list[tuple[str, Sequence[float]]]:
        simulation = self._simulation
        masses = simulation.model.masses
        centre = (simulation.state.x * masses).sum(axis=1) / simulation.model.mass
        frames: list[tuple[str, Sequence[float]]] = [
            (f"{self._prefix}/{CLOTH_FRAME}", [*centre.tolist(), 0.0, 0.0, 0.0, 1.0])
        ]
        poses = simulation.grippers.poses().tolist()
        for index, name in enumerate(simulation.grippers.names):
            # A gripper without a target has no pose.
            if simulation.grippers.is_placed(index):
                frames.append((f"{self._prefix}/{name}", poses[index]))
        return [*frames, *optical_frames(self._prefix, simulation.scene.views)]


def transforms_bytes(frames: Iterable[tuple[str, Sequence[float]]], *, frame_id: str, stamp: int) -> bytes:
    """Return the CDR bytes of a tf2_msgs/TFMessage from names and poses of frames in one parent frame.

    Args:
        frames: name of each frame with its pose in the parent: position [m] and quaternion x, y, z, w, 7 numbers.
        frame_id: the parent frame.
        stamp: ROS time [ns].
    """
    listed = list(frames)
    data = struct.pack("<I", len(listed))
    for name, pose in listed:
        data = pad_to_multiple(data, 4) + struct.pack("<iI", *divmod(stamp, SECOND))
        for text in (frame_id, name):
            encoded = text.encode() + b"\0"
            data = pad_to_multiple(data, 4) + struct.pack("<I", len(encoded)) + encoded
        data = pad_to_multiple(data, 8) + struct.pack("<7d", *pose)
    return CDR + data
