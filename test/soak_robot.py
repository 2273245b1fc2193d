# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Random motions of an arm around a sheet: `python test/soak_robot.py [--motions 10000] [--seconds 0] [--first-run 0]`.

Each joint moves to a random position at 2 rad/s at most. At the end of every frame numpy's distances of the particles,
and of points within every triangle, must be outside all links. Anchored particles and their triangles are left out,
because nothing pushes them. A cylinder may be entered by a twentieth of the contact
thickness, because its features are those of an inscribed prism. Exit status 1 after an intersection; run and motion
reproduce it. A run has 20 motions; `--first-run` continues an earlier command.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Sequence
from typing import Any

import attrs
import numpy as np
from support.robots import ARM, robot_scene
from tqdm import tqdm

from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.scene.robot.links import RobotLinks
from cloth_sim_ros.simulation.bodies.obstacles import gaps
from cloth_sim_ros.simulation.events import MoveObstacles
from cloth_sim_ros.simulation.simulation import Simulation

#: Frames a second: at 2 rad/s no link moves further in a frame than it is thick.
RATE = 120.0
#: Speed of joints [rad/s, m/s], and the ends of their ranges.
SPEEDS = np.array([2.0, 2.0, 2.0, 0.2])
LOW, HIGH = np.array([-2.0, -2.8, -3.1, 0.0]), np.array([2.0, 2.8, 3.1, 0.04])
#: Motions of one simulation, and weights of the points that are checked in each triangle.
MOTIONS = 20
WEIGHTS = np.array([[a, b, 4 - a - b] for a in range(5) for b in range(5 - a)]) / 4.0
#: Positions of the sheet's anchors.
ANCHORS = (["top"], ["top_left", "top_right"], ["top", "bottom"], ["left", "bottom_right"])


@attrs.define
class Totals:
    """Totals of all runs."""

    motions: int = 0
    frames: int = 0
    in_contact: int = 0
    stopped: int = 0
    flagged: int = 0
    min_gap: float = math.inf
    n_penetrating: int = 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit status."""
    parser = argparse.ArgumentParser(description="Check that a cloth does not pass through the links of an arm.")
    parser.add_argument("--motions", type=int, default=10_000, help="number of motions (%(default)s)")
    parser.add_argument("--seconds", type=float, default=0.0, help="wall time after which it ends; 0: none")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--first-run", type=int, default=0, help="number of the first run (%(default)s)")
    options = parser.parse_args(arguments)
    totals, end = Totals(), time.monotonic() + (options.seconds or math.inf)
    with tqdm(total=options.motions, unit="motion", disable=None) as bar:
        run = options.first_run
        while totals.motions < options.motions and time.monotonic() < end:
            _run(
                run, np.random.default_rng((options.seed, run)), totals, min(MOTIONS, options.motions - totals.motions)
            )
            bar.update(MOTIONS)
            run += 1
    print(
        f"runs {options.first_run} to {run - 1}: {totals.motions} motions, {totals.frames} frames: {totals.in_contact} "
        f"with contact, {totals.stopped} in which links stopped, {totals.flagged} flagged; smallest gap "
        f"{1e3 * totals.min_gap:.3g} mm; {totals.n_penetrating} in which a link is in the cloth"
    )
    return 1 if totals.n_penetrating else 0


def start(rng: np.random.Generator) -> tuple[Simulation, RobotLinks]:
    """Return a sheet beside the upright arm, and its links."""
    values: dict[str, Any] = {
        "rate": RATE,
        "cloth.size": [0.7, 0.7],
        "cloth.resolution": [13, 13],
        "cloth.anchors": ANCHORS[rng.integers(len(ANCHORS))],
        "cloth.position": [0.0, 0.0, 0.6],
        "robot.position": [float(rng.uniform(-0.3, 0.3)), float(rng.choice((-1.0, 1.0)) * rng.uniform(0.2, 0.5)), 0.2],
        "robot.orientation": [0.0, 0.0, float(rng.uniform(-1.0, 1.0)), 0.5],
        "robot.friction": [float(rng.choice((0.0, 0.4)))],
        "contact.thickness": 0.004,
    }
    scene, links = robot_scene(ARM, values)
    return Simulation(scene), links


def min_gap(simulation: Simulation) -> float:
    """Return the smallest gap of points of the cloth to the links [m], negative inside."""
    assert simulation.obstacles is not None
    x, anchored = simulation.positions, simulation.scene.anchored_particles()
    triangles = simulation.scene.sheet.triangles()
    corners = x[triangles[~np.isin(triangles, anchored).any(axis=1)]]
    points = np.concatenate([np.delete(x, anchored, axis=0), np.einsum("wc,tcd->twd", WEIGHTS, corners).reshape(-1, 3)])
    thickness = simulation.scene.contact.thickness
    smallest = math.inf
    for solid, pose in zip(simulation.obstacles.solids, simulation.obstacles.poses(), strict=True):
        inset = 0.05 * thickness if solid.shape == "cylinder" else 0.0
        smallest = min(smallest, float(gaps(solid, pose, points.T, max_distance=thickness).min()) + inset)
    return smallest


def _run(run: int, rng: np.random.Generator, totals: Totals, motions: int) -> None:
    simulation, links = start(rng)
    positions: Array = np.array([0.0, 0.0, 0.0, 0.02])
    for motion in range(motions):
        target = rng.uniform(LOW, HIGH)
        n_frames = math.ceil(float((np.abs(target - positions) / SPEEDS).max()) * RATE)
        begin = positions
        for k in range(min(n_frames, round(0.5 * RATE))):
            positions = begin + (k + 1) / n_frames * (target - begin)
            frame = simulation.advance([MoveObstacles(links.names, links.poses(positions))])
            gap = min_gap(simulation)
            totals.frames += 1
            totals.in_contact += gap < simulation.scene.contact.thickness
            totals.stopped += bool(frame.stopped)
            totals.flagged += bool(frame.advance and frame.advance.flagged)
            totals.min_gap = min(totals.min_gap, gap)
            if not gap > 0.0:
                totals.n_penetrating += 1
                print(f"run {run}, motion {motion}: a link is {-1e3 * gap:.3g} mm in the cloth", file=sys.stderr)
        totals.motions += 1


if __name__ == "__main__":
    sys.exit(main())
