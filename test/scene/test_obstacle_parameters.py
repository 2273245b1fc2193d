# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Obstacles as parameters: descriptions, names, and refusals with the reason."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from cloth_sim_ros import Scene
from cloth_sim_ros.scene.parameters import parameter_file
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.parameters.warnings import ineffective_parameters

BASE: dict[str, Any] = {
    "cloth.resolution": [10, 10],
    "obstacles": ["table", "ball"],
    "table.shape": "box",
    "table.size": [1.0, 2.0, 0.1],
    "table.friction": [0.3],
    "ball.shape": "sphere",
    "ball.size": [0.2],
    "ball.position": [0.0, 0.5, 0.25],
}


def test_a_scene_has_the_obstacles_that_it_names() -> None:
    scene = Scene.from_parameters(BASE)
    table, ball = scene.solids
    assert (table.name, table.shape, table.size, table.friction) == ("table", "box", (1.0, 2.0, 0.1), (0.3, 0.3))
    assert (ball.name, ball.shape, ball.size, ball.friction) == ("ball", "sphere", (0.2,), (0.0, 0.0))
    assert scene.parameters()["ball.position"] == (0.0, 0.5, 0.25)


def test_scene_file_round_trip_is_exact(tmp_path: Path) -> None:
    scene = Scene.from_parameters(BASE)
    path = tmp_path / "scene.yaml"
    path.write_text(parameter_file.dump(scene.parameters()))
    assert Scene.from_file(path) == scene


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"ball.size": [-0.1]}, r"ball.size is -0.1 m; it must be above 0.0 m"),
        ({"ball.size": [0.1, 0.1]}, "a sphere has 1: radius"),
        ({"ball.shape": "cone"}, "it must be one of plane, box, sphere"),
        ({"ball.position": [0.0, 0.0, float("nan")]}, "ball.position is nan; it must be finite"),
        ({"ball.orientation": [0.0, 0.0, 0.0, 0.0]}, "ball.orientation: .* is no quaternion"),
        ({"ball.friction": [0.1, 0.2]}, "friction 0.1 at rest and 0.2 in motion"),
        ({"ball.friction": [0.1, 0.1, 0.1]}, "ball.friction has 3 entries"),
        ({"obstacles": ["ball", "ball"]}, "two obstacles are named 'ball'"),
        ({"obstacles": ["no name"]}, "'no name' is no ROS name"),
        ({"obstacles": ["air"]}, "named 'air', as parameters are"),
        ({"obstacles": ["contact"]}, "named 'contact', as parameters are"),
        ({"obstacles": ["use_sim_time"]}, "named 'use_sim_time', as parameters are"),
        ({"obstacles": ["other"]}, r"obstacles names 'other', and other.shape is not set"),
        ({"grippers": ["ball"]}, "'ball' names a gripper and an obstacle"),
        ({"contact.thickness": 0.06}, "more than half the cloth's shortest edge, 0.1111 m; take 0.054 m or less"),
        ({"bowl.size": [0.1]}, "If 'bowl' is to be an obstacle, set bowl.shape"),
        ({"ball.radius": 0.1}, r"unknown parameter 'ball.radius'"),
    ],
)
def test_invalid_obstacle_is_refused(change: dict[str, Any], words: str) -> None:
    with pytest.raises(ParameterError, match=words):
        Scene.from_parameters({**BASE, **change})


def test_chain_may_have_obstacles_but_not_contact_with_itself() -> None:
    chain = Scene.from_file(Path(__file__).parents[2] / "config" / "chain.yaml")
    values = {**chain.parameters(), "obstacles": ["floor"], "floor.shape": "plane"}
    assert Scene.from_parameters(values, files=chain.files).obstacle_names == ["floor"]
    with pytest.raises(ParameterError, match=r"contact\.self needs a surface, and the file of cloth\.springs has none"):
        Scene.from_parameters({**values, "contact.self": True}, files=chain.files)


def test_obstacles_can_be_added_and_removed_but_not_reshaped() -> None:
    scene = Scene.from_parameters({**BASE, "box.shape": "box"})
    assert scene.changed({"obstacles": ["box", "table"]}).obstacle_names == ["box", "table"]
    assert scene.changed({"obstacles": [""]}).solids == []
    added = scene.changed({"obstacles": ["ball", "floor"], "floor.shape": "plane"})
    assert [solid.shape for solid in added.solids] == ["sphere", "plane"]
    assert scene.changed({"ball.friction": [0.9, 0.1]}).solids[1].friction == (0.9, 0.1)
    assert scene.changed({"box.size": [1.0, 1.0, 1.0]}).described["box"].size == (1.0, 1.0, 1.0)
    with pytest.raises(ParameterError, match=r"ball.size can't change while 'ball' is there"):
        scene.changed({"ball.size": [0.3]})
    with pytest.raises(ParameterError, match=r"table.position can't change .* or move it by ~/table/target"):
        scene.changed({"table.position": [0.0, 0.0, 1.0]})


def test_ineffective_obstacle_parameters_are_reported() -> None:
    values = {**BASE, "tabel.shape": "plane", "table.shape": "plane", "contact.thickness": 0.002}
    sentences = sorted(ineffective_parameters(Scene.from_parameters(values), values))
    assert len(sentences) == 2
    assert sentences[0].startswith("tabel.shape is set and has no effect: obstacles does not name 'tabel'")
    assert "Did you mean 'table'?" in sentences[0]
    assert sentences[1] == "table.size is set and has no effect: a plane has no size"
    values["obstacles"] = [""]
    assert any(
        "there are no obstacles" in sentence
        for sentence in ineffective_parameters(Scene.from_parameters(values), values)
    )
