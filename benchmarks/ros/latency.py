# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Latency of a live cloth, from a target to the first cloud that reflects it.

`python -m benchmarks ros-latency` starts a recording node and grasps a corner of the cloth. It then leads the corner
by a stream of targets, as a robot would, and receives the clouds. The recorded session tells which frame used which
target. The cloud of that frame is the first one that reflects the target and earlier, superseded ones.

A target takes effect with the next frame and shows in the cloud at that frame's end. The smallest latency is therefore
uniform between zero and a frame, plus the time to compute and send a frame.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import json
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import SetBool

from benchmarks.ros.gripper_probe import CORNER, PATIENCE, GripperProbe
from benchmarks.ros.node_process import node_process, ros_context

#: Radius [m] and speed [m/s] of the corner's circle.
_RADIUS, _SPEED = 0.1, 0.2
#: Time before the counted targets [s].
_WARM_UP_TIME = 1.0


@attrs.frozen(kw_only=True)
class Latencies:
    """Measured latencies."""

    particles: int
    rate: float
    #: From each target's publication to the arrival of the first cloud that reflects it [s].
    seconds: np.ndarray
    #: The node's last diagnostics.
    diagnostics: dict[str, str]

    @property
    def met(self) -> bool:
        """True if the median is below a frame plus 2 ms and the 99th percentile below two frames."""
        frame = 1.0 / self.rate
        return bool(np.median(self.seconds) < frame + 0.002 and np.percentile(self.seconds, 99.0) < 2.0 * frame)

    def summary(self) -> dict[str, Any]:
        """Return plain values for a table."""
        percentiles = np.percentile(self.seconds, [1.0, 50.0, 99.0, 100.0])
        low, median, high, highest = (1e3 * percentiles).tolist()
        diagnostic_keys = ("real_time_factor_overall", "late_frames", "load", "longest_frame_ms", "integrator_reason")
        return {
            "particles": self.particles,
            "rate_hz": self.rate,
            "targets": len(self.seconds),
            "p1_ms": low,
            "median_ms": median,
            "p99_ms": high,
            "max_ms": highest,
            "goal": "median below a frame and 2 ms, p99 below two frames: " + ("met" if self.met else "not met"),
            **{name: self.diagnostics.get(name, "") for name in diagnostic_keys},
        }


class LatencyProbe(GripperProbe):
    """Probe that publishes targets and receives the clouds.

    Args:
        stream: targets per second, at random times.
        alive: raises RuntimeError if the node has ended.
    """

    def __init__(self, *, stream: float, alive: Callable[[], None]) -> None:
        super().__init__("latency_probe", alive)
        self._between = 1.0 / stream
        self._random = np.random.default_rng(1)
        self._begun: float | None = None
        #: Publication times of targets [s] by position, in order; arrival times of clouds [s] by stamp [ns].
        self.published: dict[tuple[float, ...], float] = {}
        self.arrived: dict[int, float] = {}
        self.particles = 0
        self.diagnostics: dict[str, str] = {}

    def hold(self) -> None:
        """Bring the gripper to the corner and close it.

        Raises:
            RuntimeError: if the node does not answer, or the gripper holds nothing.
        """
        self.spin_until(self._close.service_is_ready)
        self.spin_until(self._targets.get_subscription_count)
        seen = len(self.arrived)
        self.spin_until(lambda: len(self.arrived) > seen + 10)
        answer = self._close.call_async(SetBool.Request(data=True))
        self.spin_until(answer.done)
        if not answer.result().success:
            raise RuntimeError(f"the gripper holds nothing: {answer.result().message}")

    def lead(self, seconds: float) -> None:
        """Lead the corner for some time [s], and until the last targets show."""
        # Garbage collection must not delay the arrival times.
        gc.collect()
        gc.freeze()
        self._begun = time.monotonic()
        end = self._begun + _WARM_UP_TIME + seconds
        self.spin_until(lambda: time.monotonic() >= end, limit=2.0 * (_WARM_UP_TIME + seconds))
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
                targets = [tuple(event["position"]) for event in events if event["kind"] == "target"]
                arrival = self.arrived.get(recorded.cloud.stamp)
                if not targets or arrival is None or targets[-1] not in index_of:
                    continue
                newest = index_of[targets[-1]] + 1
                published = [self.published[position] for position in positions[shown:newest]]
                latencies += [arrival - moment for moment in published if moment >= first]
                shown = max(shown, newest)
        return np.array(latencies)

    def on_cloud(self, cloud: PointCloud2) -> None:
        now = time.monotonic()
        self.particles = cloud.width * cloud.height
        self.arrived[cloud.header.stamp.sec * 1_000_000_000 + cloud.header.stamp.nanosec] = now

    def on_diagnostics(self, values: dict[str, str]) -> None:
        self.diagnostics = values

    def target_position(self, now: float) -> np.ndarray:
        if self._begun is None:
            return CORNER
        angle = _SPEED / _RADIUS * (time.monotonic() - self._begun)
        return CORNER + _RADIUS * np.array([0.0, -np.sin(angle), 1.0 - np.cos(angle)])

    def before_publish(self, position: tuple[float, ...]) -> None:
        if self._begun is not None:
            self.published[position] = time.monotonic()

    def pause(self) -> float:
        return self._between * float(self._random.uniform(0.5, 1.5))


@contextlib.contextmanager
def running_node(
    *, resolution: tuple[int, int], rate: float, folder: Path, further: Sequence[str]
) -> Iterator[Callable[[], None]]:
    """Run a recording node in its own process; yield a check that raises RuntimeError if it has ended."""
    parameters = [
        f"cloth.resolution:=[{resolution[0]}, {resolution[1]}]",
        f"rate:={rate}",
        # The grip holds only the corner, which moves rigidly with the gripper.
        f"gripper.radius:={0.7 / max(resolution)}",
        "record.enabled:=true",
        f"record.folder:={folder}",
        *further,
    ]
    log = folder / "node.log"
    with node_process([], parameters, log=log, patience=PATIENCE) as process:

        def alive() -> None:
            if process.poll() is not None:
                said = log.read_text(errors="replace")
                raise RuntimeError(f"the node ended with status {process.returncode}:\n{said}")

        yield alive


def measure(
    *, resolution: tuple[int, int], rate: float, stream: float, seconds: float, further: Sequence[str] = ()
) -> Latencies:
    """Measure the latencies of a new node.

    Args:
        resolution: rows and columns of the cloth.
        rate: frames a second.
        stream: targets a second.
        seconds: duration of the counted targets [s].
        further: parameters of the node, ``name:=value``.

    Raises:
        RuntimeError: if the node ends, or does not answer.
    """
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        with running_node(resolution=resolution, rate=rate, folder=folder, further=further) as alive:
            prober = LatencyProbe(stream=stream, alive=alive)
            try:
                prober.hold()
                prober.lead(seconds)
            finally:
                prober.close()
        latencies = prober.latencies(folder)
    return Latencies(particles=prober.particles, rate=rate, seconds=latencies, diagnostics=prober.diagnostics)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the measurement and print it; return exit status 0 if the goals are met, else 1."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks ros-latency", description=__doc__)
    parser.add_argument("--resolution", type=int, nargs=2, default=(64, 64), metavar=("ROWS", "COLUMNS"))
    parser.add_argument("--rate", type=float, default=60.0, help="frames a second")
    parser.add_argument("--stream", type=float, default=100.0, help="targets a second")
    parser.add_argument("--seconds", type=float, default=20.0, help="duration of the counted targets [s]")
    parser.add_argument("--json", type=Path, help="write the figures there")
    parser.add_argument("parameters", nargs="*", metavar="name:=value", help="further parameters of the node")
    options = parser.parse_args(arguments)
    with ros_context():
        latencies = measure(
            resolution=tuple(options.resolution),
            rate=options.rate,
            stream=options.stream,
            seconds=options.seconds,
            further=options.parameters,
        )
    for name, value in latencies.summary().items():
        print(f"{name:26} {value:.3f}" if isinstance(value, float) else f"{name:26} {value}")
    if options.json is not None:
        options.json.write_text(json.dumps({**latencies.summary(), "seconds": latencies.seconds.tolist()}))
    return 0 if latencies.met else 1


if __name__ == "__main__":
    sys.exit(main())
