# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Merging of copied vertices: seams that are closed up to rounding, and open ones."""

from __future__ import annotations

import logging
from math import cos, pi, sin
from pathlib import Path

import numpy as np
import pytest
from support.session_maker import SessionMaker

from cloth_sim_ros.physics.model.sheets.merging import clusters
from cloth_sim_ros.physics.model.sheets.meshes import checked_mesh
from cloth_sim_ros.physics.model.sheets.surface import SurfaceError
from cloth_sim_ros.scene import mesh_file
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.session.reader import SessionReader
from cloth_sim_ros.verify.run import verify

AROUND, ALONG = 12, 5


def tube(gap: float = 0.0, *, scale: float = 1.0) -> bytes:
    """OBJ text of a tube whose last column of vertices misses the first by sin(2 pi) and a gap [rad]."""
    lines = []
    for row in range(ALONG):
        for k in range(AROUND + 1):
            angle = 2.0 * pi * k / AROUND - (gap if k == AROUND else 0.0)
            lines.append(f"v {scale * cos(angle)!r} {scale * sin(angle)!r} {0.5 * scale * row!r}")
    width = AROUND + 1
    for row in range(ALONG - 1):
        for k in range(AROUND):
            a, b = row * width + k + 1, row * width + k + 2
            lines += [f"f {a} {b} {b + width}", f"f {a} {b + width} {a + width}"]
    return "\n".join(lines).encode()


def values(**further: object) -> dict[str, object]:
    return {
        "cloth.mesh": "tube.obj",
        "cloth.anchors": ["0"],
        "cloth.orientation": [0.0, 0.0, 0.0, 1.0],
        "bending.model": "none",
        "tolerance": 1e-3,
        **further,
    }


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e5])
def test_seam_with_rounding_gap_is_closed(scale: float) -> None:
    mesh = mesh_file.read(tube(scale=scale), name="tube.obj")
    assert len(mesh.positions) == AROUND * ALONG
    assert len(mesh.surface.boundary_loops()) == 2
    assert mesh.repairs == ()
    (note,) = mesh.notes
    assert f"{ALONG} vertices closer than" in note
    assert f"the first {AROUND} with 0" in note


def test_lowest_vertex_of_a_cluster_stays() -> None:
    mesh = mesh_file.read(tube(), name="tube.obj")
    assert mesh.vertex_indices.tolist() == [k for k in range((AROUND + 1) * ALONG) if k % (AROUND + 1) < AROUND]


def test_merge_count_is_logged_as_information(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO):
        mesh_file.parse(tube(), name="tube.obj")
    (record,) = caplog.records
    assert record.levelno == logging.INFO
    assert f"mesh 'tube.obj': {ALONG} vertices closer than" in record.getMessage()


def test_unmerged_seam_stays_open_with_a_warning() -> None:
    mesh = mesh_file.read(tube(), name="tube.obj", merge=False)
    assert len(mesh.positions) == (AROUND + 1) * ALONG
    (warning,) = mesh.repairs
    assert f"{2 * ALONG} border vertices lie within a hundredth" in warning
    assert warning.endswith("or set cloth.merge: true")


def test_nearly_closed_seam_is_listed_with_its_distance() -> None:
    mesh = mesh_file.read(tube(1e-4), name="tube.obj")
    assert mesh.notes == ()
    (warning,) = mesh.repairs
    assert f"{2 * ALONG} border vertices lie within a hundredth of an edge" in warning
    assert "vertex 0 at [1, 0, 0], is 0.0001 m away" in warning
    assert warning.endswith("merge by distance in the program that made the mesh")
    assert mesh_file.read(tube(0.1), name="tube.obj").repairs == ()


def test_border_vertex_on_a_border_edge_is_listed() -> None:
    # A T-junction inside a square of 4 x 4: vertex 16 lies in the middle of the edge from 6 to 9, on one side alone.
    points = [[k % 4, k // 4, 0] for k in range(16)] + [[1.5, 1.5, 0]]
    cells = [(k, k + 1, k + 5, k + 4) for k in range(12) if k % 4 < 3]
    triangles = [t for a, b, c, d in cells if a != 5 for t in ((a, b, d), (b, c, d))]
    triangles += [(5, 6, 9), (6, 10, 16), (16, 10, 9)]
    (warning,) = checked_mesh(points, triangles).repairs
    assert "1 border vertex lies within a hundredth of an edge" in warning
    assert "vertex 16 at [1.5, 1.5, 0], is 0 m away" in warning


def test_pieces_that_nearly_meet_are_refused_with_their_distance() -> None:
    data = b"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 1.001 0 0\nv 2 0 0\nv 2 1 0\nv 1.001 1 0\nf 1 2 3 4\nf 5 6 7 8\n"
    with pytest.raises(SurfaceError, match=r"2 pieces that share no edge.*vertex 1 at \[1, 0, 0\], is 0.001 m away"):
        mesh_file.read(data, name="halves.obj")


def test_narrow_ribbon_is_no_open_seam() -> None:
    row = np.stack((np.arange(6.0), np.zeros(6), np.zeros(6)), axis=1)
    points = np.concatenate((row, row + np.array([0.0, 0.005, 0.0])))
    triangles = [t for k in range(5) for t in ([k, k + 1, k + 7], [k, k + 7, k + 6])]
    assert checked_mesh(points, triangles).repairs == ()


def test_two_layers_within_the_limit_are_refused_with_a_remedy() -> None:
    square = "v 0 0 {0}\nv 1 0 {0}\nv 1 1 {0}\nv 0 1 {0}\n"
    data = (square.format("0") + square.format("1e-8") + "f 1 2 3 4\nf 5 6 7 8\n").encode()
    with pytest.raises(SurfaceError, match=r"\[0, 1, 2\] and \[4, 5, 6\] lie on one another.*cloth.merge: false"):
        mesh_file.read(data, name="layers.obj", several=True)
    assert len(mesh_file.read(data, name="layers.obj", several=True, merge=False).positions) == 8


def test_merge_that_spoils_a_surface_names_the_remedy() -> None:
    # Two triangles whose tips are 1e-8 m apart touch in one point if they are merged.
    data = b"v 0 0 0\nv -1 1 0\nv -1 -1 0\nv 1e-8 0 0\nv 1 -1 0\nv 1 1 0\nf 1 2 3\nf 4 5 6\n"
    with pytest.raises(SurfaceError, match=r"touch in a single point.*1 vertex closer than .*cloth.merge: false"):
        mesh_file.read(data, name="tips.obj", several=True)


def test_triangle_between_merged_vertices_is_left_out() -> None:
    data = b"v 0 0 0\nv 1 0 0\nv 1 1e-9 0\nv 1 1 0\nf 1 2 3\nf 1 3 4\n"
    mesh = mesh_file.read(data, name="sliver.obj")
    assert mesh.surface.triangles.tolist() == [[0, 1, 2]]
    assert "1 triangle between them left out" in mesh.notes[0]


def test_chain_wider_than_two_limits_is_no_cluster() -> None:
    chain = np.stack((0.9 * np.arange(5), np.zeros(5), np.zeros(5)), axis=1)
    assert clusters(chain, 1.0).tolist() == [0, 1, 2, 3, 4]
    assert clusters(chain[:3], 1.0).tolist() == [0, 0, 0]


def test_clusters_are_those_of_every_pair() -> None:
    random = np.random.default_rng(3)
    points = np.repeat(random.uniform(-1.0, 1.0, (300, 3)), random.integers(1, 6, 300), axis=0)
    points = points + random.uniform(-1e-7, 1e-7, points.shape)
    random.shuffle(points)
    lowest = clusters(points, 4e-7)
    away = np.sqrt(np.square(points[:, None] - points[None]).sum(axis=2))
    assert lowest.tolist() == np.argmax(away < 4e-7, axis=1).tolist()


def test_thousand_vertices_at_one_spot_are_no_copies() -> None:
    crowd = np.random.default_rng(5).uniform(0.0, 1e-3, (1000, 3))
    assert clusters(np.concatenate((crowd, [[9.0, 9.0, 9.0], [9.0, 9.0, 9.0005]])), 1e-3)[-1] == 1000


def test_parameter_switches_merging_off() -> None:
    files = {"tube.obj": tube()}
    assert Scene.from_parameters(values(), files=files).shape == (1, AROUND * ALONG)
    unmerged = Scene.from_parameters(values(**{"cloth.merge": False}), files=files)
    assert unmerged.shape == (1, (AROUND + 1) * ALONG)


def test_state_of_the_unmerged_mesh_names_the_remedy() -> None:
    state = Scene.from_parameters(values(**{"cloth.merge": False}), files={"tube.obj": tube()}).starting_state()
    files = {"tube.obj": tube(), "before.npz": state.to_bytes()}
    with pytest.raises(ParameterError, match=r"has 65 particles, the cloth 60: .*with cloth.merge: false it fits"):
        Scene.from_parameters(values(initial_state="before.npz"), files=files)
    Scene.from_parameters(values(initial_state="before.npz", **{"cloth.merge": False}), files=files)


def test_session_without_the_parameter_runs_unmerged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    parameters = Scene.parameters
    monkeypatch.setattr(
        Scene, "parameters", lambda scene: {n: v for n, v in parameters(scene).items() if n != "cloth.merge"}
    )
    maker = SessionMaker(tmp_path, Scene.from_parameters(values(**{"cloth.merge": False}), files={"tube.obj": tube()}))
    for _ in range(3):
        maker.add()
    path = maker.finish()
    monkeypatch.undo()
    with SessionReader([path]) as reader:
        assert "merge" not in reader.scene_yaml
    verdict = verify([path])
    assert verdict.different == 0
    assert verdict.frames == 3
