# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Start-up time of a live cloth, from process start to the first received cloud.

`python -m benchmarks ros-start` starts `cloth_sim` several times, each time in a new namespace. The first start reads
the libraries from disk and is reported separately; the others find them in memory. The processor time of the process
is reported beside the wall time, which exceeds it on a busy machine.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from rclpy.qos import QoSProfile
from sensor_msgs.msg import PointCloud2

from benchmarks.ros.node_process import Probe, node_process, ros_context
from validation.command import at_least

#: Largest start-up time with the libraries in memory [s].
GOAL = 2.0


def measure_start(index: int, arguments: Sequence[str] = ()) -> tuple[float, float]:
    """Start a cloth, wait for its first cloud, and stop it; return wall time and processor time until then [s].

    Args:
        index: number in its namespace.
        arguments: further ROS arguments, e.g. ``-p cloth.resolution:=[64,64]``.

    Raises:
        RuntimeError: if it ends, or sends no cloud.
    """
    namespace = f"start_{os.getpid()}_{index}"
    arrivals: list[float] = []
    begun = time.monotonic()
    with (
        node_process(["-r", f"__ns:=/{namespace}", *arguments]) as process,
        Probe("start_probe", process, namespace=namespace) as probe,
    ):
        topic, quality = "cloth_sim/points", QoSProfile(depth=10)
        probe.node.create_subscription(
            PointCloud2, topic, lambda _: arrivals.append(time.monotonic()), quality, raw=True
        )
        probe.spin_until(lambda: arrivals)
        return arrivals[0] - begun, process.processor_time()


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--starts", type=at_least(1), default=5, help="starts with the libraries in memory")
    parser.add_argument("--ros", nargs=argparse.REMAINDER, default=[], help="further ROS arguments of the cloth")


def figures(options: argparse.Namespace) -> dict[str, Any]:
    """Return the times; they are met if the median of the warm starts is below the goal."""
    with ros_context():
        (first, _), *warm = (measure_start(index, options.ros) for index in range(options.starts + 1))
    median, busy = (float(value) for value in np.median(warm, axis=0))
    return {
        "first_s": round(first, 3),
        "warm_s": [round(wall, 3) for wall, _ in warm],
        "warm_median_s": round(median, 3),
        "warm_processor_median_s": round(busy, 3),
        "goal_s": GOAL,
        "met": median < GOAL,
    }
