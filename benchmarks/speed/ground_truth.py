# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Cost of ground truth and of the topics for bags, beside the cost of a plain cloud."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from benchmarks.timing import time_interleaved
from cloth_sim_ros.physics.model.sheets.normals import vertex_normals
from cloth_sim_ros.scene.coverage import Coverage
from cloth_sim_ros.scene.keypoints import KeypointPoses
from cloth_sim_ros.scene.parameters import parameter_file
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.session.messages import CloudEncoder
from cloth_sim_ros.session.snapshot_message import snapshot_bytes
from cloth_sim_ros.session.writer import SessionSnapshot
from cloth_sim_ros.simulation.environment import environment
from cloth_sim_ros.simulation.simulation import Simulation
from validation.report import Report

#: A cloth of 1 m that falls flat above a plane.
_SCENE = {
    "cloth.orientation": [0.0, 0.0, 0.0, 1.0],
    "cloth.anchors": [""],
    "keypoints": ["corners"],
    "table.shape": "plane",
    "coverage.obstacle": "table",
}
_FRAMES = 5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    sizes = [30, 64, 128, 256]
    parser.add_argument("--sizes", type=int, nargs="+", default=sizes, metavar="N", help="particles a side")
    parser.add_argument("--seconds", type=float, default=5.0, help="of timing for each size")


def run(options: argparse.Namespace) -> Report:
    """Measure each part."""
    report = Report("Cost of ground truth", "python -m benchmarks ground-truth")
    parts = ("cloud", "all fields", "normals", "keypoints", "coverage", "snapshot")
    columns = ["N", *(f"{part} ms" for part in parts), "snapshot kB"]
    table = report.add_table("Processor time of a message", columns)
    for size in options.sizes:
        scene = Scene.from_parameters({**_SCENE, "cloth.resolution": [size, size]})
        simulation = Simulation(scene)
        for _ in range(_FRAMES):
            simulation.advance()
        table.rows.append([size, *_costs(simulation, options.seconds), len(_snapshot(simulation)) / 1e3])
    report.note("parts are interleaved on one core and timed by processor time; medians")
    return report


def _costs(simulation: Simulation, seconds: float) -> list[float]:
    """Return the processor time of each part [ms]."""
    scene, state = simulation.scene, simulation.state
    rows, columns = scene.shape
    triangles = scene.sheet.triangles()
    plain = CloudEncoder(frame_id="world", height=rows, width=columns)
    rich = CloudEncoder(frame_id="world", height=rows, width=columns, velocity=True, normal=True, ids=True)
    keypoints, coverage = KeypointPoses(scene), Coverage(scene)
    normals, description = vertex_normals(state.x, triangles), scene.described["table"]
    pose = np.array([*description.position, *description.orientation])
    parts: dict[str, Callable[[], Any]] = {
        "cloud": partial(plain.encode, state.x, 0),
        "all fields": partial(rich.encode, state.x, 0, state.v, normals),
        "normals": partial(vertex_normals, state.x, triangles),
        "keypoints": partial(keypoints.compute, state.x),
        "coverage": partial(coverage.area, state.x, pose),
        "snapshot": partial(_snapshot, simulation),
    }
    times = time_interleaved(parts, seconds=seconds, clock=time.process_time)
    return [1e3 * times.median(name) for name in parts]


def _snapshot(simulation: Simulation) -> bytes:
    content = SessionSnapshot(
        scene_yaml=parameter_file.dump(simulation.scene.parameters()),
        state=simulation.state.to_bytes(),
        metadata=environment(),
    )
    return snapshot_bytes(content, session="00", sequence=0, stamp=0)
