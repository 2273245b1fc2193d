# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Log lines on the mesh files of a scene: merges, repairs, and doubts."""

from __future__ import annotations

import logging

from cloth_sim_ros.physics.model.sheets.mesh import MeshSheet
from cloth_sim_ros.scene.obstacles import solid_mesh
from cloth_sim_ros.scene.scene import Scene


def mesh_notes(scene: Scene) -> tuple[list[str], list[str]]:
    """Return sentences to log as information and as warnings on each mesh of a scene."""
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
    """Silence the mesh reader's own log lines, unless the program configures logging."""
    logging.getLogger("cloth_sim_ros.scene.mesh_file").addHandler(logging.NullHandler())
