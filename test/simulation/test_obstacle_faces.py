# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Scenes with meshes, or with obstacles smaller than a cell of the cloth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from support.session_maker import SessionMaker

from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.event_checks import EventError
from cloth_sim_ros.simulation.events import Move, SetParameters
from cloth_sim_ros.simulation.simulation import Simulation
from cloth_sim_ros.verify.run import verify

#: A coarse cloth over a ball that is smaller than its cells.
OVER: dict[str, Any] = {
    "cloth.resolution": [5, 5],
    "cloth.size": [0.5, 0.5],
    "cloth.orientation": [0.0, 0.0, 0.0, 1.0],
    "cloth.position": [0.0, 0.0, 0.0],
    "cloth.anchors": [""],
    "contact.thickness": 0.004,
    "tolerance": 1e-3,
    "grippers": [""],
    "obstacles": ["it"],
    "it.shape": "sphere",
    "it.size": [0.02],
    "it.position": [0.04, 0.03, -0.03],
}
#: The same scene with a mesh.
MESH = {key: value for key, value in OVER.items() if key != "it.size"} | {"it.shape": "mesh", "it.mesh": "it.obj"}
BALL = trimesh.creation.icosphere(1, 0.02)


def obj(vertices: Any, triangles: Any) -> bytes:
    """The content of an OBJ file."""
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in np.asarray(vertices).tolist()]
    lines += ["f " + " ".join(str(corner + 1) for corner in face) for face in np.asarray(triangles).tolist()]
    return "\n".join(lines).encode()


def meshed(content: bytes | None = None, **values: Any) -> Scene:
    mesh_content = obj(BALL.vertices, BALL.faces) if content is None else content
    return Scene.from_parameters({**MESH, **values}, files={"it.obj": mesh_content})


def test_ball_smaller_than_a_cell_carries_the_cloth() -> None:
    for scene in (Scene.from_parameters(OVER), meshed()):
        cloth = Simulation(scene)
        for _ in range(12):
            frame = cloth.advance()
        assert frame.obstacle_wrenches[0, 2] < -0.05
        gaps = cloth.gaps()
        assert gaps is not None
        assert gaps[0, 0] == 0
        assert 0.0 < gaps[0, 1] < 0.002


def test_intersection_between_particles_is_refused() -> None:
    through = {"it.position": [0.04, 0.03, 0.0]}
    with pytest.raises(ValueError, match=r"obstacle 'it' comes through the cloth between particles \d+ and \d+, near"):
        Simulation(Scene.from_parameters({**OVER, **through}))
    with pytest.raises(ValueError, match="obstacle 'it' comes through the cloth"):
        Simulation(meshed(**through))
    cloth = Simulation(Scene.from_parameters({**OVER, **through, "obstacles": [""]}))
    with pytest.raises(EventError, match="obstacle 'it' comes through the cloth"):
        cloth.advance([SetParameters({"obstacles": ["it"]})])
    # Anchored particles, and the cells around them, may be inside.
    held = {**OVER, **through, "cloth.anchors": ["7", "8", "12", "13", "17", "18"]}
    Simulation(Scene.from_parameters(held)).advance()


def test_a_session_with_a_mesh_runs_again_without_its_file(tmp_path: Path) -> None:
    (tmp_path / "it.obj").write_bytes(obj(BALL.vertices, BALL.faces))
    maker = SessionMaker(tmp_path / "session", Scene.from_parameters(MESH, folder=tmp_path))
    (tmp_path / "it.obj").unlink()
    for k in range(20):
        maker.add([Move("it", (0.04, 0.03, -0.03 + 0.002 * k), (0.0, 0.0, 0.0, 1.0))] if k > 8 else [])
    maker.finish()
    verdict = verify(sorted((tmp_path / "session").glob("*.mcap")))
    assert verdict.same, verdict.first_reason
    assert not verdict.environment
    assert verdict.frames == 20


def test_open_obstacle_mesh_is_refused_with_location() -> None:
    vertices, faces = BALL.vertices, BALL.faces
    for content, words in (
        (obj(vertices, faces[1:]), "obstacle 'it': the mesh is open: the edge from vertex"),
        (obj(vertices, faces[:, ::-1]), "obstacle 'it': piece 0 of the mesh, with triangle 0, .* is inside out"),
        (b"v 0 0 zero", "'it.obj' is no readable OBJ file: line 1"),
        (b"v 0 0 0", "'it.obj' has no triangles"),
    ):
        with pytest.raises(ParameterError, match=words):
            meshed(content)
    for values, words in (
        ({"it.mesh": ""}, "it.shape is mesh, and it.mesh is not set"),
        ({"it.mesh": "none.obj"}, "it.mesh: cannot read"),
    ):
        with pytest.raises(ParameterError, match=words):
            meshed(**values)


def test_stl_obstacle_vertices_are_merged() -> None:
    data = BALL.export(file_type="stl")
    scene = Scene.from_parameters({**MESH, "it.mesh": "it.stl"}, files={"it.stl": data})
    (solid,) = scene.solids
    assert solid.vertices is not None
    assert solid.vertices.shape == BALL.vertices.shape


def test_a_mesh_file_can_not_be_named_while_the_cloth_runs() -> None:
    cloth = Simulation(Scene.from_parameters(OVER))
    with pytest.raises(EventError, match=r"other\.mesh can't change while the cloth runs"):
        cloth.advance([SetParameters({"other.shape": "mesh", "other.mesh": "it.obj"})])
