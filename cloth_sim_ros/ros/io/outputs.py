# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Published topics of the node.

Messages are built only for subscribers or a recording, and serialized once for both.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
from shape_msgs.msg import Mesh
from visualization_msgs.msg import Marker

from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.sheets.normals import vertex_normals
from cloth_sim_ros.ros.io.commands import CommandSubscriptions
from cloth_sim_ros.ros.io.messages import CloudMessage, SurfaceMarker, mesh_bytes, wrench_message
from cloth_sim_ros.ros.io.obstacles import ObstacleTopics
from cloth_sim_ros.ros.io.output import LATCHED_QOS, NEWEST_QOS, Output, RecordSink
from cloth_sim_ros.ros.io.states import States
from cloth_sim_ros.ros.io.tf_broadcaster import TfBroadcaster
from cloth_sim_ros.ros.reporting.log import ThrottledLog
from cloth_sim_ros.ros.timing.cloth_clock import ClothClock
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.scene.sections import PointsParameters
from cloth_sim_ros.simulation.simulation import Frame, Simulation

if TYPE_CHECKING:
    from cloth_sim_ros.ros.camera.cameras import Cameras
    from cloth_sim_ros.ros.ensemble.ensemble_topic import EnsembleTopic
    from cloth_sim_ros.ros.io.ground_truth import CoverageTopic, KeypointTopic
    from cloth_sim_ros.ros.io.sensor_wrenches import SensorWrenches

#: Publication period of a paused cloth [s]: late subscribers receive it, and recordings stay small.
_PAUSED_PERIOD = 1.0


class ClothTopics:
    """Publisher of ~/points, ~/topology, ~/mesh and ~/<gripper>/wrench of one cloth."""

    def __init__(self, node: Node, scene: Scene, sink: RecordSink) -> None:
        self._shape = scene.shape
        sheet = scene.sheet
        triangles = sheet.triangles()
        self._frame_id = scene.frame_id
        self._triangles = triangles
        # By fields; built on first use.
        self._clouds: dict[PointsParameters, CloudMessage] = {}
        self.marker = SurfaceMarker(frame_id=scene.frame_id, name=node.get_fully_qualified_name(), triangles=triangles)
        self.points = Output(node, PointCloud2, "~/points", sink, qos=NEWEST_QOS, droppable=True)
        self.mesh = Output(node, Marker, "~/mesh", sink, qos=NEWEST_QOS, droppable=True)
        self._topology = Output(node, Mesh, "~/topology", sink, qos=LATCHED_QOS)
        self.wrenches = [
            Output(node, WrenchStamped, f"~/{name}/wrench", sink, droppable=True) for name in scene.gripper_names
        ]
        self._topology_bytes = mesh_bytes(triangles, sheet.positions())
        self.published = 0

    def start(self, stamp: int) -> None:
        """Publish the topology (triangles and rest positions) once, at a ROS time [ns]."""
        self._topology.send(self._topology_bytes, stamp)

    def record_topology(self, stamp: int) -> None:
        """Record the topology at the start of a recording, at a ROS time [ns]."""
        self._topology.record(self._topology_bytes, stamp)

    def send(self, x: Array, wrenches: Array, stamp: int, *, velocities: Array, fields: PointsParameters) -> None:
        """Publish and record cloud and wrenches of one frame; publish its mesh marker.

        Args:
            x: positions [m], shape (3, n).
            wrenches: force [N] and torque [N m] on each gripper, shape (gripper_count, 6).
            stamp: ROS time at which the frame was due [ns].
            velocities: velocities [m/s], shape (3, n).
            fields: fields of the cloud.
        """
        if self.points.has_consumers:
            normals = vertex_normals(x, self._triangles) if fields.normal else None
            cloud = self._cloud(fields).serialize(x, stamp, velocities if fields.velocity else None, normals)
            self.points.send(cloud, stamp)
            self.published += 1
        # Not recorded, because it is large and follows from points and topology.
        if self.mesh.has_subscribers:
            self.mesh.publish(self.marker.serialize(x, stamp))
        for output, wrench in zip(self.wrenches, wrenches, strict=True):
            if output.has_consumers:
                output.send(wrench_message(wrench, frame_id=self._frame_id, stamp=stamp), stamp)

    def _cloud(self, fields: PointsParameters) -> CloudMessage:
        if fields not in self._clouds:
            height, width = self._shape
            self._clouds[fields] = CloudMessage(frame_id=self._frame_id, height=height, width=width, **fields.fields)
        return self._clouds[fields]

    def flush(self) -> None:
        """Wait at most 0.2 s until subscribers have received the last points."""
        self.points.flush()


class Outputs:
    """Owner of all published topics of the node; publishes and records each frame on them.

    Args:
        node: the node.
        simulation: the cloth.
        commands: subscribes to the targets of obstacles.
        sink: records the messages.
        log: receives warnings of obstacles.
    """

    def __init__(
        self, node: Node, simulation: Simulation, commands: CommandSubscriptions, sink: RecordSink, log: ThrottledLog
    ) -> None:
        self._simulation = simulation
        self.cloth = ClothTopics(node, simulation.scene, sink)
        self.clock = ClothClock(node, sink)
        self.states = States(node, simulation, sink)
        self.transforms = TfBroadcaster(node, simulation, sink)
        self.obstacles = ObstacleTopics(node, simulation, commands, sink, log)
        #: Topics of ground truth, if the scene asks for any.
        self.ground_truth: list[KeypointTopic | CoverageTopic] = []
        if any(simulation.scene.keypoints) or simulation.scene.coverage.obstacle:
            from cloth_sim_ros.ros.io.ground_truth import ground_truth_topics

            self.ground_truth = ground_truth_topics(node, simulation, sink)
        self._sensors: SensorWrenches | None = None
        if simulation.scene.gripper_names and simulation.scene.gripper.sensor_frame:
            from cloth_sim_ros.ros.io.sensor_wrenches import SensorWrenches

            self._sensors = SensorWrenches(node, simulation, sink)
        #: None without cameras.
        self.cameras: Cameras | None = None
        if simulation.scene.camera_names:
            from cloth_sim_ros.ros.camera.cameras import Cameras

            self.cameras = Cameras(node, simulation, log)
        #: None without a distribution of uncertain parameters.
        self.ensemble: EnsembleTopic | None = None
        if simulation.scene.ensemble.file:
            from cloth_sim_ros.ros.ensemble.ensemble_topic import EnsembleTopic

            self.ensemble = EnsembleTopic(node, simulation, sink, log)
        #: Steady time of the last frame that was due [s]; None before the first.
        self._last_published: float | None = None

    def start(self, stamp: int) -> None:
        """Publish topology and obstacles at a ROS time [ns], subscribe to obstacles' targets, start child processes."""
        self.cloth.start(stamp)
        self.obstacles.update_topics(stamp)
        if self.cameras is not None:
            self.cameras.start()
        if self.ensemble is not None:
            self.ensemble.start()

    def before_frame(self) -> None:
        """Let the ensemble, if there is one, copy the cloth's state before a frame."""
        if self.ensemble is not None:
            self.ensemble.before_frame()

    def record_extras(self, frame: Frame) -> dict[str, Any]:
        """Return the ensemble's entries of a frame's record; empty unless the ensemble starts with this frame."""
        return {} if self.ensemble is None else self.ensemble.record_extras(frame)

    def must_publish(self, frame: Frame, now: float) -> bool:
        """Return true if a frame moved, had events, or came 1 s after the last published; store its steady time [s]."""
        is_recent = self._last_published is not None and now - self._last_published < _PAUSED_PERIOD
        if not frame.moved and not frame.events and is_recent:
            return False
        self._last_published = now
        return True

    def send(self, frame: Frame, stamp: int) -> None:
        """Publish and record a frame that was due at a ROS time [ns] on all topics."""
        state = self._simulation.state
        fields = self._simulation.scene.points
        self.cloth.send(state.x, frame.wrenches, stamp, velocities=state.v, fields=fields)
        if self._sensors is not None:
            self._sensors.send(frame.wrenches, stamp)
        self.states.send(frame, stamp)
        self.clock.send(frame.time)
        self.obstacles.send(frame, stamp)
        self.transforms.send(stamp)
        for topic in self.ground_truth:
            topic.send(stamp)
        if self.cameras is not None:
            self.cameras.send(frame, stamp)
        if self.ensemble is not None:
            self.ensemble.add(frame, stamp)

    def send_late(self, stamp: int) -> None:
        """Publish and record the ensemble's clouds of earlier frames that are finished at a ROS time [ns]."""
        if self.ensemble is not None:
            self.ensemble.send(stamp)

    def report_processes(self) -> None:
        """Log the messages of the camera and ensemble processes since the last call. Call it periodically."""
        for part in (self.cameras, self.ensemble):
            if part is not None:
                part.report()

    def close_processes(self) -> None:
        """End the processes of cameras and ensemble; wait at most 2 s for each."""
        for part in (self.cameras, self.ensemble):
            if part is not None:
                part.close()

    def record_latched(self, stamp: int) -> None:
        """Record the latched messages at the start of a recording, at a ROS time [ns]."""
        self.cloth.record_topology(stamp)
        self.obstacles.record(stamp)
        self.states.record(stamp)
