# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Measurements of the node: they run."""

import json
import subprocess
import sys
from argparse import Namespace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy")
import rclpy

from benchmarks.ros import latency
from benchmarks.ros.stream import stream_figures

ROOT = Path(__file__).resolve().parents[2]


def run_measurement(name, *arguments):
    """Run a measurement; return its output. Figures and status depend on the machine."""
    command = [sys.executable, "-m", "benchmarks", name, *arguments]
    done = subprocess.run(command, cwd=ROOT, check=False, capture_output=True, text=True, timeout=300)
    assert done.returncode in (0, 1) and done.stdout, done.stderr
    return json.loads(done.stdout)


def test_start_time_ends_at_the_first_cloud():
    figures = run_measurement("ros-start", "--starts", "1", "--ros", "-p", "cloth.resolution:=[5, 5]")
    assert len(figures["warm_s"]) == 1
    assert 0.0 < figures["warm_processor_median_s"] < figures["warm_s"][0] * 4.0
    assert figures["met"] == (figures["warm_median_s"] < figures["goal_s"])


def test_viewer_figures_are_of_its_surface():
    pytest.importorskip("rerun")
    figures = run_measurement("ros-viewer", "--starts", "1", "--ros", "-p", "cloth.resolution:=[5, 4]")
    assert len(figures["first_surface_s"]) == 1
    assert figures["met"] == (figures["first_surface_median_s"] < figures["goal_s"])
    # Position, normal and colour of each particle, and 12 bytes for each triangle.
    assert 20 * 28 <= figures["frame_bytes"] < 20 * 28 + 200
    assert 24 * 12 <= figures["triangle_bytes_once"] < 24 * 12 + 200


def test_idle_node_reports_its_added_frame_time():
    figures = run_measurement("ros-node", "--seconds", "0.5", "--settle", "0.2", "--resolution", "5")
    for how in ("at rest", "swinging"):
        row = figures[how]
        assert row["added_ms_a_frame"] == pytest.approx(row["node_ms_a_frame"] - row["simulation_ms_a_frame"], abs=1e-3)
    assert figures["met"] == all(
        figures[how]["added_ms_a_frame"] <= figures["goal_ms"] for how in ("at rest", "swinging")
    )


def stream(**values):
    """Return the figures of a stream of ten clouds in one second, each 10 ms late."""
    due_times = np.arange(10) / 10.0
    return stream_figures(
        **{"rate": 10.0, "sent": 10, "received": 10, "stamps": due_times, "arrivals": due_times + 0.01} | values
    )


def test_stream_counts_lost_and_missing_clouds():
    assert stream()["met"]
    assert stream()["received_hz"] == pytest.approx(10.0)
    incomplete = stream(received=9)
    assert (incomplete["lost"], incomplete["met"]) == (1, False)
    times = np.arange(10)[[0, 1, 2, 3, 4, 7, 8, 9]] / 10.0
    late = stream(stamps=times, arrivals=times + 0.01)
    assert (late["left_out"], late["met"]) == (2, False)
    assert late["spacing_max_ms"] == pytest.approx(300.0)
    assert not stream(sent=0, received=0)["met"]


@pytest.mark.parametrize("moving", [False, True], ids=["at rest", "moving"])
def test_stream_counts_sent_and_received_clouds(moving):
    (figures,) = run_measurement(
        "ros-stream", "--resolutions", "5", "--seconds", "0.5", "--rate", "30", *["--moving"] * moving
    )
    assert (figures["points"], figures["asleep"]) == (25, not moving)
    assert 0 < figures["sent"] == figures["received"]
    assert figures["met"] == (figures["left_out"] == 0)


@pytest.mark.parametrize("joint_states", [False, True], ids=["targets", "joint states"])
def test_latencies_are_measured(ros_domain: int, joint_states: bool) -> None:
    # The values depend on the load of the machine and are not checked.
    options = Namespace(resolution=(8, 8), rate=60.0, stream=100.0, seconds=0.5, parameters=[])
    options.joint_states = joint_states
    rclpy.init(args=[])
    try:
        latencies, figures = latency.measure(options)
    finally:
        rclpy.try_shutdown()
    assert figures["particles"] == 64
    assert figures["targets"] == len(latencies) > 10
    assert (latencies > 0.0).all()
    assert figures["integrator_reason"]
    common = {"particles": 64, "rate": 60.0, "diagnostics": {}, "joint_states": joint_states}
    assert latency.latency_figures(np.full(9, 0.001), **common)["met"]
    assert not latency.latency_figures(np.full(9, 0.027 if joint_states else 0.019), **common)["met"]
