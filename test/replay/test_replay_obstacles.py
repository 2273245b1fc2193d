# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Obstacles in `cloth_replay`: shapes, poses, removal."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.rrd import rows
from support.session_maker import SessionMaker

from cloth_sim_ros.physics.contact.obstacles import Obstacle
from cloth_sim_ros.replay.main import main
from cloth_sim_ros.replay.obstacle_view import ObstacleView
from cloth_sim_ros.replay.rows import Moment, Rows
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Move, SetParameters

pytest.importorskip("rerun", reason="the viewer is not installed: pip install 'cloth_sim_ros[replay]'")
pytest.importorskip("rclpy", reason="the node's markers are made of ROS messages")

SHAPES: dict[str, Any] = {
    "floor.shape": "plane",
    "box.shape": "box",
    "box.size": [0.1, 0.2, 0.3],
    "ball.shape": "sphere",
    "ball.size": [0.1],
    "pill.shape": "capsule",
    "pill.size": [0.05, 0.4],
    "rod.shape": "cylinder",
    "rod.size": [0.05, 0.4],
}


def test_each_shape_is_drawn_where_it_was(tmp_path: Path) -> None:
    names = sorted({name.partition(".")[0] for name in SHAPES})
    places = {f"{name}.position": [0.5 * k, 1.0, -2.0] for k, name in enumerate(names)}
    scene = Scene.from_parameters({"cloth.resolution": [4, 4], "obstacles": names, **SHAPES, **places})
    maker = SessionMaker(tmp_path, scene)
    maker.add()
    start = tuple(places["box.position"])
    maker.add([Move("box", (start[0], start[1], start[2] - 0.1))])
    maker.add([SetParameters({"obstacles": [name for name in names if name != "ball"]})])
    maker.add()
    out = tmp_path / "out.rrd"
    assert main([str(maker.finish()), "--save", str(out)]) == 0
    _, halves = rows(out, "/world/obstacles/box/0", "Boxes3D:half_sizes")
    np.testing.assert_allclose(halves, [[[0.05, 0.1, 0.15]]], rtol=1e-6)
    times, balls = rows(out, "/world/obstacles/ball/0", "Ellipsoids3D:half_sizes")
    assert [len(sizes) for sizes in balls] == [1, 0], "drawn once, and no more when it was taken out"
    assert times[1] == pytest.approx(3.0 / 60.0)
    np.testing.assert_allclose(balls[0], [[0.1, 0.1, 0.1]], rtol=1e-6)
    _, lengths = rows(out, "/world/obstacles/rod/0", "Cylinders3D:lengths")
    _, radii = rows(out, "/world/obstacles/rod/0", "Cylinders3D:radii")
    np.testing.assert_allclose([lengths[0][0], radii[0][0]], [0.4, 0.05], rtol=1e-6)
    _, ends = rows(out, "/world/obstacles/pill/2", "Transform3D:translation")
    np.testing.assert_allclose(ends[0][0], [0.5 * names.index("pill"), 1.0, -1.8], rtol=1e-6)
    _, boxes = rows(out, "/world/obstacles/box/0", "Transform3D:translation")
    np.testing.assert_allclose([box[0][2] for box in boxes], [-2.0, -2.1, -2.1, -2.1], rtol=1e-6)
    _, forces = rows(out, "/plots/force/box", "Scalars:scalars")
    assert forces == [[0.0]] * 4
    _, slab = rows(out, "/world/obstacles/floor/0", "Boxes3D:half_sizes")
    assert slab[0][0][0] > 4.0


def test_mesh_obstacle_is_drawn_by_its_triangles(tmp_path: Path) -> None:
    import rerun as rr

    from cloth_sim_ros.ros.io.obstacle_markers import ObstacleMarkers

    vertices = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    triangles = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    rock = Obstacle(name="rock", shape="mesh", vertices=vertices, triangles=triangles)
    tables: dict[tuple[str, str], Rows] = {}

    def table(path: str, archetype: Any, *, ragged: tuple[str, ...] = ()) -> Rows:
        return tables.setdefault((path, archetype.__name__), Rows(path, archetype, ragged=ragged))

    recording = rr.RecordingStream("test")
    view, out = ObstacleView(recording, table), tmp_path / "out.rrd"
    recording.save(out)
    markers = ObstacleMarkers([rock], frame_id="world", node="/cloth")
    for k in range(3):
        view.show(Moment(0.1 * k, k, k), markers.serialize(np.array([[0.1 * k, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]]), k))
    view.show(
        Moment(0.3, 3, 3),
        ObstacleMarkers([], frame_id="world", node="/cloth", removed=["rock"]).serialize(np.zeros((0, 7)), 3),
    )
    for table_rows in tables.values():
        table_rows.send(recording)
    recording.disconnect()
    _, corners = rows(out, "/world/obstacles/rock/0", "Mesh3D:vertex_positions")
    assert [len(row) for row in corners] == [12, 0], "sent once, though it moved"
    np.testing.assert_allclose(corners[0], vertices[triangles.ravel()])
    _, normals = rows(out, "/world/obstacles/rock/0", "Mesh3D:vertex_normals")
    np.testing.assert_allclose(normals[0][-1], np.full(3, 3.0**-0.5), rtol=1e-6)
    _, places = rows(out, "/world/obstacles/rock/0", "Transform3D:translation")
    np.testing.assert_allclose([translation[0][0] for translation in places], [0.0, 0.1, 0.2], atol=1e-6)
