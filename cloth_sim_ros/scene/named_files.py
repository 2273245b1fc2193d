# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Paths of the files that a scene file names, which no output may replace."""

from __future__ import annotations

from pathlib import Path

from cloth_sim_ros.scene import files as scene_files
from cloth_sim_ros.scene.parameters import parameter_file


def named_files(scene_file: str | Path, *, node: str = "cloth_sim") -> list[Path]:
    """Return the paths of the files that a scene file (ROS parameters) names: meshes, fabrics, states, descriptions.

    Args:
        scene_file: path of the scene file; names in it are relative to its folder.
        node: name of the node.

    Raises:
        ParameterError: for a scene file or a robot's description that can't be read.
    """
    folder = Path(scene_file).parent
    values = parameter_file.read(scene_file, node=node, strict=True)
    paths = [folder / name for _, name in scene_files.named(values)]
    description = values.get("robot.description_file")
    if values.get("robot.enabled") is True and isinstance(description, str) and description:
        from cloth_sim_ros.scene.robot.links import mesh_files

        paths += [folder / description, *mesh_files(description, folder)]
    return paths
