# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Log lines on the mesh files of a scene: merges, repairs, and doubts."""

from __future__ import annotations

import logging

from cloth_sim_ros.physics.model.sheets.mesh import MeshSheet
from cloth_sim_ros.scene.obstacles import solid_mesh
from cloth_sim_ros.scene.scene import Scene


def mesh_notes(scene: Scene) -> tuple[list[str], list[str]]:
    """Return two lists of log sentences on a scene's meshes: information, and warnings on repairs of the cloth."""
    notes: list[str] = []
    warnings: list[str] = []
    sheet = scene.sheet
    if isinstance(sheet, MeshSheet):
        notes += [f"mesh '{scene.cloth.mesh}': {note}" for note in sheet.notes]
        warnings += [f"mesh '{scene.cloth.mesh}': {repair}" for repair in sheet.repairs]
    for name in scene.obstacle_names:
        obstacle = scene.described[name]
        if obstacle.shape == "mesh":
            mesh = solid_mesh(scene.files[obstacle.mesh], obstacle.mesh, obstacle.scale)
            notes += [f"obstacle '{name}', mesh '{obstacle.mesh}': {note}" for note in mesh.notes]
    return notes, warnings


def silence_mesh_log() -> None:
    """Add a null handler to the mesh reader's logger: no lines on stderr unless the program configures logging."""
    logging.getLogger("cloth_sim_ros.scene.mesh_file").addHandler(logging.NullHandler())
