# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Scenes and events of the examples of arms, without ROS: fold_towel, drape_towel, lift_towel."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from cloth_sim_ros.scene.parameters import parameter_file
from cloth_sim_ros.scene.robot.links import RobotLinks, add_links, read_description, with_poses, without_links
from cloth_sim_ros.scene.robot.pad_stops import PadStops
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Event, MoveObstacles

CONFIG = Path(__file__).resolve().parents[2] / "config"
#: Times of the paths at which the arms begin to move [s].
START = 1.0


def arm_scene(example: Any, config: str) -> tuple[Scene, RobotLinks, Any]:
    """Return a scene with the links at the start of an example's path, the links, and their joints over time."""
    values = parameter_file.read(CONFIG / config, strict=True)
    alone = Scene.from_parameters(without_links(values), folder=CONFIG)
    description = read_description(values["robot.description_file"], CONFIG)
    extended, files, links = add_links(alone, values, description, folder=CONFIG)
    joints = example.path(links)
    poses = links.poses(joints(START))
    return Scene.from_parameters(with_poses(extended, links, poses), files=files), links, joints


def arm_events(scene: Scene, links: RobotLinks, joints: Any) -> Iterator[list[Event]]:
    """Yield the events of each frame from `START` on, to the end of the path."""
    stops = PadStops(scene, links)
    for t in np.arange(START, joints.x[-1], scene.period):
        yield [MoveObstacles(links.names, links.poses(stops.limit_positions(joints(t))))]
