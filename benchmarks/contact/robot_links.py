# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Cost of a robot's links beside the default cloth: processor time of a frame.

Links that move far from the cloth take turns with other scenes. Links with fine meshes then move near it and push it.
"""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from support.robots import chain, robot_scene, shell

from benchmarks.timing import time_interleaved
from cloth_sim_ros import MoveObstacles, Scene, Simulation
from cloth_sim_ros.scene.robot.links import RobotLinks
from cloth_sim_ros.simulation.events import Event
from validation.report import Report, Table

#: Joints of the chain, and shapes of each link.
_JOINTS, _SHAPES = 8, 5
#: Frames of a turn, and frames before the first one: the cloth then swings.
_FRAMES, _WARM_UP = 20, 30
#: Frames of the arm near the cloth.
_NEAR_FRAMES = 120
#: Largest share of a frame's period.
_MAX_SHARE = 0.1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--seconds", type=float, default=20.0, help="wall time of all turns [s]")


def run(options: argparse.Namespace) -> Report:
    """Time frames of the default cloth without obstacles, and beside links that stand and move."""
    report = Report("Links of a robot")
    values = {"robot.position": [4.0, 0.0, 0.0], "robot.links": [f"l{k + 1}" for k in range(_JOINTS)]}
    scene, links = robot_scene(chain(_JOINTS, _SHAPES), values)
    box = {"obstacles": ["box"], "box.shape": "box", "box.position": [4.0, 0.0, 0.0]}
    runs = {
        "no obstacle": _Run(Simulation(Scene())),
        "one box that stands": _Run(Simulation(Scene.from_parameters(box))),
        f"{len(links.names)} links that stand": _Run(Simulation(scene)),
        f"{len(links.names)} links that move": _Run(Simulation(scene), links),
    }
    times = time_interleaved(runs, seconds=options.seconds, clock=time.process_time)
    period = Scene().period
    columns = ["scene", "ms a frame", "more than without % of 1/60 s", "ratio"]
    table = report.add_table("Far links of a robot beside the default cloth", columns)
    for name in runs:
        more = (times.median(name) - times.median("no obstacle")) / _FRAMES
        ratio = times.ratio(name, "no obstacle")
        table.rows.append([name, 1e3 * times.median(name) / _FRAMES, 100.0 * more / period, ratio])
        if more > _MAX_SHARE * period:
            report.fail(f"{name}: {100.0 * more / period:.3g} % of a frame; at most {100.0 * _MAX_SHARE:g}")
    report.tables.append(_near_links())
    return report


def _near_links() -> Table:
    """Time the frames of an arm of shells of 3200 triangles, which comes to the cloth and pushes it."""
    half = math.sqrt(0.5)
    values = {"robot.position": [0.0, 0.9, 0.9], "robot.orientation": [half, 0.0, 0.0, half]}
    with TemporaryDirectory() as folder:
        Path(folder, "shell.obj").write_bytes(shell(0.05, 0.144, 50, 32))
        scene, links = robot_scene(chain(7, 1, length=0.12, mesh="shell.obj"), values, folder=folder)
    simulation, base = Simulation(scene), np.eye(4)
    times: dict[bool, list[float]] = {False: [], True: []}
    for _ in range(_NEAR_FRAMES):
        positions = np.full(len(links.joint_names), 0.3 * math.sin(2.0 * simulation.time))
        base[1, 3] = -0.05 * (1.0 - math.cos(1.5 * simulation.time))
        start = time.process_time()
        frame = simulation.advance([MoveObstacles(links.names, links.poses(positions, base))])
        times[bool(frame.obstacle_wrenches.any())].append(time.process_time() - start)
    table = Table("Links with fine meshes near the default cloth", ["frames", "count", "median ms", "largest ms"])
    for touches, seconds in times.items():
        name = "in which a link touches the cloth" if touches else "without contact"
        table.rows.append([name, len(seconds), 1e3 * float(np.median(seconds)), 1e3 * max(seconds)])
    return table


class _Run:
    """Frames of a simulation; with links, every joint swings."""

    def __init__(self, simulation: Simulation, links: RobotLinks | None = None) -> None:
        self._simulation, self._links = simulation, links
        for _ in range(_WARM_UP):
            self._advance()
        self._snapshot = simulation.snapshot()

    def __call__(self) -> None:
        # The same frames in each turn: the cloth would fall asleep.
        self._simulation.restore(self._snapshot)
        for _ in range(_FRAMES):
            self._advance()

    def _advance(self) -> None:
        events: list[Event] = []
        if self._links is not None:
            angle = 0.3 * math.sin(2.0 * self._simulation.time)
            positions = np.full(len(self._links.joint_names), angle)
            events = [MoveObstacles(self._links.names, self._links.poses(positions))]
        self._simulation.advance(events)
