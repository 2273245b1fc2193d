# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Latency of a live cloth, from a target to the first cloud that reflects it.

`python -m benchmarks ros-latency` starts a recording node and grasps a corner of the cloth. It then leads the corner
by a stream of targets, as a robot would, and receives the clouds. The recorded session tells which frame used which
target. The cloud of that frame is the first one that reflects the target and earlier, superseded ones.

With `--joint-states` a stream of joint states leads a ball beside the cloth instead, as a robot's link.

A target takes effect with the next frame and shows in the cloud at that frame's end. The smallest latency is therefore
uniform between zero and a frame, plus the time to compute and send a frame.
"""

from __future__ import annotations

import argparse
import gc
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState, PointCloud2
from std_srvs.srv import SetBool

from benchmarks.ros.node_process import CORNER, NodeProcess, Probe, node_process, ros_context, stamp_ns

#: Radius [m] and speed [m/s] of the corner's circle.
_RADIUS, _SPEED = 0.1, 0.2
#: A ball that one joint slides along x, and its start [m].
_SLIDE = (
    '<robot name="slide"><link name="stand"/><link name="ball"><collision><geometry><sphere radius="0.05"/></geometry>'
    '</collision></link><joint name="slide" type="prismatic"><parent link="stand"/><child link="ball"/>'
    '<limit lower="-1" upper="1"/></joint></robot>'
)
_BALL = np.array([0.0, 0.4, 0.5])
#: Largest 99th percentile beyond a frame, from a joint state to its cloud [s].
_MAX_STATE_DELAY = 0.01
#: Time before the counted targets [s].
_WARM_UP_TIME = 1.0


def latency_figures(
    seconds: np.ndarray, *, particles: int, rate: float, diagnostics: Mapping[str, str], joint_states: bool
) -> dict[str, Any]:
    """Return percentiles of latencies, and whether they meet the goal.

    Targets meet it if the median is below a frame plus 2 ms and the 99th percentile below two frames. Joint states meet
    it if the 99th percentile is below a frame plus 10 ms.

    Args:
        seconds: from each target's publication to the arrival of the first cloud that reflects it [s].
        particles: number of particles.
        rate: frames a second.
        diagnostics: the node's last diagnostics.
        joint_states: true if joint states led a link, false if targets led the gripper.
    """
    frame = 1.0 / rate
    low, median, high, highest = np.percentile(seconds, [1.0, 50.0, 99.0, 100.0]).tolist()
    goal, met = "median below a frame and 2 ms, p99 below two frames", median < frame + 0.002 and high < 2.0 * frame
    if joint_states:
        goal, met = "p99 below a frame and 10 ms", high < frame + _MAX_STATE_DELAY
    diagnostic_keys = ("real_time_factor_overall", "late_frames", "load", "longest_frame_ms", "integrator_reason")
    return {
        "particles": particles,
        "rate_hz": rate,
        "targets": len(seconds),
        "p1_ms": 1e3 * low,
        "median_ms": 1e3 * median,
        "p99_ms": 1e3 * high,
        "max_ms": 1e3 * highest,
        **{name: diagnostics.get(name, "") for name in diagnostic_keys},
        "goal": goal,
        "met": met,
    }


class LatencyProbe(Probe):
    """Probe that publishes targets when they are due, and receives clouds and diagnostics.

    Args:
        stream: targets per second, at random times.
        measured: the node.
    """

    def __init__(self, *, stream: float, measured: NodeProcess) -> None:
        super().__init__("latency_probe", measured)
        quality = QoSProfile(depth=10)
        self._targets = self.node.create_publisher(PoseStamped, "/cloth_sim/gripper/target", quality)
        self.node.create_subscription(PointCloud2, "/cloth_sim/points", self._receive_cloud, quality)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._receive_diagnostics, quality)
        self._close = self.node.create_client(SetBool, "/cloth_sim/gripper/close")
        self._between = 1.0 / stream
        self._random = np.random.default_rng(1)
        self._begun: float | None = None
        self._next = time.monotonic()
        #: Publication times of targets [s] by position, in order; arrival times of clouds [s] by stamp [ns].
        self.published: dict[tuple[float, ...], float] = {}
        self.arrived: dict[int, float] = {}
        self.particles = 0
        self.diagnostics: dict[str, str] = {}

    def spin_once(self) -> None:
        now = time.monotonic()
        if now >= self._next:
            self._next = now + self._between * float(self._random.uniform(0.5, 1.5))
            self._publish(self._target_position())
        self._executor.spin_once(timeout_sec=max(0.0, min(self._next - now, 0.01)))

    def hold(self) -> None:
        """Bring the gripper to the corner and close it.

        Raises:
            RuntimeError: if the node does not answer, or the gripper holds nothing.
        """
        self.spin_until(self._close.service_is_ready)
        self.spin_until(self._targets.get_subscription_count)
        self._wait_for_clouds()
        self.request(self._close, SetBool.Request(data=True))

    def lead(self, seconds: float) -> None:
        """Lead the corner for some time [s], and until the last targets show."""
        # Garbage collection must not delay the arrival times.
        gc.collect()
        gc.freeze()
        self._begun = time.monotonic()
        end = self._begun + _WARM_UP_TIME + seconds
        self.spin_until(lambda: time.monotonic() >= end, limit=2.0 * (_WARM_UP_TIME + seconds))
        self._wait_for_clouds()

    def _wait_for_clouds(self) -> None:
        """Wait for ten more clouds."""
        seen = len(self.arrived)
        self.spin_until(lambda: len(self.arrived) > seen + 10)

    def latencies(self, folder: Path) -> np.ndarray:
        """Return the latencies [s], (targets,), of the targets recorded in the session of a folder."""
        from cloth_sim_ros.session.reader import SessionReader

        (path,) = folder.glob("*.mcap")
        positions = list(self.published)
        index_of = {position: index for index, position in enumerate(positions)}
        latencies: list[float] = []
        shown = 0
        first = (self._begun or 0.0) + _WARM_UP_TIME
        with SessionReader(path) as reader:
            for recorded in reader.clouds():
                events = recorded.frame.events if recorded.frame is not None else ()
                targets = [position for event in events if (position := self.commanded_position(event))]
                arrival = self.arrived.get(recorded.cloud.stamp)
                if not targets or arrival is None or targets[-1] not in index_of:
                    continue
                newest = index_of[targets[-1]] + 1
                published = [self.published[position] for position in positions[shown:newest]]
                latencies += [arrival - moment for moment in published if moment >= first]
                shown = max(shown, newest)
        return np.array(latencies)

    def commanded_position(self, event: Mapping[str, Any]) -> tuple[float, ...]:
        """Return the position that a recorded event commands [m]; empty for other events."""
        return tuple(event["position"]) if event["kind"] == "target" else ()

    def _receive_cloud(self, cloud: PointCloud2) -> None:
        now = time.monotonic()
        self.particles = cloud.width * cloud.height
        self.arrived[stamp_ns(cloud)] = now

    def _receive_diagnostics(self, report: DiagnosticArray) -> None:
        for status in report.status:
            if status.name.endswith(": cloth"):
                self.diagnostics = {entry.key: entry.value for entry in status.values}

    def _target_position(self) -> np.ndarray:
        if self._begun is None:
            return CORNER
        angle = _SPEED / _RADIUS * (time.monotonic() - self._begun)
        return CORNER + _RADIUS * np.array([0.0, -np.sin(angle), 1.0 - np.cos(angle)])

    def _publish(self, position: np.ndarray) -> None:
        message = PoseStamped()
        p = message.pose.position
        p.x, p.y, p.z = position.tolist()
        message.pose.orientation.w = 1.0
        self._note((p.x, p.y, p.z))
        self._targets.publish(message)

    def _note(self, position: tuple[float, ...]) -> None:
        """Note the publication of a target."""
        if self._begun is not None:
            self.published[position] = time.monotonic()


class JointStateProbe(LatencyProbe):
    """Probe that publishes positions of the joint of a ball instead of targets."""

    def __init__(self, *, stream: float, measured: NodeProcess) -> None:
        super().__init__(stream=stream, measured=measured)
        self._states = self.node.create_publisher(JointState, "/joint_states", 10)

    def hold(self) -> None:
        """Wait for clouds: the node starts with the joint's first states."""
        self._wait_for_clouds()

    def commanded_position(self, event: Mapping[str, Any]) -> tuple[float, ...]:
        return tuple(event["poses"][0][:3]) if event["kind"] == "move_obstacles" else ()

    def _target_position(self) -> np.ndarray:
        return _BALL + super()._target_position()[1] * np.array([1.0, 0.0, 0.0])

    def _publish(self, position: np.ndarray) -> None:
        x, y, z = position.tolist()
        self._note((x, y, z))
        self._states.publish(JointState(name=["slide"], position=[x]))


def robot_parameters(folder: Path) -> list[str]:
    """Return the parameters of a node beside the ball; write its description to a folder."""
    file = folder / "slide.urdf"
    file.write_text(_SLIDE)
    position = _BALL.tolist()
    return ["robot.enabled:=true", f"robot.description_file:={file}", f"robot.position:={position}"]


def recording_parameters(options: argparse.Namespace, folder: Path) -> list[str]:
    """Return the parameters of a recording node whose grip holds only the corner, which moves with the gripper."""
    return [
        f"cloth.resolution:={list(options.resolution)}",
        f"rate:={options.rate}",
        f"gripper.radius:={0.7 / max(options.resolution)}",
        "record.enabled:=true",
        f"record.folder:={folder}",
    ]


def measure(options: argparse.Namespace) -> tuple[np.ndarray, dict[str, Any]]:
    """Measure the latencies of a new node [s]; return them and their figures.

    Raises:
        RuntimeError: if the node ends, or does not answer.
    """
    make_probe = JointStateProbe if options.joint_states else LatencyProbe
    with tempfile.TemporaryDirectory() as folder:
        parameters = recording_parameters(options, Path(folder))
        parameters += robot_parameters(Path(folder)) if options.joint_states else []
        with (
            node_process([], [*parameters, *options.parameters]) as node,
            make_probe(stream=options.stream, measured=node) as probe,
        ):
            probe.hold()
            probe.lead(options.seconds)
        latencies = probe.latencies(Path(folder))
    figures = latency_figures(
        latencies,
        particles=probe.particles,
        rate=options.rate,
        diagnostics=probe.diagnostics,
        joint_states=options.joint_states,
    )
    return latencies, figures


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--resolution", type=int, nargs=2, default=(64, 64), metavar=("ROWS", "COLUMNS"))
    parser.add_argument("--rate", type=float, default=60.0, help="frames a second")
    parser.add_argument("--stream", type=float, default=100.0, help="targets a second")
    parser.add_argument("--seconds", type=float, default=20.0, help="duration of the counted targets [s]")
    parser.add_argument("--joint-states", action="store_true", help="lead a link by joint states")
    parser.add_argument("parameters", nargs="*", metavar="name:=value", help="further parameters of the node")


def figures(options: argparse.Namespace) -> dict[str, Any]:
    """Return the percentiles of the latencies."""
    with ros_context():
        return measure(options)[1]
