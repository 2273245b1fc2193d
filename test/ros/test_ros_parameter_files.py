# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parameter files: the same meaning without ROS as with ROS's parser, or a refusal."""

from __future__ import annotations

from array import array
from pathlib import Path
from typing import Any

import pytest
import rclpy
from rclpy.context import Context
from rclpy.node import Node

from cloth_sim_ros.scene.parameters import parameter_file
from cloth_sim_ros.scene.parameters.declare import ParameterError

#: Parameters that rclpy declares itself.
_OF_ROS = ("use_sim_time", "start_type_description_service")


def sections(*named: tuple[str, str]) -> str:
    return "".join(f"{name}:\n  ros__parameters: {content}\n" for name, content in named)


def of_ros(path: Path, *, name: str, namespace: str) -> dict[str, Any] | None:
    """Return the parameters that an rclpy node gets from a file; None if the node does not start."""
    context = Context()
    try:
        rclpy.init(args=["--ros-args", "--params-file", str(path)], context=context)
    except RuntimeError:
        return None
    try:
        node = Node(
            name,
            namespace=namespace,
            context=context,
            enable_rosout=False,
            start_parameter_services=False,
            automatically_declare_parameters_from_overrides=True,
        )
        names = [entry for entry in node.list_parameters([], 0).names if entry not in _OF_ROS]
        values = {entry: node.get_parameter(entry).value for entry in names}
        node.destroy_node()
    finally:
        rclpy.shutdown(context=context)
    return {entry: list(value) if isinstance(value, array) else value for entry, value in values.items()}


#: Files that both readers read alike.
ALIKE = [
    sections(("/**", "{a: 1, b: 2}"), ("/**", "{b: 3}")),
    sections(("/**", "{cloth: {a: 1, b: 2}, c: 1, cloth: {b: 3, d: 4}}")),
    sections(("towel", "{a: 1}"), ("/**", "{a: 2}")),
    sections(("/**", "{a: 1}"), ("towel", "{a: 2}"), ("/**", "{a: 3, b: 3}")),
    sections(("/towel", "{a: 1}"), ("towel", "{a: 2, b: 2}"), ("/towel", "{a: 3}")),
    sections(("towel", "{a: 1, b: 1}"), ("/ns/towel", "{a: 2}"), ("/left/ns/towel", "{a: 3}"), ("ns", "{a: 4}")),
    "ns: {towel: {ros__parameters: {a: 1}}, other: {ros__parameters: {a: 2}}}\ntowel: {ros__parameters: {b: 1}}\n",
    "ns: {towel: {ros__parameters: {a: 1}}, ros__parameters: {b: 2}}\n",
    sections(("/**", "{a: 1}")) + "---\n" + sections(("/**", "{b: 1}")),
    sections(
        ("/*", "{a: 1}"), ("'*'", "{b: 1}"), ("/*/towel", "{c: 1}"), ("/**/towel", "{d: 1}"), ("/ns/**", "{e: 1}")
    ),
    sections(("/**/*", "{a: 1}"), ("/*/*", "{b: 1}"), ("'**'", "{c: 1}"), ("/**/ns/towel", "{d: 1}")),
    # Among values of several types the first in a fixed order counts, if the name is not nested.
    sections(("/**", "{a: 1.0, a: 2, b: 3, b: 4.0, c: x, c: [1, 2], d: [1], d: [], e: {f: 1, f: 2.0}}")),
    sections(("/**", "{a: 1}"), ("towel", "{a: 2.5}")),
    sections(("/**", "{a.b: 1, a: {b: 2.0}, a.b: 3}")),
    sections(("/**", "{a.b: {c: 1, d.e: 2}, f: 3, g: {h.i: 4, j: 5}}")),
    sections(("/**", '{a: "\\0", b: "x\\0y", "k\\0z": 1}')),
    sections(("/**", "{a: !!str 5, b: !other 3, c: !!float 4, d: &name 5}")),
    sections(("/**", "{a: null, b: ~, c: '', d: 0x1F, e: 017, f: 1e400, g: 99999999999999999999, h: 0x1p3}")),
    sections(("/**", "{a: infinity, b: ' 5', c: +5, d: 08, e: -.INF, f: 1_000, h: 2001-01-01, i: .5, j: 5.}")),
    sections(("/**", "{a: [yes, No, off], b: [1, 0x10], c: [.5, 1e3], d: [x, '1', \"true\"], e: [y, n]}")),
    "/**:\n  ros__parameters:\n    a: |\n      5\n    b: >-\n      5\n    c: >-\n      true\n",
    "/**:\n  ros__parameters:\n    a: 12:30\n",
    "/**:\n  ros__parameters_of: {a: 5}\n",
    sections(("/**", "{}")),
    "towel: {}\n" + sections(("/**", "{a: 1}")),
    "",
    "# nothing\n",
    "{}",
]
#: Files that both readers refuse.
REFUSED = [
    "[a]",
    "/**:\n  ros__parameters:\n",
    "/**:\n  ros__parameters:\n    cloth:\n    rate: 3.0\n",
    "/**:\n  ros__parameters:\n    cloth: {}\n    rate: 3.0\n",
    "/**:\n  ros__parameters: &a {b: *a}\n",
    sections(("/**", "{a: [1, 2.0]}")),
    sections(("/**", "{a: [[1, 2], [3]]}")),
    sections(("/**", "{a: 1}"), ("other", "{b: [1, x]}")),
    sections(("/**", "{a}")),
    sections(("/**", "{'': 1}")),
    sections(("/**", "{a: [x, , y]}")),
    sections(("2x", "{a: 1}")),
    sections(("a b", "{a: 1}")),
    sections(("a//b", "{a: 1}")),
    sections(("ns/", "{a: 1}")),
    sections(("/n*/towel", "{a: 1}")),
    "/**:\n  ros__parameters: {a: 5}\n  ros__parameters: {b: 5}\n",
    "/**:\n  ros__parameters: {a: 5}\n  b: 5\n",
    "a: 3\n" + sections(("/**", "{a: 1}")),
    "/**: [1",
]


@pytest.mark.parametrize("namespace", ["", "/ns", "/left/ns"])
@pytest.mark.parametrize("text", ALIKE)
def test_file_has_same_meaning_without_ros(tmp_path: Path, text: str, namespace: str) -> None:
    path = tmp_path / "file.yaml"
    path.write_text(text)
    expected = of_ros(path, name="towel", namespace=namespace)
    assert expected is not None
    try:
        values = parameter_file.read(path, node=f"{namespace}/towel")
    except ParameterError as error:
        if "sets nothing for the node" not in str(error):
            raise
        # Except other nodes of the same name.
        values = {}
    typed = {name: (value, type(value)) for name, value in values.items()}
    assert typed == {name: (value, type(value)) for name, value in expected.items()}


@pytest.mark.parametrize("text", REFUSED)
def test_a_file_that_ros_refuses_is_refused_without_it(tmp_path: Path, text: str) -> None:
    path = tmp_path / "file.yaml"
    path.write_text(text)
    assert of_ros(path, name="towel", namespace="") is None
    with pytest.raises(ParameterError):
        parameter_file.read(path, node="/towel")
