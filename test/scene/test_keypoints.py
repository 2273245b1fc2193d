# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Keypoints: named particles and their poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cloth_sim_ros.physics.plan.gripper_path import rotation_matrix
from cloth_sim_ros.scene.keypoints import KeypointPoses, keypoint_particles
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.scene import Scene

OBJ = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3\nf 1 3 4\n"


def scene(*keypoints: str, **values: object) -> Scene:
    return Scene.from_parameters({"cloth.resolution": [3, 4], "keypoints": list(keypoints), **values})


def test_corners_of_a_grid_run_around_it() -> None:
    assert keypoint_particles(scene("corners")) == {
        "top_left": 0, "top_right": 3, "bottom_right": 11, "bottom_left": 8,
    }  # fmt: skip


def test_keypoints_keep_their_order_and_names() -> None:
    assert keypoint_particles(scene("hem=9", "top_right", "5")) == {"hem": 9, "top_right": 3, "5": 5}
    assert keypoint_particles(scene("")) == {}


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        (["12"], "keypoints names particle 12; there are 12"),
        (["top"], "keypoints has 'top', which is 4 particles; name a corner or one"),
        (["middle"], "'middle' is no edge or corner"),
        (["a=1", "a=2"], "keypoints names 'a' twice"),
        (["corners", "top_left"], "keypoints names 'top_left' twice"),
        (["1b=1"], "keypoints has '1b=1'; a name has letters"),
        (["a="], "keypoints has 'a=', which is 0 particles"),
        (["=3"], "keypoints has '=3'; a name has letters"),
        (["-1"], "keypoints"),
    ],
)
def test_wrong_keypoint_is_refused(entries: list[str], message: str) -> None:
    with pytest.raises(ParameterError, match="keypoints") as error:
        scene(*entries)
    assert message in str(error.value)


def test_corners_of_a_mesh_are_refused(tmp_path: Path) -> None:
    pytest.importorskip("trimesh")
    (tmp_path / "cloth.obj").write_text(OBJ)
    mesh = {"cloth.mesh": str(tmp_path / "cloth.obj"), "cloth.anchors": ["0"], "bending.model": "none"}
    with pytest.raises(ParameterError, match="only a grid has edges: give particle numbers"):
        scene("corners", **mesh)
    cloth = scene("cuff=2", "0", **mesh)
    poses = KeypointPoses(cloth).compute(cloth.sheet.positions().T)
    assert poses[:, :3].tolist() == [[1.0, 1.0, 0.0], [0.0, 0.0, 0.0]]
    # The first triangle of particle 2 is 0, 1, 2: its edge leads to particle 0.
    assert rotation_matrix(poses[0, 3:])[:, 0] == pytest.approx(np.array([-1.0, -1.0, 0.0]) / np.sqrt(2.0))


@pytest.mark.parametrize("seed", range(6))
def test_pose_has_z_along_the_normal_and_x_along_the_row(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cloth = scene("corners", "5")
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    rotation *= np.linalg.det(rotation)
    x = rotation @ cloth.sheet.positions().T + rng.normal(size=(3, 1))
    poses = KeypointPoses(cloth).compute(x)
    assert poses[:, :3] == pytest.approx(x[:, [0, 3, 11, 8, 5]].T)
    # Columns rise along +x and rows along -y of the sheet, so that its normal is -z.
    expected = rotation * np.array([1.0, -1.0, -1.0])
    for pose in poses:
        assert rotation_matrix(pose[3:]) == pytest.approx(expected, abs=1e-12)
        assert np.linalg.norm(pose[3:]) == pytest.approx(1.0)


def test_pose_without_a_normal_is_that_of_the_frame() -> None:
    cloth = scene("5")
    assert KeypointPoses(cloth).compute(np.ones((3, 12))).tolist() == [[1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 1.0]]
