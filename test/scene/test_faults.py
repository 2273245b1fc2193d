# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Faults of parameters are reported together; frame names follow tf2."""

from __future__ import annotations

from pathlib import Path

import pytest

from cloth_sim_ros.scene import frame_ids
from cloth_sim_ros.scene.parameters import parameter_file
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.scene import Scene

WRONG = {"rate": 0.0, "tolerance": -1.0, "cloth.resolution": [1, 1], "ratte": 3.0}


def sentences(values: dict[str, object]) -> list[str]:
    with pytest.raises(ParameterError) as caught:
        Scene.from_parameters(values)
    assert str(caught.value) == "\n".join(caught.value.sentences)
    return caught.value.sentences


def test_wrong_values_are_named_together() -> None:
    assert sentences(WRONG) == [
        "unknown parameter 'ratte'; did you mean 'rate'?",
        "rate is 0.0 Hz; it must be at least 0.1 Hz",
        "tolerance is -1.0 m; it must be at least 0.0 m",
        "cloth.resolution is 1; it must be at least 2",
    ]


def test_wrong_values_of_a_file_are_named_together(tmp_path: Path) -> None:
    path = tmp_path / "wrong.yaml"
    path.write_text(parameter_file.dump(WRONG))
    with pytest.raises(ParameterError) as caught:
        Scene.from_file(path)
    assert len(str(caught.value).splitlines()) == len(WRONG)


@pytest.mark.parametrize(("entry", "value"), [("frame_id: no", False), ("cloth.anchors: [3, 4]", 3)])
def test_text_that_yaml_reads_as_another_type_needs_quotes(tmp_path: Path, entry: str, value: object) -> None:
    path = tmp_path / "plain.yaml"
    path.write_text(f"/**:\n  ros__parameters:\n    {entry}\n")
    with pytest.raises(ParameterError, match=rf"is {value}, of type .*; it must be string.*: write it in quotes"):
        Scene.from_file(path)


def test_viscosity_beyond_any_ratio_to_the_modulus_is_refused() -> None:
    values = {"material.viscosity": 1e4, "material.stretch_modulus": 3e-308, "bending.model": "none"}
    (sentence,) = sentences(values)
    assert sentence.startswith("material.viscosity is 10000.0 N s/m and material.stretch_modulus 3e-308 N/m; their")


def test_faults_that_no_range_shows_are_named_together() -> None:
    values = {
        "cloth.resolution": [4096, 4096],
        "tolerance": 1e-15,
        "frame_id": "",
        "cloth.orientation": [0.0, 0.0, 0.0, 0.0],
        "grippers": ["left", "left"],
        "obstacles": ["table"],
        "contact.friction": [0.1, 0.2],
    }
    refusals = sentences(values)
    assert len(refusals) == len(values)
    starts = (
        "cloth.resolution 4096 x 4096 makes 16777216 particles",
        "tolerance is 1e-15 m, finer than rounding",
        "frame_id is empty",
        "cloth.orientation: ",
        "two grippers are named 'left'",
        "obstacles names 'table', and table.shape is not set",
        "contact.friction is 0.1 at rest and 0.2 in motion",
    )
    for start in starts:
        assert [sentence for sentence in refusals if sentence.startswith(start)], start


def test_single_fault_is_an_error_of_one_sentence() -> None:
    assert sentences({"rate": 0.0}) == ["rate is 0.0 Hz; it must be at least 0.1 Hz"]


@pytest.mark.parametrize("name", ["world", "map", "base_link", "left arm/tool0", "{gripper}_tool", "käse", "a/b//c"])
def test_frame_that_tf2_takes_is_accepted(name: str) -> None:
    assert frame_ids.fault(name) == ""


@pytest.mark.parametrize(
    ("name", "remedy"),
    [
        ("/map", "write 'map'"),
        ("//map", "write 'map'"),
        ("/ map", "write 'map'"),
        ("/", "write a name, e.g. 'world'"),
        (" ", "write a name, e.g. 'world'"),
        ("map ", "write 'map'"),
        ("\tmap", "write 'map'"),
        ("ma\np", "write 'map'"),
        ("map\0", "write 'map'"),
    ],
)
def test_frame_that_tf2_refuses_is_refused(name: str, remedy: str) -> None:
    assert frame_ids.fault(name).endswith(remedy)


def test_every_frame_parameter_is_checked() -> None:
    names = ["frame_id", "gripper.frame", "table.frame", "left.frame"]
    values = {name: "/map" for name in names} | {"cloth.mesh": "/map", "other.frame": "", "tf.publish": True}
    assert [sentence.partition(" ")[0] for sentence in frame_ids.faults(values)] == names


def test_recorded_scene_keeps_a_frame_with_a_slash() -> None:
    # Sessions of earlier versions hold such names and run again with them.
    assert Scene.from_parameters({"frame_id": "/map"}).frame_id == "/map"
