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
import sys
import time
from collections.abc import Iterator, Sequence
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from benchmarks.ros.node_process import node_process, processor_time, ros_context
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.simulation import Simulation

#: Largest added time per frame [ms].
GOAL = 0.3
#: Without gravity a hung cloth is at rest from the start, and asleep after a second.
AT_REST = {"gravity": [0.0, 0.0, 0.0]}
#: Longest wait for a start or an answer [s].
_PATIENCE = 60.0
#: Largest number of pending requests.
_MAX_PENDING = 8
#: Parameter changes per minute.
RATE = 1000.0


@contextlib.contextmanager
def cloth(name: str, values: dict[str, Any]) -> Iterator[int]:
    """Run a node in its own process; yield its process id once it is running.

    Raises:
        RuntimeError: if it ends before that.
    """
    parameters = [f"{key}:={json.dumps(value)}" for key, value in values.items()]
    with node_process(["-r", f"__node:={name}"], parameters) as process:
        assert process.stderr is not None
        for line in process.stderr:
            if "grippers:" in line:
                break
        else:
            raise RuntimeError(f"the cloth ended with status {process.wait()}")
        yield process.pid


def measure_idle(values: dict[str, Any], seconds: float, settle: float) -> dict[str, float]:
    """Return ms per frame of an idle node and of a bare simulation, and the share of a core."""
    scene = Scene.from_parameters(values)
    with cloth(f"idle_{os.getpid()}", values) as pid:
        time.sleep(settle)
        before, begun = processor_time(pid), time.monotonic()
        time.sleep(seconds)
        busy, elapsed = processor_time(pid) - before, time.monotonic() - begun
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


class ParameterSetter:
    """Sets parameters of a node, and counts its late frames.

    Args:
        target: full name of the node.
    """

    def __init__(self, target: str) -> None:
        self._node = Node(f"setter_{os.getpid()}")
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._status: dict[str, str] = {}
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._take, 10)
        self._client = self._node.create_client(SetParameters, f"{target}/set_parameters")
        self.refused = 0

    def run_interval(self, seconds: float, rate: float) -> tuple[int, int]:
        """Change parameters at a rate [1/s] for some time [s]; return the number of changes and of late frames."""
        self._next_report()
        late, sent = int(self._status["late_frames"]), 0
        begun = time.monotonic()
        waiting: list[Any] = []
        while (elapsed := time.monotonic() - begun) < seconds:
            # A service queues ten requests; more would be lost on a busy machine.
            while sent < elapsed * rate and len(waiting) < _MAX_PENDING:
                waiting.append(self._client.call_async(SetParameters.Request(parameters=[_change(sent)])))
                sent += 1
            self._executor.spin_once(timeout_sec=0.005)
            waiting = self._count(waiting)
        while waiting:
            self._wait(lambda waiting=waiting: any(future.done() for future in waiting))
            waiting = self._count(waiting)
        self._next_report()
        return sent, int(self._status["late_frames"]) - late

    def _count(self, waiting: list[Any]) -> list[Any]:
        """Count refused changes; return the pending requests."""
        done = [future.result() for future in waiting if future.done()]
        self.refused += sum(not result.successful for answer in done for result in answer.results)
        return [future for future in waiting if not future.done()]

    def wait(self) -> None:
        """Wait until the node answers."""
        self._wait(self._client.service_is_ready)

    def close(self) -> None:
        """Destroy the requesting node."""
        self._executor.shutdown()
        self._node.destroy_node()

    def _next_report(self) -> None:
        self._status = {}
        self._wait(lambda: self._status)

    def _take(self, message: DiagnosticArray) -> None:
        self._status = {entry.key: entry.value for entry in message.status[0].values}

    def _wait(self, condition: Any) -> None:
        end = time.monotonic() + _PATIENCE
        while not condition():
            if time.monotonic() > end:
                raise RuntimeError(f"the cloth did not answer within {_PATIENCE:g} s")
            self._executor.spin_once(timeout_sec=0.02)


def _change(index: int) -> Parameter:
    """Return the change of an index: small changes of each kind in turn."""
    kind, size = index % 4, 0.01 * (index % 7)
    if kind == 0:
        return _parameter("gravity", [0.0, 0.0, -9.81 + size])
    if kind == 1:
        return _parameter("wind.velocity", [0.1 + size, 0.0, 0.0])
    return _parameter("air.drag", 0.2 + size) if kind == 2 else _parameter("material.damping", 0.1 + 0.1 * size)


def _parameter(name: str, value: Any) -> Parameter:
    if isinstance(value, list):
        held = ParameterValue(type=ParameterType.PARAMETER_DOUBLE_ARRAY, double_array_value=value)
    else:
        held = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=value)
    return Parameter(name=name, value=held)


def measure_sets(values: dict[str, Any], seconds: float, rounds: int) -> dict[str, Any]:
    """Return late frames of intervals with parameter changes, and of as many without."""
    name = f"sets_{os.getpid()}"
    late: dict[str, list[int]] = {"with": [], "without": []}
    sent = 0
    with cloth(name, values):
        setter = ParameterSetter(f"/{name}")
        try:
            setter.wait()
            for _ in range(rounds):
                late["without"].append(setter.run_interval(seconds, 0.0)[1])
                count, late_count = setter.run_interval(seconds, RATE / 60.0)
                sent += count
                late["with"].append(late_count)
        finally:
            setter.close()
    return {"set": sent, "refused": setter.refused, "seconds_each": seconds, "late_frames": late}


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the figures as JSON.

    Returns:
        Exit status: 1 if the node adds more than `GOAL` or a change was refused, else 0.
    """
    parser = argparse.ArgumentParser(prog="python -m benchmarks ros-node", description=__doc__)
    parser.add_argument("what", choices=("idle", "sets"))
    parser.add_argument("--seconds", type=float, default=20.0, help="of each interval (default: %(default)s)")
    parser.add_argument("--settle", type=float, default=4.0, help="of idle: time before (default: %(default)s)")
    parser.add_argument("--rounds", type=int, default=3, help="of sets: pairs of intervals (default: %(default)s)")
    sides = "particles a side (default: 30 for idle, 64 for sets)"
    parser.add_argument("--resolution", type=int, default=0, help=sides)
    options = parser.parse_args(arguments)
    if options.seconds <= 0.0 or options.rounds < 1:
        parser.error("--seconds must be above 0, --rounds at least 1")
    resolution = options.resolution or (30 if options.what == "idle" else 64)
    values: dict[str, Any] = {"cloth.resolution": [resolution, resolution]}
    if options.what == "idle":
        figures: dict[str, Any] = {
            "at rest": measure_idle(values | AT_REST, options.seconds, options.settle),
            "swinging": measure_idle(values, options.seconds, options.settle),
            "goal_ms": GOAL,
        }
        figures["met"] = all(figures[how]["added_ms_a_frame"] <= GOAL for how in ("at rest", "swinging"))
    else:
        with ros_context():
            figures = measure_sets(values, options.seconds, options.rounds)
        figures["met"] = not figures["refused"]
    sys.stdout.write(json.dumps(figures, indent=1) + "\n")
    return 0 if figures["met"] else 1


if __name__ == "__main__":
    sys.exit(main())
