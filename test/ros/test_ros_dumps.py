# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parameter dumps given to a node of another name: one sentence with a remedy from each reader."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from support.clocked_cloth import ClockedCloth
from support.ros_client import Client, start_cloth

from cloth_sim_ros.ros import main as node_main
from cloth_sim_ros.ros.process.command_line_parameters import unused_files
from cloth_sim_ros.scene.parameters import parameter_file
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.scene import Scene

SCENE = {
    "cloth.resolution": [5, 6],
    "grippers": ["left", "right"],
    "obstacles": ["table"],
    "table.shape": "box",
    "table.position": [0.0, 0.0, -3.0],
}


@pytest.fixture
def client(ros_domain: int) -> Iterator[Client]:
    with Client() as client:
        yield client


def dumped(client: Client) -> dict[str, Any]:
    """Every parameter of a node, as `ros2 param dump` writes them."""
    with ClockedCloth(client, SCENE) as cloth:
        node = cloth.node.node
        values = {name: node.get_parameter(name).value for name in node.list_parameters([], 0).names}
    return {name: list(value) if isinstance(value, array) else value for name, value in values.items()}


def warnings_in(output: str) -> list[str]:
    lines = [line for line in output.splitlines() if "[WARN]" in line or line.startswith("warning: ")]
    # A busy machine may be too slow for any cloth.
    return [line for line in lines if "real-time factor" not in line and "frames were late" not in line]


def test_dump_for_every_node_warns_once(client: Client, capfd: pytest.CaptureFixture[str]) -> None:
    values = dumped(client)
    profiles = [name for name in values if name.startswith("qos_overrides./cloth_sim/")]
    assert len(profiles) > 27
    capfd.readouterr()
    with ClockedCloth(client, values, name="towel") as cloth:
        cloth.tick()
        names = cloth.node.node.list_parameters([], 0).names
        assert not [name for name in names if "/cloth_sim/" in name]
    (line,) = warnings_in(capfd.readouterr().err)
    assert f"{len(profiles)} parameters qos_overrides./cloth_sim/... are of topics of /cloth_sim" in line
    assert "write /towel/ for /cloth_sim/ in their names, or leave them out" in line


def test_dump_starts_the_same_node_without_a_warning(client: Client, capfd: pytest.CaptureFixture[str]) -> None:
    values = dumped(client)
    capfd.readouterr()
    with ClockedCloth(client, values) as cloth:
        cloth.tick()
    assert warnings_in(capfd.readouterr().err) == []


def test_dump_is_a_scene_of_the_library(client: Client, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "dump.yaml"
    path.write_text(parameter_file.dump(dumped(client), node="/cloth_sim"))
    assert Scene.from_file(path) == Scene.from_parameters(SCENE)
    capsys.readouterr()
    assert node_main.main(["--check", str(path)]) == 0
    assert warnings_in(capsys.readouterr().out) == []
    path.write_text(path.read_text().replace("/cloth_sim:\n", "/**:\n"))
    assert node_main.main(["--check", str(path), "--node", "/arm/towel"]) == 0
    (line,) = warnings_in(capsys.readouterr().out)
    assert "write /arm/towel/ for /cloth_sim/ in their names" in line


def test_file_of_other_nodes_alone_gives_a_warning(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "dump.yaml"
    path.write_text(parameter_file.dump({"rate": 30.0}, node="/cloth_sim"))
    words = "it sets parameters of /cloth_sim: write '/**:', which means every node, or '/towel:' for '/cloth_sim:'"
    with pytest.raises(ParameterError, match="sets nothing for the node /towel") as caught:
        Scene.from_file(path, node="towel")
    assert words in str(caught.value)
    assert node_main.main(["--check", str(path), "--node", "towel"]) == 0
    (line,) = warnings_in(capsys.readouterr().out)
    assert words in line
    (sentence,) = unused_files(["cloth_sim", "--ros-args", "--params-file", str(path)], node="/towel")
    assert sentence == f"'{path}' sets nothing for the node /towel: {words} in the file"


@pytest.mark.parametrize(
    "text",
    [
        "/**:\n  ros__parameters: {rate: 30.0}\n",
        "towel:\n  ros__parameters: {rate: 30.0}\nother:\n  ros__parameters: {rate: 30.0}\n",
        "/*:\n  ros__parameters: {rate: 30.0}\n",
        "other:\n  ros__parameters: {}\n",
        "",
    ],
)
def test_file_addressed_to_the_node_gives_no_warning(tmp_path: Path, text: str) -> None:
    path = tmp_path / "file.yaml"
    path.write_text(text)
    assert list(unused_files(["cloth_sim", "--ros-args", "--params-file", str(path)], node="/towel")) == []


def test_node_warns_once_of_another_nodes_file(
    ros_domain: int, start_process: Callable[..., Any], tmp_path: Path
) -> None:
    path = tmp_path / "dump.yaml"
    path.write_text(parameter_file.dump({"rate": 30.0, "cloth.resolution": [5, 5]}, node="/cloth_sim"))
    process = start_cloth(start_process, "cloth.resolution:=[6, 6]", wait="sets nothing for the node /towel",
                          arguments=["-r", "__node:=towel", "--params-file", str(path)])  # fmt: skip
    assert process.interrupt() == 0
    assert process.output.count("sets nothing for the node") == 1


def test_many_unknown_parameters_share_a_warning(client: Client, capfd: pytest.CaptureFixture[str]) -> None:
    with ClockedCloth(client, {f"foreign.p{index}": 1.0 for index in range(20)}):
        pass
    (line,) = warnings_in(capfd.readouterr().err)
    assert "there are no parameters 'foreign.p0', 'foreign.p1', 'foreign.p2' and 17 more" in line
