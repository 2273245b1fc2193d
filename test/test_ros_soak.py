# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A soak: grasping all the time, with the recorder on. `make soak` runs it for an hour; the tests for a few seconds."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from ros_client import Client, pose, positions, start_cloth
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Bool

psutil = pytest.importorskip("psutil")

SECONDS = float(os.environ.get("CLOTH_SIM_ROS_SOAK_SECONDS", "3600"))
#: Memory may grow by this between the first tenth and the end [bytes]: caches fill, the recorder's queue breathes.
GROWTH = 32 << 20


@pytest.mark.parametrize(
    "seconds", [8.0, pytest.param(SECONDS, marks=[pytest.mark.soak, pytest.mark.timeout(0)], id="long")]
)
def test_soak(ros_domain: int, start_process: Callable[..., Any], tmp_path: Path, seconds: float) -> None:
    process = start_cloth(start_process, "record.enabled:=true", f"record.folder:={tmp_path}")
    node = psutil.Process(process.pid)
    samples, values, newest = [], {}, []
    with Client() as client:
        client.node.create_subscription(PointCloud2, "/cloth_sim/points", lambda cloud: newest.append(cloud), 10)
        client.node.create_subscription(
            DiagnosticArray,
            "/diagnostics",
            lambda message: values.update({entry.key: entry.value for entry in message.status[0].values}),
            10,
        )
        target = client.publisher(PoseStamped, "/cloth_sim/gripper/target")
        grasp = client.publisher(Bool, "/cloth_sim/gripper/grasp")
        begun = time.monotonic()
        next_sample = 0.0
        while (elapsed := time.monotonic() - begun) < seconds:
            # A circle through the corner once in two seconds, closed for the first half of each.
            angle = np.pi * elapsed
            target.publish(pose(0.5 - 0.3 * (1.0 - np.cos(angle)), -0.3 * np.sin(angle), 0.5))
            grasp.publish(Bool(data=elapsed % 2.0 < 1.0))
            client.executor.spin_once(timeout_sec=0.01)
            del newest[:-1]
            if elapsed >= next_sample:
                samples.append((node.memory_info().rss, node.num_fds(), node.num_threads()))
                next_sample += max(seconds / 100.0, 0.2)
        assert np.isfinite(positions(newest[-1])).all()
        client.spin_until(lambda: values, what="diagnostics")
    assert process.interrupt() == 0
    assert "Traceback" not in process.output
    settled = samples[len(samples) // 10 :]
    memory, descriptors, threads = (np.array(column) for column in zip(*settled, strict=True))
    print(
        f"\n{seconds:.0f} s: memory {memory[0] >> 20} to {memory[-1] >> 20} MiB, descriptors {descriptors.min()} to "
        f"{descriptors.max()}, threads {threads.min()} to {threads.max()}, "
        f"{values['late_frames']} late of {values['frame']} frames"
    )
    assert memory[-1] - memory[0] < GROWTH
    assert descriptors[-1] <= descriptors[0] + 2
    assert threads[-1] <= threads[0] + 1
