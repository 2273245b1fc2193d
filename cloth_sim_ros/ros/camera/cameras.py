# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The node's part of its depth cameras: passes frames on to the camera process while cameras have subscribers."""

from __future__ import annotations

import math
import queue
from typing import Any

import attrs
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node
from rclpy.qos import QoSProfile, qos_profile_sensor_data

from cloth_sim_ros.camera.depth_camera import label_numbers
from cloth_sim_ros.physics.contact.obstacles import Obstacle
from cloth_sim_ros.ros.camera.camera_jobs import CameraFrame, CameraSetup, CameraTopics
from cloth_sim_ros.ros.io.output import LATCHED_QOS, overridden_profile
from cloth_sim_ros.ros.io.qos_rules import CAMERA_LEAVES, LABEL_NAMES, POLICIES, PUBLISHER, Override
from cloth_sim_ros.ros.process.worker_process import WorkerProcess
from cloth_sim_ros.ros.reporting.log import ThrottledLog
from cloth_sim_ros.scene.cameras import camera_pose, optical_frame
from cloth_sim_ros.simulation.bodies.bodies import solids_and_poses
from cloth_sim_ros.simulation.simulation import Frame, Simulation

_WORKER_MODULE = "cloth_sim_ros.ros.camera.camera_worker"


class Cameras:
    """Link to the camera process: sends it, without blocking, the frames that depth cameras with subscribers need.

    Args:
        node: the node.
        simulation: the cloth.
        log: receives warnings.

    Raises:
        ParameterError: if the overrides of a topic's quality of service form no valid profile.
    """

    def __init__(self, node: Node, simulation: Simulation, log: ThrottledLog) -> None:
        self._simulation, self._log = simulation, log
        scene = simulation.scene
        self._setup = CameraSetup(
            node=node.get_name(),
            namespace=node.get_namespace(),
            frame_id=scene.frame_id,
            cameras=scene.views,
            topics={name: _topics(node, name, camera.frame) for name, camera in scene.views.items()},
            triangles=scene.sheet.triangles(),
        )
        self._process: WorkerProcess[CameraSetup | CameraFrame] | None = None
        self._labels: dict[str, int] = {}
        #: Cameras of the newest frame that was passed on.
        self._newest: frozenset[str] = frozenset()
        #: Bodies that the process has; written by the sending thread.
        self._sent_bodies: tuple[Obstacle, ...] | None = None
        # Each is written by one of the process's threads and read by others.
        self._subscribed: frozenset[str] = frozenset()
        self._state = "starting"
        self._n_images, self._render_time = 0, 0.0
        self._reports: queue.SimpleQueue[tuple[bool, str, str]] = queue.SimpleQueue()
        self._n_skipped = 0

    def start(self) -> None:
        """Start the camera process, without waiting for it, and send it the cameras and the cloth's triangles."""
        if not len(self._setup.triangles):
            self._log.warn("cameras", "cameras do not see this cloth: it has no triangles")
        self._process = WorkerProcess(
            _WORKER_MODULE,
            name="cameras",
            encode=self._encode,
            on_answer=self._receive,
            on_end=self._end,
            ends_with_input=True,
        )
        self._process.put(self._setup)

    def send(self, frame: Frame, stamp: int) -> None:
        """Queue a frame due at a ROS time [ns] for the process if a subscribed camera is due; replace an unsent one."""
        subscribed, scene = self._subscribed, self._simulation.scene
        if not subscribed or self._process is None:
            return
        names = frozenset(name for name in subscribed if _has_image(frame, scene.views[name].rate / scene.rate))
        if not names:
            return
        if self._process.has_waiting_job:
            # This frame replaces it. Otherwise a camera with a high rate would suppress one with a low rate.
            names |= self._newest & subscribed
        self._newest = names
        bodies, poses = solids_and_poses(self._simulation.obstacles, self._simulation.pinching)
        self._labels = label_numbers([body.name for body in bodies], self._labels)
        job = CameraFrame(
            index=frame.index,
            stamp=stamp,
            cameras=names,
            poses={name: camera_pose(camera) for name, camera in scene.views.items() if not camera.frame},
            # A later frame replaces this array and does not write into it.
            x=self._simulation.state.x,
            bodies=tuple(bodies),
            body_poses=poses,
            labels=self._labels,
        )
        replaced = self._process.put(job)
        if isinstance(replaced, CameraFrame):
            self._n_skipped += len(replaced.cameras)

    def report(self) -> None:
        """Log the warnings and notices that the camera process has sent since the last call. Call it periodically."""
        while not self._reports.empty():
            is_warning, camera, text = self._reports.get_nowait()
            log = self._log.warn if is_warning else self._log.info
            log(f"camera {camera} {is_warning}", text)

    def describe(self) -> dict[str, str]:
        """Return diagnostics entries: state of the process, images sent and skipped, and render time [s]."""
        return {
            "cameras": self._state,
            "camera_images": str(self._n_images),
            "camera_images_skipped": str(self._n_skipped),
            "camera_time_s": f"{self._render_time:.6g}",
        }

    def close(self) -> None:
        """End the camera process, and wait at most 2 s for its end."""
        if self._process is not None:
            self._process.close()
            self._process = None

    def _encode(self, job: CameraSetup | CameraFrame) -> CameraSetup | CameraFrame:
        """Return a job without bodies that the process has already (meshes are large); remember its bodies as sent."""
        if isinstance(job, CameraSetup) or job.bodies is None:
            return job
        sent, self._sent_bodies = self._sent_bodies, job.bodies
        is_known = sent is not None and list(map(id, sent)) == list(map(id, job.bodies))
        return attrs.evolve(job, bodies=None) if is_known else job

    def _receive(self, answer: dict[str, Any]) -> bool:
        """Store an answer of the camera process; return true if the process is done with its job."""
        if "subscribed" in answer:
            self._subscribed = frozenset(answer["subscribed"])
        for key in ("warning", "found"):
            if key in answer:
                self._reports.put((key == "warning", answer["camera"], answer[key]))
        if "done" not in answer:
            return False
        self._state = "running"
        self._n_images += answer["done"]
        self._render_time = answer.get("seconds", self._render_time)
        return True

    def _end(self, reason: str) -> None:
        self._subscribed = frozenset()
        self._state = reason
        self._reports.put((True, "", f"cameras send no images: their process {reason}; restart the node"))


def _topics(node: Node, name: str, frame: str) -> CameraTopics:
    profiles = {}
    for leaf in CAMERA_LEAVES:
        default = LATCHED_QOS if leaf == LABEL_NAMES else qos_profile_sensor_data
        profile = overridden_profile(node, f"~/{name}/{leaf}", default)
        profiles[leaf] = {policy: int(getattr(profile, policy)) for policy in POLICIES}
        _declare(node, f"~/{name}/{leaf}", profile)
    return CameraTopics(
        frame_id=frame or optical_frame(node.get_fully_qualified_name(), name),
        names={leaf: node.resolve_topic_name(f"~/{name}/{leaf}") for leaf in CAMERA_LEAVES},
        profiles=profiles,
    )


def _declare(node: Node, topic: str, profile: QoSProfile) -> None:
    """Declare a topic's quality of service on the node, as rclpy does with a publisher: `ros2 param dump` shows it."""
    for policy in POLICIES:
        name, value = Override(node.resolve_topic_name(topic), PUBLISHER, policy).name, getattr(profile, policy)
        if not node.has_parameter(name):
            text = value if policy == "depth" else value.name.lower()
            node.declare_parameter(name, text, ParameterDescriptor(read_only=True), True)


def _has_image(frame: Frame, images_per_frame: float) -> bool:
    """Return true if an image is due: in each paused frame, else by frame index and rate of images per frame."""
    if not frame.moved:
        return True
    return math.floor(frame.index * images_per_frame) > math.floor((frame.index - 1) * images_per_frame)
