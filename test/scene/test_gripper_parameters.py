# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of single grippers, which override those of the section."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from cloth_sim_ros import Scene
from cloth_sim_ros.scene.parameters import parameter_file
from cloth_sim_ros.scene.parameters.declare import ParameterError

TWO: dict[str, Any] = {"grippers": ["left", "right"], "gripper.frame": "{gripper}_tool"}


def test_gripper_value_overrides_section_value(tmp_path: Path) -> None:
    scene = Scene.from_parameters({**TWO, "left.frame": "tcp", "right.max_speed": 2.0, "right.mode": "pinch"})
    assert [scene.of_gripper(name, "frame") for name in scene.gripper_names] == ["tcp", "{gripper}_tool"]
    assert [scene.of_gripper(name, "max_speed") for name in scene.gripper_names] == [10.0, 2.0]
    assert scene.pinching == ["right"]
    path = tmp_path / "scene.yaml"
    path.write_text(parameter_file.dump(scene.parameters()))
    assert Scene.from_file(path) == scene


def test_obstacle_frame_is_no_gripper_parameter() -> None:
    scene = Scene.from_parameters({**TWO, "obstacles": ["ball"], "ball.shape": "box", "ball.frame": "head"})
    assert scene.described["ball"].frame == "head"
    assert not scene.individual
    added = scene.changed({"obstacles": ["ball", "box"], "box.shape": "box", "box.frame": "tray"})
    assert added.described["box"].frame == "tray"


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"lefft.frame": "tcp"}, "lefft.frame is set, and there is no gripper 'lefft'; there are left, right"),
        ({"left.max_speed": -1.0}, "left.max_speed is -1.0 m/s; it must be at least 0.0 m/s"),
        ({"left.radius": 1.0}, "unknown parameter 'left.radius'"),
    ],
)
def test_invalid_gripper_parameters_are_refused(values: dict[str, Any], words: str) -> None:
    with pytest.raises(ParameterError, match=re.escape(words)):
        Scene.from_parameters({**TWO, **values})


@pytest.mark.parametrize("values", [{"left.frame": "tcp"}, {"left.mode": "pinch"}])
def test_start_parameters_are_read_only(values: dict[str, Any]) -> None:
    scene = Scene.from_parameters(TWO)
    [name] = values
    with pytest.raises(ParameterError, match=f"{name} can't change while the cloth runs"):
        scene.changed(values)
    assert scene.changed({"left.max_speed": 1.0}).of_gripper("left", "max_speed") == 1.0
