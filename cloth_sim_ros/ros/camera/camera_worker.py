# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Camera process: renders and publishes what the depth cameras of a node see.

Usage: `python -m cloth_sim_ros.ros.camera.camera_worker PARENT`. Reads pickled objects from standard input: a
`CameraSetup`, then a `CameraFrame` at a time. Ends with its input, by SIGTERM, or when the process PARENT ends. It then
leaves the ROS graph in order: Fast DDS may crash a subscriber of a process that is killed while it sends.

Answers are lines of JSON with one of these keys:

- `subscribed`: names of the cameras with subscribers, whenever they change.
- `warning`, `found`: a text for the log, with the name of the camera.
- `done`: number of cameras that were sent, after the set-up and after each frame.
"""

from __future__ import annotations

import contextlib
import json
import os
import pickle
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import rclpy
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from std_msgs.msg import String

from cloth_sim_ros.camera.depth_camera import DepthCamera
from cloth_sim_ros.physics.contact.obstacles import Obstacle
from cloth_sim_ros.ros.camera.camera_jobs import CameraFrame, CameraSetup
from cloth_sim_ros.ros.camera.image_messages import CameraInfoMessage, ImageMessage, PointsMessage, millimetres
from cloth_sim_ros.ros.io.qos_rules import CAMERA_INFO, DEPTH, LABEL_NAMES, LABELS, POINTS
from cloth_sim_ros.ros.io.tf_frames import FrameError, FrameTransformer, Pose
from cloth_sim_ros.ros.io.transports import large_segment
from cloth_sim_ros.scene.camera_section import MILLIMETRES

#: Niceness, so that the simulation has priority.
_NICENESS = 10
#: Period at which subscribers and the parent process are polled [s].
_POLL_PERIOD = 0.1
#: Longest wait for the transform of a frame, which comes later than the frame, and period of its polls [s].
_TRANSFORM_TIMEOUT, _TRANSFORM_POLL_PERIOD = 0.1, 0.002
#: Period of the warnings of a camera without a pose [ns].
_WARNING_PERIOD = 60_000_000_000
_TYPES = {DEPTH: Image, CAMERA_INFO: CameraInfo, LABELS: Image, LABEL_NAMES: String, POINTS: PointCloud2}

Answer = Callable[[dict[str, Any]], None]
Bodies = Sequence[tuple[Obstacle, Any, int]]


class CameraOutput:
    """Renderer of one depth camera, and publisher of its images, labels and points.

    Args:
        node: the node of this process.
        name: the camera.
        setup: set-up of the process.
        transformer: looks up TF frames.
        answer: sends warnings to the parent process.
    """

    def __init__(
        self, node: Node, name: str, setup: CameraSetup, transformer: FrameTransformer, answer: Answer
    ) -> None:
        self.name, self._answer, self._transformer = name, answer, transformer
        self._parameters, topics = setup.cameras[name], setup.topics[name]
        self._camera = DepthCamera(name, self._parameters, setup.triangles)
        frame_id, width, height = topics.frame_id, self._parameters.width, self._parameters.height
        size: dict[str, Any] = {"frame_id": frame_id, "width": width, "height": height}
        self._info = CameraInfoMessage(**size, intrinsics=self._camera.intrinsics)
        self._depth = ImageMessage(**size, encoding=self._parameters.encoding)
        self._label = ImageMessage(**size, encoding=MILLIMETRES)
        self._cloud = PointsMessage(**size)
        self._publishers = {
            leaf: node.create_publisher(
                kind,
                topics.names[leaf],
                _profile(topics.profiles[leaf]),
                event_callbacks=PublisherEventCallbacks(use_default_callbacks=False),
            )
            for leaf, kind in _TYPES.items()
        }
        self._labels: dict[str, int] = {}
        #: Stamp of the last warning that the pose is missing [ns]; None while it is known.
        self._last_warning: int | None = None

    @property
    def is_subscribed(self) -> bool:
        """True if any topic of the camera has subscribers."""
        return any(map(self._has_subscribers, _TYPES))

    def update_labels(self, labels: dict[str, int]) -> None:
        """Publish labels as latched JSON, {label: name}, if they differ from the last ones."""
        if labels != self._labels:
            self._labels = labels
            names = {str(label): name for name, label in labels.items()}
            self._publishers[LABEL_NAMES].publish(String(data=json.dumps(names)))

    def send(self, frame: CameraFrame, bodies: Bodies) -> None:
        """Render a frame and publish it on topics with subscribers; warn and send nothing without TF after 0.1 s."""
        pose = self._pose(frame)
        if pose is None:
            return
        self._publish(CAMERA_INFO, lambda: self._info.serialize(frame.stamp))
        if not any(self._has_subscribers(leaf) for leaf in (DEPTH, LABELS, POINTS)):
            return
        depths, labels = self._camera.render(pose, frame.x, bodies, frame=frame.index)
        in_millimetres = self._parameters.encoding == MILLIMETRES
        self._publish(
            DEPTH, lambda: self._depth.serialize(millimetres(depths) if in_millimetres else depths, frame.stamp)
        )
        self._publish(LABELS, lambda: self._label.serialize(labels, frame.stamp))
        self._publish(POINTS, lambda: self._cloud.serialize(self._camera.points(depths), frame.stamp))

    def subscribe_to_tf(self) -> None:
        """Subscribe to TF if the camera follows a TF frame, so that the first image finds its transform."""
        if self._parameters.frame:
            with contextlib.suppress(FrameError):
                self._transformer.newest(self._parameters.frame)

    def _pose(self, frame: CameraFrame) -> tuple[float, ...] | None:
        """Return position [m] and orientation x, y, z, w in the cloth's frame (7,); warn and return None without TF."""
        followed = self._parameters.frame
        if not followed:
            return frame.poses[self.name]
        self._transformer.advance_time(frame.stamp)
        try:
            position, orientation = self._followed_pose(followed, frame.stamp)
        except FrameError as error:
            last = self._last_warning
            # The clock may have been set back since.
            if last is None or not 0 <= frame.stamp - last < _WARNING_PERIOD:
                self._last_warning = frame.stamp
                text = f"camera '{self.name}' sends no images: {error}"
                self._answer({"warning": text, "camera": self.name})
            return None
        if self._last_warning is not None:
            self._last_warning = None
            self._answer({"found": f"camera '{self.name}' follows frame '{followed}'", "camera": self.name})
        assert orientation is not None
        return (*position, *orientation)

    def _followed_pose(self, followed: str, stamp: int) -> Pose:
        """Wait at most 0.1 s for a TF frame's transform at a ROS time [ns]; return position [m] and orientation.

        Raises:
            FrameError: if no transform of that time connects the frames, and none at most 0.1 s older.
        """
        lookup = partial(self._transformer.to_cloth, followed, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), stamp)
        end = time.monotonic() + _TRANSFORM_TIMEOUT
        # Nothing waits for a frame that is lost.
        while self._last_warning is None and time.monotonic() < end:
            with contextlib.suppress(FrameError):
                return lookup(max_age=0)
            time.sleep(_TRANSFORM_POLL_PERIOD)
        return lookup()

    def _has_subscribers(self, leaf: str) -> bool:
        return bool(self._publishers[leaf].get_subscription_count())

    def _publish(self, leaf: str, serialize: Callable[[], bytes]) -> None:
        """Publish the bytes that `serialize` returns on one of the camera's topics, if that has subscribers."""
        if self._has_subscribers(leaf):
            self._publishers[leaf].publish(serialize())


class CameraWorker:
    """Node of the camera process, with rclpy's start and end: renders and publishes the depth cameras of one cloth.

    Args:
        setup: set-up of the process.
        answer: sends an answer to the parent process.
    """

    def __init__(self, setup: CameraSetup, answer: Answer) -> None:
        self._answer = answer
        image_bytes = sum(camera.width * camera.height * (4 + 2 + 12) for camera in setup.cameras.values())
        rate = max(camera.rate for camera in setup.cameras.values())
        with large_segment(image_bytes, rate) as warning:
            rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
            self._node = Node(
                f"{setup.node}_cameras",
                namespace=setup.namespace,
                use_global_arguments=False,
                enable_rosout=False,
                start_parameter_services=False,
            )
        if warning:
            answer({"warning": warning, "camera": ""})
        transformer = FrameTransformer(self._node, setup.frame_id)
        self._cameras = [CameraOutput(self._node, name, setup, transformer, answer) for name in setup.cameras]
        for camera in self._cameras:
            camera.subscribe_to_tf()
        self._executor = SingleThreadedExecutor()
        self._tf_thread = threading.Thread(target=self._executor.spin, name="tf", daemon=True)
        if any(camera.frame for camera in setup.cameras.values()):
            self._executor.add_node(self._node)
            self._tf_thread.start()
        self._subscribed: list[str] = []
        self._bodies: tuple[Obstacle, ...] = ()

    def close(self) -> None:
        """Leave the ROS graph: end the executor, destroy the node, and shut rclpy down."""
        self._executor.shutdown(timeout_sec=_POLL_PERIOD)
        # rclpy may crash if a node is destroyed while a thread waits for its subscriptions.
        if self._tf_thread.is_alive():
            self._tf_thread.join(_POLL_PERIOD)
        self._node.destroy_node()
        rclpy.try_shutdown()

    def report_subscribed(self) -> None:
        """Send the parent process the names of the cameras with subscribers, if they changed."""
        subscribed = [camera.name for camera in self._cameras if camera.is_subscribed]
        if subscribed != self._subscribed:
            self._subscribed = subscribed
            self._answer({"subscribed": subscribed})

    def send(self, frame: CameraFrame) -> None:
        """Render and publish a frame for its due cameras; then send the parent process the answer `done`."""
        start_time = time.perf_counter()
        if frame.bodies is not None:
            self._bodies = frame.bodies
        bodies = [
            (body, pose, frame.labels[body.name]) for body, pose in zip(self._bodies, frame.body_poses, strict=True)
        ]
        sent = [camera for camera in self._cameras if camera.name in frame.cameras]
        for camera in self._cameras:
            camera.update_labels(frame.labels)
        for camera in sent:
            camera.send(frame, bodies)
        self._answer({"done": len(sent), "seconds": time.perf_counter() - start_time})


def main(arguments: Sequence[str]) -> int:
    """Run the camera process: render frames from standard input until that or the parent process ends; return 0."""
    os.nice(_NICENESS)
    parent, stream = int(arguments[0]), sys.stdin.buffer
    # A supervisor may send signals to the node and its processes at once. The node then closes the input.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())
    # ROS logs go to the standard output if RCUTILS_LOGGING_USE_STDOUT is set.
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())

    def answer(values: dict[str, Any]) -> None:
        print(json.dumps(values), file=answers, flush=True)

    # The node may end, or be killed while it sends a frame.
    reasons = EOFError, pickle.UnpicklingError, BrokenPipeError, SystemExit
    with contextlib.suppress(*reasons), contextlib.ExitStack() as stack:
        worker = CameraWorker(pickle.load(stream), answer)
        stack.callback(worker.close)
        answer({"done": 0})
        while os.getppid() == parent:
            worker.report_subscribed()
            # The parent sends a frame after the previous one was done: nothing else is in the stream's buffer.
            if select.select([stream], [], [], _POLL_PERIOD)[0]:
                worker.send(pickle.load(stream))
    return 0


def _profile(policies: dict[str, Any]) -> QoSProfile:
    return QoSProfile(
        reliability=ReliabilityPolicy(policies["reliability"]),
        history=HistoryPolicy(policies["history"]),
        durability=DurabilityPolicy(policies["durability"]),
        depth=policies["depth"],
    )


if __name__ == "__main__":
    status = main(sys.argv[1:])
    # Without the wait for threads, and for a pipe that nobody reads any more.
    os._exit(status)
