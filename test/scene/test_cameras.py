# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of depth cameras: names, limits, changes."""

from __future__ import annotations

import math
from typing import Any

import pytest

from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.scene import Scene

WRIST: dict[str, Any] = {"cameras": ["wrist"]}


def test_cameras_are_described_by_their_names() -> None:
    scene = Scene.from_parameters({**WRIST, "cameras": ["wrist", "top"], "top.width": 320, "wrist.frame": "hand"})
    assert (scene.camera_names, scene.views["top"].width) == (["wrist", "top"], 320)
    assert scene.views["wrist"].frame == "hand"
    assert scene.views["wrist"].width == 640
    assert Scene.from_parameters(scene.parameters()) == scene
    assert not Scene.from_parameters({}).views
    assert not Scene.from_parameters({"cameras": [""]}).camera_names


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({**WRIST, "wrist.width": 0}, "wrist.width is 0; it must be at least 1"),
        ({**WRIST, "wrist.height": 5000}, "wrist.height is 5000; it must be at most 4096"),
        (
            {**WRIST, "wrist.width": 4096, "wrist.height": 4096},
            "wrist.width x wrist.height is 16777216 pixels; an image has at most 5500000",
        ),
        ({"cameras": ["wrist", "wrist"]}, "two cameras are named 'wrist'; give each its own name"),
        ({**WRIST, "grippers": ["wrist"]}, "'wrist' names a camera and a gripper; give the camera another name"),
        (
            {**WRIST, "obstacles": ["wrist"], "wrist.shape": "plane"},
            "'wrist' names a camera and an obstacle; give the camera another name",
        ),
        ({**WRIST, "wrist.shape": "plane"}, "'wrist' names a camera and an obstacle; give the camera another name"),
        ({"cameras": ["cloth"]}, "a camera is named 'cloth', as parameters are; give it another name"),
        ({"cameras": ["my cam"]}, "camera name 'my cam' is no ROS name; use letters, digits and _, a letter first"),
        ({**WRIST, "wrist.position": [0.0, math.nan, 0.0]}, "wrist.position is nan; it must be finite"),
        ({**WRIST, "wrist.orientation": [0.0] * 4}, "wrist.orientation: orientation .* is no quaternion"),
        ({**WRIST, "wrist.fov": 0.0}, "wrist.fov is 0.0 rad; it must be at least 0.01 rad"),
        ({**WRIST, "wrist.fov": math.pi}, "wrist.fov is 3.14159.* rad; it must be at most 3.1 rad"),
        ({**WRIST, "wrist.intrinsics": [500.0, 0.0, 320.0, 240.0]}, "fx and fy, its first .* must be at least 0.01"),
        ({**WRIST, "wrist.intrinsics": [1e-300, 500.0, 320.0, 240.0]}, "must be at least 0.01 pixels, or all"),
        (
            {**WRIST, "wrist.max_depth": 70.0, "wrist.encoding": "16UC1"},
            "wrist.max_depth is 70 m; 16UC1 holds at most 65.535 m: lower it, or set wrist.encoding to 32FC1",
        ),
        (
            {**WRIST, "wrist.min_depth": 2.0, "wrist.max_depth": 2.0},
            "wrist.min_depth is 2 m and wrist.max_depth 2 m; the first must be below the second",
        ),
        ({**WRIST, "wrist.encoding": "mono8"}, "wrist.encoding is 'mono8'; it must be one of 32FC1, 16UC1"),
        ({**WRIST, "wrist.seed": -1}, "wrist.seed is -1; it must be at least 0"),
        ({"wrist.width": 64}, "If 'wrist' is to be a camera, name it in cameras"),
        ({"cameras": "wrist"}, "cameras is 'wrist'; it must be an array of string"),
    ],
)
def test_wrong_cameras_are_refused_with_a_remedy(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        Scene.from_parameters(values)


def test_several_faults_of_cameras_come_together() -> None:
    with pytest.raises(ParameterError) as error:
        Scene.from_parameters(
            {**WRIST, "wrist.min_depth": 3.0, "wrist.max_depth": 1.0, "wrist.intrinsics": [-1.0, 0.0, 0.0, 0.0]}
        )
    assert len(error.value.sentences) == 2


def test_only_the_pose_of_a_camera_may_change() -> None:
    scene = Scene.from_parameters(WRIST)
    assert scene.changed({"wrist.position": [0.0, 0.0, 2.0]}).views["wrist"].position == (0.0, 0.0, 2.0)
    for name, value in (("wrist.width", 64), ("wrist.disparity_noise", 0.1), ("cameras", ["top"])):
        with pytest.raises(ParameterError, match=f"{name} can't change while the cloth runs; set it at start"):
            scene.changed({name: value})


def test_cameras_change_no_part_of_the_motion() -> None:
    assert all(entry.observes for entry in Scene.from_parameters(WRIST).entries if entry.name.startswith("wrist."))
