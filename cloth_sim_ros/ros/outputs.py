# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the node publishes: built only where someone listens or records, serialized once, the same bytes for both."""

from __future__ import annotations

import time
from typing import Any, Protocol

from geometry_msgs.msg import WrenchStamped
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2
from shape_msgs.msg import Mesh
from visualization_msgs.msg import Marker

from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.ros.log import ThrottledLog
from cloth_sim_ros.ros.messages import CloudMessage, SurfaceMarker, mesh_bytes, wrench_message
from cloth_sim_ros.ros.qos_overrides import OPTIONS, overridden_profile
from cloth_sim_ros.scene.parameters import ParameterError
from cloth_sim_ros.scene.scene import Scene

#: Reliable, because RViz's displays ask for it; a subscriber that wants the newest alone takes best effort for itself.
STREAM = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
#: For what is large: of clouds that a slow subscriber has not fetched, the newest alone is kept for it.
NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)
#: For what is said once: those who come later hear it too.
LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
#: How long the node waits at its end for subscribers to receive the last messages.
_FLUSH = Duration(seconds=0.2)
#: A publication that takes longer is worth a warning, at most once in so long [s].
_LONG_PUBLICATION, _BETWEEN_WARNINGS = 0.5, 60.0


class Tape(Protocol):
    """What records."""

    @property
    def running(self) -> bool:
        """Whether messages are recorded."""

    def add(self, topic: str, kind: Any, data: bytes, *, stamp: int, qos: QoSProfile, droppable: bool) -> None:
        """Record a message's bytes at a ROS time [ns]; droppable ones give way where the disk can't follow."""


class Output:
    """One topic.

    Raises:
        ParameterError: for overrides of its quality of service that make no profile.
    """

    def __init__(
        self, node: Node, kind: Any, topic: str, tape: Tape, *, qos: QoSProfile = STREAM, droppable: bool = False
    ) -> None:
        self._kind, self._node = kind, node
        self._tape = tape
        self._droppable = droppable
        self._log = ThrottledLog(node.get_logger(), seconds=_BETWEEN_WARNINGS)
        profile = overridden_profile(node, topic, qos)
        try:
            self._publisher = node.create_publisher(
                kind,
                topic,
                profile,
                qos_overriding_options=OPTIONS,
                # A subscriber that asks for what is not offered is told so by its own side; each event that this side
                # waits for costs the executor time in every turn.
                event_callbacks=PublisherEventCallbacks(use_default_callbacks=False),
            )
        except RuntimeError as error:
            name = node.resolve_topic_name(topic)
            raise ParameterError(
                f"qos_overrides.{name}.publisher: {error}; the middleware takes no such profile"
            ) from error
        #: Under the node's own name, whatever the topic is remapped to: a session looks the same everywhere.
        self.topic = node.resolve_topic_name(topic, only_expand=True)

    @property
    def heard(self) -> bool:
        """Whether someone listens."""
        return bool(self._publisher.get_subscription_count())

    @property
    def wanted(self) -> bool:
        """Whether someone listens or records."""
        return self._tape.running or self.heard

    def publish(self, data: bytes) -> None:
        """Publish bytes; a warning tells if the middleware kept the node waiting."""
        begun = time.monotonic()
        self._publisher.publish(data)
        if (elapsed := time.monotonic() - begun) > _LONG_PUBLICATION:
            self._log.warn(
                "slow",
                f"{self.topic}: publishing took {elapsed:.2g} s, and the frame waited for the middleware: a subscriber "
                f"starts, is suspended, or was killed; if this comes again, resume or end it",
            )

    def send(self, data: bytes, stamp: int) -> None:
        """Publish bytes, and record the same."""
        self.publish(data)
        self.record(data, stamp)

    def flush(self) -> None:
        """Wait until reliable subscribers have what was published, but not for those that have died."""
        self._publisher.wait_for_all_acked(_FLUSH)

    def close(self) -> None:
        """Let the topic be no more."""
        self._node.destroy_publisher(self._publisher)

    def record(self, data: bytes, stamp: int) -> None:
        """Record bytes, where a recording runs."""
        if self._tape.running:
            self._tape.add(
                self.topic, self._kind, data, stamp=stamp, qos=self._publisher.qos_profile, droppable=self._droppable
            )


class Outputs:
    """Points, topology, mesh and wrenches of one cloth."""

    def __init__(self, node: Node, scene: Scene, tape: Tape) -> None:
        self._shape = scene.shape
        sheet = scene.sheet
        triangles = sheet.triangles()
        self._frame_id = scene.frame_id
        # With velocities or without, in double precision or not, made when first asked for.
        self._clouds: dict[tuple[bool, bool], CloudMessage] = {}
        self._marker = SurfaceMarker(frame_id=scene.frame_id, name=node.get_fully_qualified_name(), triangles=triangles)
        self._points = Output(node, PointCloud2, "~/points", tape, qos=NEWEST, droppable=True)
        self._mesh = Output(node, Marker, "~/mesh", tape, qos=NEWEST, droppable=True)
        self._topology = Output(node, Mesh, "~/topology", tape, qos=LATCHED)
        self._wrenches = [
            Output(node, WrenchStamped, f"~/{name}/wrench", tape, droppable=True) for name in scene.gripper_names
        ]
        self._topology_bytes = mesh_bytes(triangles, sheet.positions())
        self.published = 0

    def start(self, stamp: int) -> None:
        """Publish what is said once."""
        self._topology.send(self._topology_bytes, stamp)

    def record_topology(self, stamp: int) -> None:
        """Record what was said once, at the beginning of a recording."""
        self._topology.record(self._topology_bytes, stamp)

    def send(
        self, x: Array, wrenches: Array, stamp: int, *, velocities: Array | None = None, double: bool = False
    ) -> None:
        """Publish and record one frame.

        Args:
            x: positions [m], shape (3, n).
            wrenches: force [N] and torque [N m] on each gripper, shape (gripper_count, 6).
            stamp: ROS time at which the frame was due [ns].
            velocities: [m/s], shape (3, n), where the cloud is to tell them.
            double: true for a cloud in double precision.
        """
        if self._points.wanted:
            cloud = self._cloud(velocity=velocities is not None, double=double)
            self._points.send(cloud.serialized(x, stamp, velocities), stamp)
            self.published += 1
        # Not recorded: it is large, and points and topology hold the same.
        if self._mesh.heard:
            self._mesh.publish(self._marker.serialized(x, stamp))
        for output, wrench in zip(self._wrenches, wrenches, strict=True):
            if output.wanted:
                output.send(wrench_message(wrench, frame_id=self._frame_id, stamp=stamp), stamp)

    def _cloud(self, *, velocity: bool, double: bool) -> CloudMessage:
        key = velocity, double
        if key not in self._clouds:
            height, width = self._shape
            self._clouds[key] = CloudMessage(
                frame_id=self._frame_id, height=height, width=width, velocity=velocity, double=double
            )
        return self._clouds[key]

    def flush(self) -> None:
        """Wait shortly until the last points have arrived."""
        self._points.flush()
