# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Latency of a live cloth: from a target's publication to the arrival of the first cloud that reflects it.

`python -m cloth_sim_ros.ros.measure_latency` starts a node of its own with its recorder on, holds a corner of the
cloth, publishes a stream of targets as a robot would, lets them jump at random times, and looks for each jump in the
clouds that arrive.

A jump takes effect with the frame that is due next, and shows in the cloud at that frame's end. So the least latency
is between nothing and a frame, evenly, on top of what computing and sending a frame take.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import SetBool

#: Where the last particle of the default cloth hangs, and how far it is made to jump [m].
_CORNER = (0.5, 0.0, 0.5)
_JUMP = 0.006
#: Longest wait for the node to begin, for an answer, or for a jump to show [s].
_PATIENCE = 120.0
#: Jumps that are made before those that count.
_FIRST = 10


@attrs.frozen(kw_only=True)
class Latencies:
    """What was measured."""

    particles: int
    rate: float
    #: From a target's publication to the arrival of the first cloud that reflects it [s], one each.
    seconds: np.ndarray
    #: The node's last diagnostics.
    diagnostics: dict[str, str]

    @property
    def met(self) -> bool:
        """Whether the median is below one frame and 2 ms, and 99 of 100 below two frames."""
        frame = 1.0 / self.rate
        return bool(np.median(self.seconds) < frame + 0.002 and np.percentile(self.seconds, 99.0) < 2.0 * frame)

    def summary(self) -> dict[str, Any]:
        """Plain values for a table."""
        low, median, high, highest = (
            float(1e3 * value) for value in np.percentile(self.seconds, [1.0, 50.0, 99.0, 100.0])
        )
        kept = ("real_time_factor_overall", "late_frames", "load", "longest_frame_ms", "integrator_why")
        return {
            "particles": self.particles,
            "rate_hz": self.rate,
            "jumps": len(self.seconds),
            "p1_ms": low,
            "median_ms": median,
            "p99_ms": high,
            "max_ms": highest,
            "goal": "median below a frame and 2 ms, p99 below two frames: " + ("met" if self.met else "not met"),
            **{name: self.diagnostics.get(name, "") for name in kept},
        }


class Prober:
    """Publishes targets and finds their jumps in the clouds.

    Args:
        stream: targets a second; they repeat the newest place between two jumps.
        rate: frames a second of the node.
        alive: raises RuntimeError where the node has ended.
    """

    def __init__(self, *, stream: float, rate: float, alive: Callable[[], None]) -> None:
        self._alive = alive
        self._node = Node("latency_probe")
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._targets = self._node.create_publisher(PoseStamped, "/cloth_sim/gripper/target", QoSProfile(depth=10))
        self._node.create_subscription(PointCloud2, "/cloth_sim/points", self._see, QoSProfile(depth=10))
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._hear, QoSProfile(depth=10))
        self._between = 1.0 / stream
        self._period = 1.0 / rate
        self._height = 0.0
        self._next = time.monotonic()
        self._sent: float | None = None
        self._before: float | None = None
        self._direction = 1.0
        self._found: list[float] = []
        self.particles = 0
        self.diagnostics: dict[str, str] = {}

    def hold(self) -> None:
        """Bring the gripper to the corner and close it.

        Raises:
            RuntimeError: if the node does not answer, or it holds nothing.
        """
        close = self._node.create_client(SetBool, "/cloth_sim/gripper/close")
        self._spin_until(close.service_is_ready)
        self._spin_until(self._targets.get_subscription_count)
        end = time.monotonic() + 10.0 * self._period
        self._spin_until(lambda: time.monotonic() > end)
        answer = close.call_async(SetBool.Request(data=True))
        self._spin_until(answer.done)
        if not answer.result().success:
            raise RuntimeError(f"the gripper holds nothing: {answer.result().message}")

    def measure(self, jumps: int) -> np.ndarray:
        """Let targets jump so often, at random times within a frame; return the latencies [s]."""
        random = np.random.default_rng(1)
        # No garbage collection of this process between a cloud's arrival and its time.
        gc.collect()
        gc.freeze()
        for _ in range(jumps + _FIRST):
            # Long enough for what the jump before stirred up to fade below the next one.
            begin = time.monotonic() + self._period * float(random.uniform(6.0, 8.0))
            self._spin_until(lambda begin=begin: time.monotonic() >= begin, busy=True)
            self._direction = 1.0 if self._height == 0.0 else -1.0
            self._height = _JUMP if self._height == 0.0 else 0.0
            count = len(self._found)
            self._sent = time.monotonic()
            self._publish()
            self._spin_until(lambda count=count: len(self._found) > count)
        return np.array(self._found[_FIRST:])

    def close(self) -> None:
        """Leave the graph."""
        self._executor.shutdown()
        self._node.destroy_node()

    def _see(self, cloud: PointCloud2) -> None:
        now = time.monotonic()
        self.particles = cloud.width * cloud.height
        height = float(np.frombuffer(cloud.data, dtype="<f4").reshape(self.particles, -1)[-1, 2])
        before, self._before = self._before, height
        if self._sent is None or before is None:
            return
        # By half the jump within a frame: nothing else moves a corner that is held.
        if self._direction * (height - before) > 0.5 * _JUMP:
            self._found.append(now - self._sent)
            self._sent = None

    def _hear(self, report: DiagnosticArray) -> None:
        for status in report.status:
            if status.name.endswith(": cloth"):
                self.diagnostics = {entry.key: entry.value for entry in status.values}

    def _publish(self) -> None:
        message = PoseStamped()
        p = message.pose.position
        p.x, p.y, p.z = _CORNER
        p.z += self._height
        message.pose.orientation.w = 1.0
        self._targets.publish(message)

    def _spin_until(self, condition: Any, *, busy: bool = False) -> None:
        """Serve what arrives and keep the stream up until the condition holds."""
        end = time.monotonic() + _PATIENCE
        while not condition():
            now = time.monotonic()
            self._alive()
            if now > end:
                raise RuntimeError(f"waited {_PATIENCE:g} s in vain")
            if now >= self._next:
                self._next = max(self._next + self._between, now)
                self._publish()
            # A fine grain where a moment is waited for that no message announces.
            self._executor.spin_once(timeout_sec=max(0.0, min(self._next - now, 0.0005 if busy else 0.01)))


@contextlib.contextmanager
def running_node(
    *, resolution: tuple[int, int], rate: float, folder: Path, further: Sequence[str]
) -> Iterator[Callable[[], None]]:
    """A node in a process of its own, recording; gives what raises RuntimeError where it has ended."""
    parameters = [
        f"cloth.resolution:=[{resolution[0]}, {resolution[1]}]",
        f"rate:={rate}",
        # The corner alone, a little below where it began: it moves as one with the gripper.
        f"gripper.radius:={0.7 / max(resolution)}",
        "record.enabled:=true",
        f"record.folder:={folder}",
        *further,
    ]
    command = [sys.executable, "-m", "cloth_sim_ros.ros.main", "--ros-args"]
    for parameter in parameters:
        command += ["-p", parameter]
    log = folder / "node.log"
    with log.open("wb") as stream:
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=stream, stderr=stream)

    def alive() -> None:
        if process.poll() is not None:
            raise RuntimeError(f"the node ended with status {process.returncode}:\n{log.read_text(errors='replace')}")

    try:
        yield alive
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(_PATIENCE)


def measure(
    *, resolution: tuple[int, int], rate: float, stream: float, jumps: int, further: Sequence[str] = ()
) -> Latencies:
    """Measure with a node of its own.

    Args:
        resolution: rows and columns of the cloth.
        rate: frames a second.
        stream: targets a second.
        jumps: how many are measured.
        further: parameters of the node, ``name:=value``.
    """
    with (
        tempfile.TemporaryDirectory() as folder,
        running_node(resolution=resolution, rate=rate, folder=Path(folder), further=further) as alive,
    ):
        prober = Prober(stream=stream, rate=rate, alive=alive)
        try:
            prober.hold()
            seconds = prober.measure(jumps)
        finally:
            prober.close()
    return Latencies(particles=prober.particles, rate=rate, seconds=seconds, diagnostics=prober.diagnostics)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the measurement and print it; exit status 0 where the goals are met, else 1."""
    parser = argparse.ArgumentParser(prog="python -m cloth_sim_ros.ros.measure_latency", description=__doc__)
    parser.add_argument("--resolution", type=int, nargs=2, default=(64, 64), metavar=("ROWS", "COLUMNS"))
    parser.add_argument("--rate", type=float, default=60.0, help="frames a second")
    parser.add_argument("--stream", type=float, default=100.0, help="targets a second")
    parser.add_argument("--jumps", type=int, default=300, help="targets that are measured")
    parser.add_argument("--json", type=Path, help="write the figures there")
    parser.add_argument("parameters", nargs="*", metavar="name:=value", help="further parameters of the node")
    options = parser.parse_args(arguments)
    # A graph of its own: nobody else's targets, nobody else's clouds.
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    rclpy.init(args=[])
    try:
        found = measure(
            resolution=tuple(options.resolution),
            rate=options.rate,
            stream=options.stream,
            jumps=options.jumps,
            further=options.parameters,
        )
    finally:
        rclpy.try_shutdown()
    for name, value in found.summary().items():
        print(f"{name:26} {value:.3f}" if isinstance(value, float) else f"{name:26} {value}")
    if options.json is not None:
        options.json.write_text(json.dumps({**found.summary(), "seconds": found.seconds.tolist()}))
    return 0 if found.met else 1


if __name__ == "__main__":
    sys.exit(main())
