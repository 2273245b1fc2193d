# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sessions with self-friction between layers rerun to the same bits."""

from __future__ import annotations

from pathlib import Path

from support.garment import as_obj
from support.self_scenes import folded
from support.session_maker import SessionMaker

from cloth_sim_ros.physics.model.sheets.grid import grid_triangles
from cloth_sim_ros.physics.state.controller_state import ANCHORS_KEY
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.verify.run import verify


def test_session_with_layer_friction_reruns_to_same_bits(tmp_path: Path) -> None:
    _, places, _ = folded(8, radius=0.012)
    mesh = tmp_path / "fold.obj"
    mesh.write_bytes(as_obj(places, grid_triangles(8, 8, "alternating")))
    values = {
        "cloth.mesh": str(mesh),
        "cloth.anchors": [""],
        "cloth.position": [0.0, 0.0, 0.0],
        "cloth.orientation": [0.0, 0.0, 0.0, 1.0],
        "bending.model": "none",
        "grippers": [""],
        "tolerance": 1e-3,
        "gravity": [3.0, 0.0, -9.81],
        "contact.self": True,
        "contact.thickness": 0.004,
        "contact.friction": [0.5, 0.4],
        "obstacles": ["floor"],
        "floor.shape": "plane",
        "floor.position": [0.0, 0.0, -0.016],
        "floor.friction": [0.2],
    }
    folder = tmp_path / "session"
    folder.mkdir()
    maker = SessionMaker(folder, Scene.from_parameters(values))
    for _ in range(15):
        maker.add([])
    maker.finish()
    assert (maker.simulation.state.memory[ANCHORS_KEY][-2:, 3] > 0.0).sum() > 5
    verdict = verify(sorted(folder.glob("*.mcap")))
    assert verdict.same, verdict.first_reason
    assert verdict.frames == 15
