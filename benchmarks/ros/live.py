# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Late frames of a live cloth that is carried, swung, released and reset.

`python -m benchmarks ros-live` starts a recording node of the default cloth with a subscriber and repeats a cycle for
five minutes. A gripper grasps the lower corner and carries it in a circle. The upper edge is released and the sheet
swings from that corner. The gripper opens and the sheet falls. The cloth is reset and rests flat. The node counts late
frames; the subscriber counts due times without a cloud and the times between arrivals.
"""

from __future__ import annotations

import argparse
import itertools
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import SetBool, Trigger

from benchmarks.ros.latency import recording_parameters
from benchmarks.ros.node_process import PATIENCE, NodeProcess, node_process, ros_context
from benchmarks.ros.probe import CORNER, GripperProbe, stamp_ns
from validation.command import above

#: Time between two targets [s].
_BETWEEN = 0.01
#: Longer frames are counted [ms]; length of the separate first part [s].
_LONG, _FIRST = 50.0, 60.0


@attrs.frozen(kw_only=True)
class Cycle:
    """Durations of the parts of a cycle [s]."""

    carried: float = 6.0
    swung: float = 8.0
    falling: float = 1.0
    flat: float = 5.0

    def scaled(self, factor: float) -> Cycle:
        """Return the cycle with all durations scaled."""
        return Cycle(**{name: factor * seconds for name, seconds in attrs.asdict(self).items()})


class Robot(GripperProbe):
    """Probe that manipulates the cloth like a robot and records clouds and diagnostics.

    Args:
        measured: the node.
    """

    def __init__(self, measured: NodeProcess) -> None:
        super().__init__("live_probe", measured)
        self._reset = self.node.create_client(Trigger, "/cloth_sim/reset")
        self._set = self.node.create_client(SetParameters, "/cloth_sim/set_parameters")
        #: Stamps and arrival times of clouds [s].
        self.stamps: list[float] = []
        self.arrivals: list[float] = []
        #: Arrival time [s] and values of each diagnostics message.
        self.reports: list[tuple[float, dict[str, str]]] = []
        #: Start time [s] and name of each part of a cycle.
        self.parts: list[tuple[float, str]] = []
        #: Target position of the gripper [m] by time [s].
        self._path: Callable[[float], np.ndarray] = lambda _: CORNER

    def begin(self) -> None:
        """Wait for the node and its first count of late frames."""
        for client in (self._close, self._reset, self._set):
            self.spin_until(client.service_is_ready)
        self.spin_until(lambda: len(self.reports) > 1 and self.arrivals)

    def run_cycle(self, cycle: Cycle) -> None:
        """Run one cycle."""
        self._begin("carried")
        self._lead(lambda _: CORNER, 0.25)
        self.request(self._close, SetBool.Request(data=True))
        angular_frequency = 2.0 * np.pi / cycle.carried

        def carried(t: float) -> np.ndarray:
            angle = angular_frequency * t
            return CORNER + np.array([0.0, -0.25 * np.sin(angle), 0.2 * (1.0 - np.cos(angle))])

        self._lead(carried, cycle.carried)
        self._begin("swung")
        self._anchor([""])

        # Half a metre to and fro, a little up and down, starting from rest.
        def swung(t: float) -> np.ndarray:
            away = 0.25 * min(1.0, t / (0.25 * cycle.swung)) * np.sin(2.0 * np.pi * t / 1.6)
            return CORNER + np.array([-0.6 * away, away, 0.1 * (1.0 - np.cos(2.0 * np.pi * t / 3.2))])

        self._lead(swung, cycle.swung)
        self._begin("let go")
        self.request(self._close, SetBool.Request(data=False))
        self._lead(lambda _: CORNER, cycle.falling)
        self._begin("flat again")
        self._anchor(["top"])
        self.request(self._reset, Trigger.Request())
        self._lead(lambda _: CORNER, cycle.flat)

    def _begin(self, part: str) -> None:
        self.parts.append((time.monotonic(), part))

    def _lead(self, path: Callable[[float], np.ndarray], seconds: float) -> None:
        begun = time.monotonic()
        self._path = lambda now: path(now - begun)
        self.spin_until(lambda: time.monotonic() - begun >= seconds, limit=seconds + PATIENCE)
        end = path(seconds)
        self._path = lambda _: end

    def _anchor(self, names: list[str]) -> None:
        value = Parameter("cloth.anchors", Parameter.Type.STRING_ARRAY, names).to_parameter_msg()
        (answer,) = self.request(self._set, SetParameters.Request(parameters=[value])).results
        if not answer.successful:
            raise RuntimeError(f"cloth.anchors {names} was refused: {answer.reason}")

    def on_cloud(self, cloud: PointCloud2) -> None:
        self.arrivals.append(time.monotonic())
        self.stamps.append(1e-9 * stamp_ns(cloud))

    def on_diagnostics(self, values: dict[str, str]) -> None:
        self.reports.append((time.monotonic(), values))

    def target_position(self, now: float) -> np.ndarray:
        return self._path(now)

    def pause(self) -> float:
        return _BETWEEN


def summary(robot: Robot, *, rate: float, cycles: int) -> dict[str, Any]:
    """Return the figures of the run."""
    stamps, arrivals = np.array(robot.stamps), np.array(robot.arrivals)
    first, last = robot.reports[0][1], robot.reports[-1][1]
    begun = robot.reports[0][0]
    longest = [(when - begun, float(report["longest_frame_ms"])) for when, report in robot.reports]
    between = np.diff(arrivals)
    late = int(last["late_frames"]) - int(first["late_frames"])
    by_part = dict.fromkeys((name for _, name in robot.parts), 0)
    # A report covers the second before it; it counts for the part with the larger share of it.
    for (_, before), (when, report) in itertools.pairwise(robot.reports):
        part = max((begun for begun in robot.parts if begun[0] <= when - 0.5), default=robot.parts[0])[1]
        by_part[part] += int(report["late_frames"]) - int(before["late_frames"])
    return {
        "seconds": round(robot.reports[-1][0] - begun, 1),
        "cycles": cycles,
        "frames": int(last["frame"]) - int(first["frame"]),
        "late_frames": late,
        "late_frames_by_part": by_part,
        "due_times_without_a_cloud": int((np.rint(np.diff(stamps) * rate) - 1.0).clip(0.0).sum()),
        "longest_between_clouds_ms": round(1e3 * float(between.max()), 1),
        "longest_frame_ms": max(ms for _, ms in longest),
        "longest_frame_of_the_first_minute_ms": max(ms for when, ms in longest if when <= _FIRST),
        f"reports_with_a_frame_above_{_LONG:g}_ms": sum(ms > _LONG for _, ms in longest),
        "real_time_factor": last["real_time_factor_overall"],
        "load": round(os.getloadavg()[0], 2),
        "met": late == 0,
    }


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--seconds", type=above(0.0), default=300.0, help="time in which cycles start")
    parser.add_argument("--pace", type=above(0.0), default=1.0, help="length of a cycle, in 20 s")
    parser.add_argument("parameters", nargs="*", metavar="name:=value", help="further parameters of the node")


def figures(options: argparse.Namespace) -> dict[str, Any]:
    """Return the figures of some cycles; they are met if no frame was late."""
    rate, cycles = 60.0, 0
    with ros_context(), tempfile.TemporaryDirectory() as folder:
        parameters = recording_parameters(resolution=(30, 30), rate=rate, folder=Path(folder))
        # 2 cm of a sheet with a spacing of 3.4 cm.
        parameters += ["gripper.radius:=0.02", *options.parameters]
        with node_process([], parameters) as node, Robot(node) as robot:
            robot.begin()
            end = time.monotonic() + options.seconds
            while time.monotonic() < end:
                robot.run_cycle(Cycle().scaled(options.pace))
                cycles += 1
    return summary(robot, rate=rate, cycles=cycles)
