# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Cost of a live node beside its simulation, and of parameter changes at run time.

`python -m benchmarks ros-node idle` starts a cloth without subscriber and recorder, once at rest and once swinging. It
reads the processor time of the process. The added time per frame is that time minus the time of the same frames of a
bare simulation in this process.

`python -m benchmarks ros-node sets` changes gravity, drag, wind and damping of a live cloth a thousand times a minute.
Intervals with and without changes alternate; late frames are counted in both.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import time
from collections.abc import Iterator
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter

from benchmarks.ros.node_process import NodeProcess, node_process, ros_context
from benchmarks.ros.probe import Probe
from cloth_sim_ros import Scene, Simulation
from validation.command import above, at_least

#: Largest added time per frame [ms].
GOAL = 0.3
#: Without gravity a hung cloth is at rest from the start, and asleep after a second.
AT_REST = {"gravity": [0.0, 0.0, 0.0]}
#: Largest number of pending requests.
_MAX_PENDING = 8
#: Parameter changes per minute.
RATE = 1000.0


@contextlib.contextmanager
def cloth(name: str, values: dict[str, Any]) -> Iterator[NodeProcess]:
    """Run a node in its own process; yield it once it is running."""
    parameters = [f"{key}:={json.dumps(value)}" for key, value in values.items()]
    with node_process(["-r", f"__node:={name}"], parameters) as node:
        node.wait_for_output("grippers:")
        yield node


def measure_idle(values: dict[str, Any], seconds: float, settle: float) -> dict[str, float]:
    """Return ms per frame of an idle node and of a bare simulation, and the share of a core."""
    scene = Scene.from_parameters(values)
    with cloth(f"idle_{os.getpid()}", values) as node:
        time.sleep(settle)
        before, begun = node.processor_time(), time.monotonic()
        time.sleep(seconds)
        busy, elapsed = node.processor_time() - before, time.monotonic() - begun
    alone, paced = (simulation_alone(scene, seconds, settle, paced=paced) for paced in (False, True))
    per_frame = busy / (elapsed * scene.rate)
    return {
        "node_ms_a_frame": round(1e3 * per_frame, 4),
        "simulation_ms_a_frame": round(1e3 * alone, 4),
        "paced_simulation_ms_a_frame": round(1e3 * paced, 4),
        "added_ms_a_frame": round(1e3 * (per_frame - alone), 4),
        "added_to_paced_ms_a_frame": round(1e3 * (per_frame - paced), 4),
        "share_of_a_core": round(busy / elapsed, 4),
    }


def simulation_alone(scene: Scene, seconds: float, settle: float, *, paced: bool) -> float:
    """Return the processor time of a frame in this process [s].

    Frames run back to back, or each at its due time (`paced`), in which case it finds cold processor caches.
    """
    simulation, frames = Simulation(scene), round(seconds * scene.rate)
    for _ in range(round(settle * scene.rate)):
        simulation.advance()
    before, begun = time.process_time(), time.monotonic()
    for k in range(1, frames + 1):
        if paced:
            time.sleep(max(0.0, begun + k * scene.period - time.monotonic()))
        simulation.advance()
    return (time.process_time() - before) / frames


class ParameterSetter(Probe):
    """Sets parameters of a node, and counts its late frames.

    Args:
        target: full name of the node.
        measured: the node.
    """

    def __init__(self, target: str, measured: NodeProcess) -> None:
        super().__init__(f"setter_{os.getpid()}", measured)
        self._status: dict[str, str] = {}
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._take, 10)
        self._client = self.node.create_client(SetParameters, f"{target}/set_parameters")
        self._pending: list[Any] = []
        self.refused = 0

    def run_interval(self, seconds: float, rate: float) -> tuple[int, int]:
        """Change parameters at a rate [1/s] for some time [s]; return the number of changes and of late frames."""
        self._next_report()
        late, sent = int(self._status["late_frames"]), 0
        begun = time.monotonic()
        while (elapsed := time.monotonic() - begun) < seconds:
            # A service queues ten requests; more would be lost on a busy machine.
            while sent < elapsed * rate and len(self._pending) < _MAX_PENDING:
                request = SetParameters.Request(parameters=[_change(sent)])
                self._pending.append(self._client.call_async(request))
                sent += 1
            self.spin_once()
            self._count()
        self.spin_until(lambda: not self._count())
        self._next_report()
        return sent, int(self._status["late_frames"]) - late

    def _count(self) -> int:
        """Count refused changes; return the number of pending requests."""
        done = [future.result() for future in self._pending if future.done()]
        self.refused += sum(not result.successful for answer in done for result in answer.results)
        self._pending = [future for future in self._pending if not future.done()]
        return len(self._pending)

    def wait(self) -> None:
        """Wait until the node answers."""
        self.spin_until(self._client.service_is_ready)

    def _next_report(self) -> None:
        self._status = {}
        self.spin_until(lambda: self._status)

    def _take(self, message: DiagnosticArray) -> None:
        self._status = {entry.key: entry.value for entry in message.status[0].values}


def _change(index: int) -> Any:
    """Return the change of an index: small changes of each kind in turn."""
    size = 0.01 * (index % 7)
    changes: list[tuple[str, Any]] = [
        ("gravity", [0.0, 0.0, -9.81 + size]),
        ("wind.velocity", [0.1 + size, 0.0, 0.0]),
        ("air.drag", 0.2 + size),
        ("material.damping", 0.1 + 0.1 * size),
    ]
    name, value = changes[index % 4]
    return Parameter(name, value=value).to_parameter_msg()


def measure_sets(values: dict[str, Any], seconds: float, rounds: int) -> dict[str, Any]:
    """Return late frames of intervals with parameter changes, and of as many without."""
    name = f"sets_{os.getpid()}"
    late: dict[str, list[int]] = {"with": [], "without": []}
    sent = 0
    with cloth(name, values) as node, ParameterSetter(f"/{name}", node) as setter:
        setter.wait()
        for _ in range(rounds):
            late["without"].append(setter.run_interval(seconds, 0.0)[1])
            count, late_count = setter.run_interval(seconds, RATE / 60.0)
            sent += count
            late["with"].append(late_count)
    counts = {"set": sent, "refused": setter.refused, "seconds_each": seconds, "late_frames": late}
    return counts | {"met": not setter.refused}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("what", choices=("idle", "sets"))
    parser.add_argument("--seconds", type=above(0.0), default=20.0, help="of each interval")
    parser.add_argument("--settle", type=float, default=4.0, help="of idle: time before")
    parser.add_argument("--rounds", type=at_least(1), default=3, help="of sets: pairs of intervals")
    parser.add_argument("--resolution", type=int, default=0, help="particles a side")


def figures(options: argparse.Namespace) -> dict[str, Any]:
    """Return the figures; they are met if the node adds at most `GOAL`, or if no change was refused."""
    resolution = options.resolution or (30 if options.what == "idle" else 64)
    values: dict[str, Any] = {"cloth.resolution": [resolution, resolution]}
    if options.what == "sets":
        with ros_context():
            return measure_sets(values, options.seconds, options.rounds)
    motions = {
        "at rest": measure_idle(values | AT_REST, options.seconds, options.settle),
        "swinging": measure_idle(values, options.seconds, options.settle),
    }
    met = all(motion["added_ms_a_frame"] <= GOAL for motion in motions.values())
    return {**motions, "goal_ms": GOAL, "met": met}
