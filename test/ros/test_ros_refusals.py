# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Refusals of a node: all faults of its parameters at once, and frame names that tf2 refuses."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from rclpy.parameter import Parameter
from support.clocked_cloth import ClockedCloth
from support.ros_client import Client, start_cloth

from cloth_sim_ros.ros import main as node_main
from cloth_sim_ros.ros.node import ClothNode
from cloth_sim_ros.scene.parameters import parameter_file
from cloth_sim_ros.scene.parameters.declare import ParameterError

#: A fault of each kind, and the start of its message.
FAULTS = {
    "rate:=0.0": "rate is 0.0 Hz; it must be at least 0.1 Hz",
    "tolerance:=fine": "tolerance is 'fine', of type str; it must be double",
    "cloth.resolution:=[1, 1]": "cloth.resolution is 1; it must be at least 2",
    "grippers:=[]": "grippers is an empty list, []",
    "use_sim_time:=3": "use_sim_time is 3; it must be true or false",
    "frame_id:=/map": "frame_id is '/map'; tf2 takes no name that begins with '/': write 'map'",
    "qos_overrides./cloth_sim/points.publisher.depth:=-2": "qos_overrides./cloth_sim/points.publisher.depth is -2",
}


@pytest.fixture
def client(ros_domain: int) -> Iterator[Client]:
    with Client() as client:
        yield client


def test_node_names_all_faults_a_line_each(ros_domain: int, start_process: Callable[..., Any]) -> None:
    process = start_cloth(start_process, *FAULTS, wait="")
    assert process.wait() == 1
    lines = process.output.strip().splitlines()
    assert len(lines) == len(FAULTS)
    for words in FAULTS.values():
        assert len([line for line in lines if line.startswith(f"cloth_sim: {words}")]) == 1, words


def test_node_and_check_refuse_a_file_in_the_same_words(
    ros_domain: int, start_process: Callable[..., Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "wrong.yaml"
    values = {"rate": 0.0, "tolerance": -1.0, "gravity": [0.0], "table.shape": "ball", "table.frame": "/hand"}
    path.write_text(parameter_file.dump(values))
    assert node_main.main(["--check", str(path)]) == 1
    lines = capsys.readouterr().err.splitlines()
    process = start_cloth(start_process, wait="", arguments=["--params-file", str(path)])
    assert process.wait() == 1
    assert sorted(process.output.strip().splitlines()) == sorted(lines)
    assert len(lines) == len(values)


@pytest.mark.parametrize("frame", ["/map", " map", "map\n", "/"])
def test_frame_that_tf2_refuses_starts_no_node(client: Client, frame: str) -> None:
    for values in ({"frame_id": frame}, {"gripper.frame": frame}, {"table.shape": "box", "table.frame": frame}):
        name = [*values][-1]
        with pytest.raises(ParameterError, match=f"^{name} is "), ClockedCloth(client, values):
            pass


def test_frame_of_an_obstacle_is_judged_when_it_is_set(client: Client) -> None:
    with ClockedCloth(client, {"table.shape": "box", "table.position": [0.0, 0.0, -3.0]}) as cloth:
        (result,) = cloth.node.node.set_parameters([Parameter("table.frame", value="/hand")])
        assert not result.successful
        assert result.reason == "table.frame is '/hand'; tf2 takes no name that begins with '/': write 'hand'"
        (result,) = cloth.node.node.set_parameters([Parameter("table.frame", value="hand")])
        assert result.successful


def test_parameters_set_together_are_refused_together(client: Client) -> None:
    with ClockedCloth(client) as cloth:
        wrong = [Parameter("gravity", value=[0.0]), Parameter("wind.velocity", value=[200.0, 0.0, 0.0])]
        result = cloth.node.node.set_parameters_atomically(wrong)
        assert not result.successful
        assert "gravity has 1 entries" in result.reason
        assert "wind.velocity is 200.0 m/s" in result.reason
        assert "\n" not in result.reason


def test_excluded_end_of_a_range_is_refused_by_that_end(client: Client) -> None:
    with ClockedCloth(client) as cloth:
        value = Parameter("material.stretch_modulus", value=0.0)
        result = cloth.node.node.set_parameters_atomically([value])
        assert (result.successful, result.reason) == (
            False, "material.stretch_modulus is 0.0 N/m; it must be above 0.0 N/m",
        )  # fmt: skip


def test_name_too_long_for_topics_is_refused(client: Client) -> None:
    name, words = 230 * "x", r"'x{20}\.\.\.' has 230 letters; the topics of /cloth_sim leave room for 229: shorten it"
    with pytest.raises(ParameterError, match=words):
        ClockedCloth(client, {f"{name}.shape": "plane"})
    with ClockedCloth(client) as cloth:
        result = cloth.node.node.set_parameters([Parameter(f"{name}.shape", value="plane")])[0]
        assert re.search(words, result.reason)


@pytest.mark.parametrize(
    ("topics", "words"),
    [
        (["gripper/target", "gripper/point"], "no subscription of PointStamped on /both ("),
        (["points", "mesh"], "no publisher of Marker on /both ("),
    ],
)
def test_topic_of_two_types_is_refused(client: Client, topics: list[str], words: str) -> None:
    remapped = ["--ros-args", *(part for topic in topics for part in ("-r", f"~/{topic}:=/both"))]
    with (
        pytest.raises(ParameterError, match=f"{re.escape(words)}.*; remap one of them"),
        ClothNode(context=client.context, cli_args=remapped) as node,
    ):
        node.start()
