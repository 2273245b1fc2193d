# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Command line of the benchmarks."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from validation.command import run_command

#: Names: the module of each benchmark, and a line about it.
COMMANDS = {
    "speed": ("benchmarks.speed.overview", "ns per spring against C, simulated seconds per wall second, two threads"),
    "real-time": ("benchmarks.speed.real_time", "real-time factor by particles, stiffness, tolerance, integrator"),
    "feature-cost": ("benchmarks.speed.feature_cost", "cost of a feature absent, idle and active, and of several"),
    "scale": ("benchmarks.scale.sheet", "time per particle and step, and memory, from 10^3 to 10^6 particles"),
    "peers": ("benchmarks.peers.throughput", "other engines on the same sheet, in an environment of their own"),
    "peers-contact": ("benchmarks.peers.contact", "other engines on a drape, a fold and a pinch; depth and creep"),
    "contact": ("benchmarks.contact.contact", "friction over a drum, impacts, drift, and the cost of contact"),
    "robot-links": ("benchmarks.contact.robot_links", "cost of a robot's links far from the cloth and near it"),
    "batch": ("benchmarks.batch.throughput", "many cloths in one process: speed, threads, memory, rollouts, a soak"),
    "studies": ("benchmarks.batch.studies", "cloth_batch beside plain simulations, and Dask's cost per task"),
    "ros-camera": ("benchmarks.ros.camera", "processor time of a depth camera's image and messages"),
    "ros-latency": ("benchmarks.ros.latency", "time from a target to the cloud that shows it"),
    "ros-node": ("benchmarks.ros.node", "processor time that the node adds to a frame"),
    "ros-start": ("benchmarks.ros.start", "time from the start of the node to its first cloud"),
    "ros-viewer": ("benchmarks.ros.viewer", "time from the start of the viewer to its first surface; size of a frame"),
    "ros-stream": ("benchmarks.ros.stream", "clouds lost or left out between node and subscriber"),
    "recording": ("benchmarks.ros.recording", "size and work of recording, measured on the clouds of a session"),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    return run_command("benchmarks", "Measures cloth_sim_ros.", COMMANDS, arguments)


if __name__ == "__main__":
    sys.exit(main())
