# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Start-up time of a live cloth, from process start to the first received cloud.

`python -m benchmarks ros-start` starts `cloth_sim` several times, each time in a new namespace. The first start reads
the libraries from disk and is reported separately; the others find them in memory. The processor time of the process
is reported beside the wall time, which exceeds it on a busy machine. `answers_after_s` is the time from the node's name
in the graph to its answer to a parameter request.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence
from typing import Any

import attrs
import numpy as np
from rcl_interfaces.srv import GetParameters
from rclpy.qos import QoSProfile
from rclpy.task import Future
from sensor_msgs.msg import PointCloud2

from benchmarks.ros.node_process import node_process, ros_context
from benchmarks.ros.probe import Probe
from validation.command import at_least

#: Time after which an unanswered request is repeated [s].
_RETRY_PERIOD = 1.0
#: Largest start-up time with the libraries in memory [s].
GOAL = 2.0


@attrs.frozen(kw_only=True)
class Start:
    """Times of one start."""

    #: Wall time and processor time of the process from its start to the first cloud [s].
    wall: float
    busy: float
    #: Time from the name in the graph to the first answer [s].
    answers_after: float


def measure_start(index: int, arguments: Sequence[str] = ()) -> Start:
    """Start a cloth, wait for its first cloud and first answer, and stop it; return the times.

    Args:
        index: number in its namespace.
        arguments: further ROS arguments, e.g. ``-p cloth.resolution:=[64,64]``.

    Raises:
        RuntimeError: if it ends, or sends no cloud or answer.
    """
    namespace = f"start_{os.getpid()}_{index}"
    arrivals: list[float] = []
    pending: list[Future] = []
    #: Times at which the name was in the graph, and of the first answer [s].
    moments: dict[str, float] = {}
    begun = next_request = time.monotonic()
    with (
        node_process(["-r", f"__ns:=/{namespace}", *arguments]) as process,
        Probe("start_probe", process, namespace=namespace) as probe,
    ):
        node, quality = probe.node, QoSProfile(depth=10)
        node.create_subscription(
            PointCloud2, "cloth_sim/points", lambda _: arrivals.append(time.monotonic()), quality, raw=True
        )
        question = node.create_client(GetParameters, "cloth_sim/get_parameters")

        def is_answered() -> bool:
            nonlocal next_request
            now = time.monotonic()
            if "seen" not in moments and ("cloth_sim", f"/{namespace}") in node.get_node_names_and_namespaces():
                moments["seen"] = now
            # An answer sent before the node has discovered this client is lost, so the request is repeated.
            if now > next_request and question.service_is_ready():
                pending.append(question.call_async(GetParameters.Request(names=["rate"])))
                next_request = now + _RETRY_PERIOD
            if any(future.done() for future in pending):
                moments["answered"] = now
            return "answered" in moments

        probe.spin_until(is_answered)
        probe.spin_until(lambda: arrivals)
        busy = process.processor_time()
    # A node that answers is in the graph, even if its name is announced after its services.
    answered = moments["answered"]
    seen = min(moments.get("seen", answered), answered)
    return Start(wall=arrivals[0] - begun, busy=busy, answers_after=answered - seen)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--starts", type=at_least(1), default=5, help="starts with the libraries in memory")
    parser.add_argument("--ros", nargs=argparse.REMAINDER, default=[], help="further ROS arguments of the cloth")


def figures(options: argparse.Namespace) -> dict[str, Any]:
    """Return the times; they are met if the median of the warm starts is below the goal."""
    with ros_context():
        first, *warm = (measure_start(index, options.ros) for index in range(options.starts + 1))
    median = float(np.median([start.wall for start in warm]))
    return {
        "first_s": round(first.wall, 3),
        "warm_s": [round(start.wall, 3) for start in warm],
        "warm_median_s": round(median, 3),
        "warm_processor_median_s": round(float(np.median([start.busy for start in warm])), 3),
        "answers_after_s": [round(start.answers_after, 3) for start in (first, *warm)],
        "goal_s": GOAL,
        "met": median < GOAL,
    }
