# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Normals, strains, colours, anchors and grippers of a replay, against independent results."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.random_sessions import random_events, random_scene
from support.session_maker import SessionMaker

from cloth_sim_ros.physics.model.sheets.grid import GridSheet
from cloth_sim_ros.replay.colours import strain_colours
from cloth_sim_ros.replay.grippers import GripperTracks
from cloth_sim_ros.replay.opening import read_opening
from cloth_sim_ros.replay.plots import extra_numbers
from cloth_sim_ros.replay.pre_scan import round_up
from cloth_sim_ros.replay.surface_geometry import GridGeometry, MeshGeometry, SurfaceGeometry
from cloth_sim_ros.scene.parameters import parameter_file
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.reader import SessionReader

SHEET = GridSheet(height=0.8, width=1.0, rows=7, columns=9, layout="alternating")
REST_POSITIONS = SHEET.positions()


def _measure(measures: SurfaceGeometry, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    normals, strain = np.empty(xyz.shape, np.float32), np.empty(len(xyz), np.float32)
    measures.compute(np.ascontiguousarray(xyz, np.float32), normals, strain)
    return normals, strain


def _both() -> list[SurfaceGeometry]:
    return [
        GridGeometry(REST_POSITIONS, REST_POSITIONS, SHEET.rows, SHEET.columns),
        MeshGeometry(SHEET.triangles(), REST_POSITIONS, REST_POSITIONS),
    ]


@pytest.mark.parametrize("measures", _both(), ids=["grid", "mesh"])
def test_a_sheet_stretched_along_its_rows_has_that_strain(measures: SurfaceGeometry) -> None:
    normals, strain = _measure(measures, REST_POSITIONS * [1.25, 1.0, 1.0])
    np.testing.assert_allclose(strain, 0.25, atol=1e-6)
    np.testing.assert_allclose(normals, np.tile([0.0, 0.0, 1.0], (len(REST_POSITIONS), 1)), atol=1e-6)


@pytest.mark.parametrize("measures", _both(), ids=["grid", "mesh"])
def test_a_shortened_sheet_has_no_strain(measures: SurfaceGeometry) -> None:
    _, strain = _measure(measures, 0.9 * REST_POSITIONS)
    np.testing.assert_array_equal(strain, 0.0)


@pytest.mark.parametrize("measures", _both(), ids=["grid", "mesh"])
def test_displaced_particle_strains_only_its_neighbours(measures: SurfaceGeometry) -> None:
    xyz = REST_POSITIONS.copy()
    middle = 3 * SHEET.columns + 4
    xyz[middle] += [0.0, 0.0, 0.5]
    _, strain = _measure(measures, xyz)
    rows, columns = np.divmod(np.flatnonzero(strain > 1e-5), SHEET.columns)
    assert (abs(rows - 3) <= 1).all()
    assert (abs(columns - 4) <= 1).all()
    shortest = min(SHEET.spacing)
    assert strain[middle] == pytest.approx(np.hypot(shortest, 0.5) / shortest - 1.0, rel=1e-5)


def test_grid_and_mesh_agree_on_a_smooth_cloth() -> None:
    # Both are second-order accurate inside: they differ by about the spacing squared.
    fine = GridSheet(height=1.0, width=1.0, rows=80, columns=80, layout="both")
    rest_positions = fine.positions()
    xyz = rest_positions + np.stack(
        [
            0 * rest_positions[:, 0],
            0 * rest_positions[:, 0],
            0.1 * np.sin(3 * rest_positions[:, 0]) * np.cos(2 * rest_positions[:, 1]),
        ],
        axis=1,
    )
    grid_normals, _ = _measure(GridGeometry(rest_positions, rest_positions, 80, 80), xyz)
    mesh_normals, _ = _measure(MeshGeometry(fine.triangles(), rest_positions, rest_positions), xyz)
    inside = np.arange(6400).reshape(80, 80)[1:-1, 1:-1].ravel()
    angle = np.arccos(np.clip((grid_normals * mesh_normals).sum(axis=1)[inside], -1.0, 1.0))
    assert angle.max() < 2e-3


@pytest.mark.parametrize("turn", [1.0, -1.0])
def test_normals_face_the_light_at_the_start(turn: float) -> None:
    start = REST_POSITIONS * [1.0, 1.0, 1.0] if turn > 0 else REST_POSITIONS * [1.0, -1.0, 1.0]
    for measures in (GridGeometry(REST_POSITIONS, start, 7, 9), MeshGeometry(SHEET.triangles(), REST_POSITIONS, start)):
        normals, _ = _measure(measures, start)
        assert (normals @ [1.0, 2.0, 3.0] > 0.0).all()


def test_particles_without_area_have_finite_normals() -> None:
    rest_positions = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [5.0, 5.0, 5.0]])
    measures = MeshGeometry(np.array([[0, 1, 2]], np.uint32), rest_positions, rest_positions)
    for xyz in (rest_positions, np.zeros_like(rest_positions)):
        normals, strain = _measure(measures, xyz)
        assert np.isfinite(normals).all()
        assert np.isfinite(strain).all()
        assert strain[3] == 0.0


def test_colours_go_from_light_to_red_in_equal_steps() -> None:
    out = np.empty(5, np.uint32)
    strain_colours(np.array([0.0, 0.02, 0.04, 0.05, 9.0], np.float32), 0.04, out)
    red, green, blue = out >> 24, out >> 16 & 255, out >> 8 & 255
    assert (out & 255 == 255).all()
    assert blue[0] > 200
    assert green[0] > 200
    assert out[2] == out[3] == out[4]
    assert red[4] > 2 * green[4]
    assert out[1] not in (out[0], out[4])


@pytest.mark.parametrize(
    ("value", "rounded"), [(0.001, 0.001), (0.0011, 0.002), (0.03, 0.05), (0.06, 0.1), (7.0, 10.0)]
)
def test_colour_limits_are_round(value: float, rounded: float) -> None:
    assert round_up(value) == pytest.approx(rounded)


@pytest.mark.parametrize(
    "anchors", [["top"], ["bottom", "left"], ["top_left", "top_right"], ["bottom_left", "bottom_right", "5"], [""]]
)
def test_anchors_are_those_of_the_scene(anchors: list[str]) -> None:
    scene = Scene.from_parameters({"cloth.resolution": [4, 6], "cloth.anchors": anchors})
    text = parameter_file.dump(scene.parameters())
    opening = read_opening(text, scene.starting_state().to_bytes())
    assert opening.anchored_particles(4, 6).tolist() == scene.anchored_particles()


def test_invalid_opening_is_refused() -> None:
    scene = Scene()
    text, state = parameter_file.dump(scene.parameters()), scene.starting_state().to_bytes()
    with pytest.raises(SessionError, match="parameter file"):
        read_opening("[1, 2]", state)
    with pytest.raises(SessionError, match="state"):
        read_opening(text, state[:100])


@pytest.mark.parametrize("seed", range(6))
def test_replayed_gripper_poses_equal_simulation(tmp_path: Path, seed: int) -> None:
    random = np.random.default_rng(seed)
    while not (scene := random_scene(random)).gripper_names:
        pass
    maker = SessionMaker(tmp_path, scene)
    simulation = maker.simulation
    poses, held, placed = [], [], []
    for _ in range(80):
        maker.add(random_events(random, maker))
        count = range(len(scene.gripper_names))
        poses.append(simulation.grippers.poses())
        held.append([simulation.grippers.grasped_particles(g).tolist() for g in count])
        placed.append([simulation.grippers.is_placed(g) for g in count])
    with SessionReader(maker.finish()) as reader:
        opening = read_opening(reader.scene_yaml, reader.state)
        tracks = GripperTracks(opening, opening.anchored_particles(*scene.shape))
        before = opening.positions
        for k, recorded in enumerate(reader.clouds()):
            assert recorded.frame is not None
            tracks.advance(recorded.frame, lambda before=before: before)
            for g, name in enumerate(scene.gripper_names):
                track = tracks.tracks[name]
                assert (track.pose is not None) == placed[k][g]
                if track.pose is not None:
                    np.testing.assert_allclose(track.pose, poses[k][g], atol=1e-15)
                assert track.grasped.tolist() == held[k][g]
            before = recorded.cloud.xyz
    assert any(any(frame) for frame in held)


def test_numbers_of_a_frame_have_plots() -> None:
    extras = {"energy": {"kinetic": 1.5, "balance": 1e-6}, "late": True, "skipped": 3, "real_time_factor": 0.9}
    assert dict(extra_numbers(extras)) == {
        "plots/energy/energy_kinetic": 1.5,
        "plots/energy/energy_balance": 1e-6,
        "plots/late/late": 1.0,
        "plots/pace/real_time_factor": 0.9,
    }
