# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Latency of a live cloth: from a target's publication to the arrival of the first cloud that reflects it.

`python -m benchmarks ros-latency` starts a node of its own with its recorder on, holds a corner of the
cloth, leads it around by a stream of targets as a robot would, and listens to the clouds. Which frame took which target
is then read from the recorded session: the cloud of that frame is the first one that reflects the target, and those
before it that it made obsolete.

A target takes effect with the frame that is due next, and shows in the cloud at that frame's end. So the least latency
is between nothing and a frame, evenly, on top of what computing and sending a frame take.
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

#: Radius [m] and speed [m/s] of the circle that the corner is led on.
_RADIUS, _SPEED = 0.1, 0.2
#: Targets that are sent before those that count [s].
_FIRST = 1.0


@attrs.frozen(kw_only=True)
class Latencies:
    """What was measured."""

    particles: int
    rate: float
    #: From each target's publication to the arrival of the first cloud that reflects it [s].
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
            "targets": len(self.seconds),
            "p1_ms": low,
            "median_ms": median,
            "p99_ms": high,
            "max_ms": highest,
            "goal": "median below a frame and 2 ms, p99 below two frames: " + ("met" if self.met else "not met"),
            **{name: self.diagnostics.get(name, "") for name in kept},
        }


class Prober(GripperProbe):
    """Publishes targets and listens to the clouds.

    Args:
        stream: targets a second, at random moments.
        alive: raises RuntimeError where the node has ended.
    """

    def __init__(self, *, stream: float, alive: Callable[[], None]) -> None:
        super().__init__("latency_probe", alive)
        self._between = 1.0 / stream
        self._random = np.random.default_rng(1)
        self._begun: float | None = None
        #: When each target was published [s], by its place, in order; and when each cloud arrived, by its stamp [ns].
        self.published: dict[tuple[float, ...], float] = {}
        self.arrived: dict[int, float] = {}
        self.particles = 0
        self.diagnostics: dict[str, str] = {}

    def hold(self) -> None:
        """Bring the gripper to the corner and close it.

        Raises:
            RuntimeError: if the node does not answer, or it holds nothing.
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
        """Lead the corner around for some time [s], and a little longer for the last targets to be seen."""
        # No garbage collection of this process between a cloud's arrival and its time.
        gc.collect()
        gc.freeze()
        self._begun = time.monotonic()
        end = self._begun + _FIRST + seconds
        self.spin_until(lambda: time.monotonic() >= end, limit=2.0 * (_FIRST + seconds))
        seen = len(self.arrived)
        self.spin_until(lambda: len(self.arrived) > seen + 10)

    def latencies(self, folder: Path) -> np.ndarray:
        """Return them [s], of the targets that were recorded in the session in a folder."""
        from cloth_sim_ros.session.reader import SessionReader

        (path,) = folder.glob("*.mcap")
        places = list(self.published)
        number = {place: index for index, place in enumerate(places)}
        found: list[float] = []
        shown = 0
        first = (self._begun or 0.0) + _FIRST
        with SessionReader(path) as reader:
            for recorded in reader.clouds():
                events = recorded.frame.events if recorded.frame is not None else ()
                taken = [tuple(event["position"]) for event in events if event["kind"] == "target"]
                arrival = self.arrived.get(recorded.cloud.stamp)
                if not taken or arrival is None or taken[-1] not in number:
                    continue
                newest = number[taken[-1]] + 1
                published = [self.published[place] for place in places[shown:newest]]
                found += [arrival - moment for moment in published if moment >= first]
                shown = max(shown, newest)
        return np.array(found)

    def see(self, cloud: PointCloud2) -> None:
        now = time.monotonic()
        self.particles = cloud.width * cloud.height
        self.arrived[cloud.header.stamp.sec * 1_000_000_000 + cloud.header.stamp.nanosec] = now

    def hear(self, values: dict[str, str]) -> None:
        self.diagnostics = values

    def place(self, now: float) -> np.ndarray:
        if self._begun is None:
            return CORNER
        turn = _SPEED / _RADIUS * (time.monotonic() - self._begun)
        return CORNER + _RADIUS * np.array([0.0, -np.sin(turn), 1.0 - np.cos(turn)])

    def sent(self, place: tuple[float, ...]) -> None:
        if self._begun is not None:
            self.published[place] = time.monotonic()

    def pause(self) -> float:
        return self._between * float(self._random.uniform(0.5, 1.5))


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
    """Measure with a node of its own.

    Args:
        resolution: rows and columns of the cloth.
        rate: frames a second.
        stream: targets a second.
        seconds: how long targets are counted [s].
        further: parameters of the node, ``name:=value``.

    Raises:
        RuntimeError: if the node ends, or does not answer.
    """
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        with running_node(resolution=resolution, rate=rate, folder=folder, further=further) as alive:
            prober = Prober(stream=stream, alive=alive)
            try:
                prober.hold()
                prober.lead(seconds)
            finally:
                prober.close()
        found = prober.latencies(folder)
    return Latencies(particles=prober.particles, rate=rate, seconds=found, diagnostics=prober.diagnostics)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the measurement and print it; exit status 0 where the goals are met, else 1."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks ros-latency", description=__doc__)
    parser.add_argument("--resolution", type=int, nargs=2, default=(64, 64), metavar=("ROWS", "COLUMNS"))
    parser.add_argument("--rate", type=float, default=60.0, help="frames a second")
    parser.add_argument("--stream", type=float, default=100.0, help="targets a second")
    parser.add_argument("--seconds", type=float, default=20.0, help="how long targets are counted")
    parser.add_argument("--json", type=Path, help="write the figures there")
    parser.add_argument("parameters", nargs="*", metavar="name:=value", help="further parameters of the node")
    options = parser.parse_args(arguments)
    with ros_context():
        found = measure(
            resolution=tuple(options.resolution),
            rate=options.rate,
            stream=options.stream,
            seconds=options.seconds,
            further=options.parameters,
        )
    for name, value in found.summary().items():
        print(f"{name:26} {value:.3f}" if isinstance(value, float) else f"{name:26} {value}")
    if options.json is not None:
        options.json.write_text(json.dumps({**found.summary(), "seconds": found.seconds.tolist()}))
    return 0 if found.met else 1


if __name__ == "__main__":
    sys.exit(main())
