# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Cost of a live node beside its simulation.

`python -m benchmarks ros-node` starts a cloth without subscriber and recorder, once at rest and once swinging. It reads
the processor time of the process. The added time per frame is that time minus the time of the same frames of a bare
simulation in this process.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from typing import Any

from benchmarks.ros.node_process import node_process
from cloth_sim_ros import Scene, Simulation
from validation.command import above

#: Largest added time per frame [ms].
GOAL = 0.3
#: Without gravity a hung cloth is at rest from the start, and asleep after a second.
AT_REST = {"gravity": [0.0, 0.0, 0.0]}


def measure_idle(values: dict[str, Any], seconds: float, settle: float) -> dict[str, float]:
    """Return ms per frame of an idle node and of a bare simulation, and the share of a core."""
    scene = Scene.from_parameters(values)
    parameters = [f"{key}:={json.dumps(value)}" for key, value in values.items()]
    with node_process(["-r", f"__node:=idle_{os.getpid()}"], parameters) as node:
        node.wait_for_output("grippers:")
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


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--seconds", type=above(0.0), default=20.0, help="of each measurement")
    parser.add_argument("--settle", type=float, default=4.0, help="time before it")
    parser.add_argument("--resolution", type=int, default=30, help="particles a side")


def figures(options: argparse.Namespace) -> dict[str, Any]:
    """Return the figures; they are met if the node adds at most `GOAL`."""
    values: dict[str, Any] = {"cloth.resolution": [options.resolution, options.resolution]}
    motions = {
        "at rest": measure_idle(values | AT_REST, options.seconds, options.settle),
        "swinging": measure_idle(values, options.seconds, options.settle),
    }
    met = all(motion["added_ms_a_frame"] <= GOAL for motion in motions.values())
    return {**motions, "goal_ms": GOAL, "met": met}
