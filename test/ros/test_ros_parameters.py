# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of a running node: descriptions, ranges, changes at the next frame, and refusals."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from rcl_interfaces.msg import ParameterType
from rclpy.node import Node
from rclpy.parameter import Parameter
from support.clocked_cloth import ClockedCloth
from support.ros_client import Client

from cloth_sim_ros import Scene
from cloth_sim_ros.ros.io.parameters import UnknownParametersError, declare, parameter_descriptor
from cloth_sim_ros.scene.parameters import parameter_file
from cloth_sim_ros.simulation.events import SetParameters

DECLARED = {entry.name: entry for entry in Scene.declared()}
#: A value of another type for each type.
WRONG = {"bool": "yes", "int": 1.5, "double": "much", "string": 7}


@pytest.fixture
def client(ros_domain: int) -> Iterator[Client]:
    with Client() as client:
        yield client


@pytest.mark.parametrize("name", DECLARED)
def test_descriptor(name: str) -> None:
    entry, descriptor = DECLARED[name], parameter_descriptor(DECLARED[name])
    assert descriptor.name == name
    assert len(descriptor.description) > 10
    assert descriptor.type != ParameterType.PARAMETER_NOT_SET
    assert not descriptor.dynamic_typing
    assert descriptor.read_only is not entry.live
    assert ("may change while the cloth runs" in descriptor.additional_constraints) is entry.live
    if entry.unit:
        assert descriptor.description.endswith(f"[{entry.unit}]")
    for choice in entry.choices:
        assert choice in descriptor.additional_constraints
    if entry.length is not None:
        assert f"{entry.length} entries" in descriptor.additional_constraints
    if entry.kind in ("double", "int"):
        # Every number must have limits.
        (limits,) = descriptor.floating_point_range if entry.kind == "double" else descriptor.integer_range
        assert (limits.from_value, limits.to_value) == (entry.min_accepted, entry.max)
        assert limits.step == 0
    elif entry.min is not None:
        low = f"above {entry.min} and at most" if entry.excludes_min else f"from {entry.min} to"
        assert f"{low} {entry.max}" in descriptor.additional_constraints


def test_every_bad_value_is_refused_with_the_reason(client: Client) -> None:
    with ClockedCloth(client) as cloth:
        before = cloth.simulation.scene
        for name, entry in DECLARED.items():
            for value in bad_values(entry):
                (result,) = cloth.node.node.set_parameters([Parameter(name, value=value)])
                assert not result.successful, f"{name} took {value!r}"
                assert result.reason
                # rclpy refuses wrong types with its own message.
                words = (name, "Wrong parameter type")
                assert any(word in result.reason for word in words), f"{name}: {result.reason}"
                assert entry.live or result.reason == f"{name} can't change while the cloth runs; set it at start"
        cloth.tick()
        assert cloth.simulation.scene == before


def bad_values(entry: Any) -> list[Any]:
    element = WRONG[entry.element]
    values: list[Any] = [[element] if entry.is_array else element]
    if not entry.live or entry.is_array:
        return values
    if entry.kind == "double":
        values += [math.nan, math.inf, entry.max * 1.1, entry.min - 1.0]
        if entry.excludes_min:
            values.append(entry.min)
    if entry.choices:
        values.append("nothing of the kind")
    return values


def test_every_live_parameter_takes_effect_at_the_next_frame(client: Client) -> None:
    with ClockedCloth(client) as cloth:
        cloth.tick()
        for name, entry in DECLARED.items():
            if not entry.live:
                continue
            value = other_value(entry, cloth.simulation.scene.parameters()[name])
            (result,) = cloth.node.node.set_parameters(
                [Parameter(name, value=list(value) if entry.is_array else value)]
            )
            if not result.successful:
                # A value that does not fit the bending model or other parameters is refused with the reason.
                assert result.reason
                continue
            assert cloth.simulation.scene.parameters()[name] != value, "not before its frame"
            cloth.tick()
            assert cloth.simulation.scene.parameters()[name] == value
            assert (
                Scene.from_parameters({"cloth.resolution": [6, 7]}).changed({name: value}).parameters()[name] == value
            )


def other_value(entry: Any, value: Any) -> Any:
    if entry.kind == "bool":
        return not value
    if entry.choices:
        return next(choice for choice in entry.choices if choice != value)
    if entry.kind == "string":
        return f"other_{value}"
    if entry.is_array:
        return ("left", "3") if entry.element == "string" else tuple(0.5 * component + 0.25 for component in value)
    return 0.9 * value if value else 0.001 * entry.max**0.5


def test_use_sim_time_is_fixed_at_start(client: Client) -> None:
    with ClockedCloth(client) as cloth:
        for value in (False, True):
            (result,) = cloth.node.node.set_parameters([Parameter("use_sim_time", value=value)])
            assert result.successful is value, "the same once more changes nothing"
        assert "use_sim_time can't change while the cloth runs; set it at start" in (
            cloth.node.node.set_parameters([Parameter("use_sim_time", value=False)])[0].reason
        )
        cloth.tick(2)


def test_misspelt_qos_override_gives_a_warning(client: Client, capfd: pytest.CaptureFixture[str]) -> None:
    right = "qos_overrides./cloth_sim/points.publisher.reliability"
    wrong = "qos_overrides./cloth_sim/pionts.publisher.reliability"
    with ClockedCloth(client, {right: "best_effort", wrong: "best_effort"}):
        pass
    output = capfd.readouterr().err
    assert f"there is no parameter '{wrong}', what sets it has no effect; did you mean '{right}'?" in output
    assert f"'{right}', what sets" not in output


def test_a_file_of_all_parameters_starts_the_same_cloth(client: Client, tmp_path: Path) -> None:
    # Like `ros2 param dump`: every parameter, also those at their defaults.
    scene = Scene.from_parameters(
        {"cloth.resolution": [5, 6], "material.density": 0.123456789012345678, "grippers": ["left", "right"],
         "cloth.anchors": ["top_left", "3"], "tolerance": 2e-5, "gravity": [0.0, 1e-7, -9.80665]}
    )  # fmt: skip
    path = tmp_path / "all.yaml"
    path.write_text(parameter_file.dump(scene.parameters()))
    assert Scene.from_file(path) == scene
    node = reading(client, path)
    assert declare(node) == scene
    node.destroy_node()


#: Plain scalars that YAML 1.1 and ROS's parser interpret, not always alike.
PLAIN = [
    "1e-5", "1.0e-5", "-.5", "5.", "+3.0", "1E3", "1e3", "0x10", "010", "08", "-7", "0", "1_000", "1_000.0", "12:30",
    "2026-11-21", ".inf", "y", "n", "Y", "yes", "On", "off", "TRUE", "tRUE", "left", "'1e3'", "'y'", "1.2.3", "e5",
    "--1",
]  # fmt: skip


def test_plain_scalars_have_same_meaning_without_ros(client: Client, tmp_path: Path) -> None:
    path = tmp_path / "scalars.yaml"
    lines = "\n".join(f"    v{index}: {text}" for index, text in enumerate(PLAIN))
    path.write_text(f"/**:\n  ros__parameters:\n{lines}\n")
    node = reading(client, path)
    without = parameter_file.read(path)
    for index, text in enumerate(PLAIN):
        value = node.get_parameter(f"v{index}").value
        assert (without[f"v{index}"], type(without[f"v{index}"])) == (value, type(value)), text
    node.destroy_node()


def test_written_values_are_read_back_with_and_without_ros(client: Client, tmp_path: Path) -> None:
    values = {f"v{index}": text for index, text in enumerate(PLAIN)}
    values |= {"f0": 1e-5, "f1": 1e300, "f2": 2.3e-308, "f3": -0.1, "i0": -(2**63), "b0": True, "l0": ["y", "1e3"]}
    path = tmp_path / "written.yaml"
    path.write_text(parameter_file.dump(values))
    assert parameter_file.read(path) == values
    node = reading(client, path)
    assert {name: node.get_parameter(name).value for name in values} == values
    node.destroy_node()


def reading(client: Client, path: Path) -> Node:
    """A node with a parameter file."""
    arguments = ["--ros-args", "--params-file", str(path)]
    options: dict[str, Any] = {"cli_args": arguments, "automatically_declare_parameters_from_overrides": True}
    return Node("cloth_sim", context=client.context, **options)


def test_new_parameters_are_set_one_after_another(client: Client) -> None:
    with ClockedCloth(client) as cloth:
        node = cloth.node.node
        changes = {"post.shape": "sphere", "post.size": [0.05], "gripper.max_speed": 1.0}
        results = node.set_parameters([Parameter(name, value=value) for name, value in changes.items()])
        assert [result.reason for result in results] == [""] * 3
        assert node.get_parameter("gripper.max_speed").value == 1.0
        with pytest.raises(UnknownParametersError, match=r"there is no parameter 'gravty'.*gravity"):
            node.set_parameters([Parameter("gravty", value=[0.0, 0.0, 0.0])])


def test_parameters_that_fail_in_their_frame_are_set_back(client: Client, capfd: pytest.CaptureFixture[str]) -> None:
    with ClockedCloth(client) as cloth:
        cloth.tick()
        assert cloth.node.node.set_parameters([Parameter("air.drag", value=3.0)])[0].successful
        # Accepted by another way, without the node's check.
        cloth.node.stepper.queue.put(SetParameters({"step": 0.5}))
        cloth.tick(2)
        assert cloth.node.node.get_parameter("air.drag").value == 0.2
        assert cloth.simulation.scene.air.drag == 0.2
    assert "parameters are set back (air.drag): step 0.5 s is above the stability limit" in capfd.readouterr().err


def test_shape_by_the_name_of_a_camera_or_gripper_is_refused(client: Client) -> None:
    values = {"cameras": ["front"], "grippers": ["left"], "left.max_speed": 5.0, "left.frame": "tool"}
    with ClockedCloth(client, values) as cloth:
        node = cloth.node.node
        for name, kind in (("front", "camera"), ("left", "gripper")):
            result = node.set_parameters([Parameter(f"{name}.shape", value="box")])[0]
            assert result.reason.startswith(f"'{name}' names a {kind} and an obstacle; give the ")
            assert not node.has_parameter(f"{name}.shape")
        assert node.get_parameter("left.max_speed").value == 5.0
        assert node.has_parameter("front.position")


def test_new_parameters_may_be_set_twice_at_once(client: Client) -> None:
    with ClockedCloth(client) as cloth:
        node = cloth.node.node
        for name, values in (("post.shape", ["box", "sphere"]), ("gripper.max_speed", [1.0, 2.0])):
            assert node.set_parameters_atomically([Parameter(name, value=value) for value in values]).successful
            assert node.get_parameter(name).value == values[1]
