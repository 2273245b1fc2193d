# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parameter files: matching sections, their order, and refusals."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import yaml

from cloth_sim_ros.scene.parameters import parameter_file, ros_sections, ros_yaml
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.scene import Scene


def sections(*named: tuple[str, str]) -> str:
    return "".join(f"{name}:\n  ros__parameters: {content}\n" for name, content in named)


def test_sections_of_one_name_are_one() -> None:
    text = sections(("/**", "{rate: 30.0, step: 0.01}"), ("/**", "{rate: 20.0}"))
    assert parameter_file.parse(text) == {"rate": 20.0, "step": 0.01}


def test_a_group_that_is_given_twice_is_one() -> None:
    text = "/**:\n  ros__parameters:\n    cloth: {mesh: a}\n    rate: 3.0\n    cloth: {springs: b}\n"
    assert parameter_file.parse(text) == {"cloth.mesh": "a", "rate": 3.0, "cloth.springs": "b"}


def test_last_section_wins_even_over_the_node_name() -> None:
    assert parameter_file.parse(sections(("cloth_sim", "{rate: 1.0}"), ("/**", "{rate: 2.0}")))["rate"] == 2.0
    text = sections(("/**", "{rate: 1.0}"), ("cloth_sim", "{rate: 2.0}"), ("/**", "{rate: 3.0}"))
    assert parameter_file.parse(text)["rate"] == 2.0


def test_section_matches_full_node_name() -> None:
    text = sections(("/left/towel", "{rate: 1.0}"), ("/right/towel", "{rate: 2.0}"))
    assert parameter_file.parse(text, node="/left/towel") == {"rate": 1.0}
    assert parameter_file.parse(text, node="right/towel") == {"rate": 2.0}
    text = sections(("cloth_sim", "{rate: 1.0}"), ("/ns/cloth_sim", "{rate: 2.0}"))
    assert parameter_file.parse(text) == {"rate": 1.0}
    assert parameter_file.parse(text, node="/ns/cloth_sim") == {"rate": 2.0}
    assert parameter_file.parse("ns: {cloth_sim: {ros__parameters: {rate: 3.0}}}", node="/ns/cloth_sim")["rate"] == 3.0
    # A file of other nodes sets nothing, as in ROS.
    assert parameter_file.parse(sections(("other", "{rate: 1.0}"))) == {}


def test_same_node_name_in_other_namespace_is_reported() -> None:
    text = sections(("/left/towel", "{rate: 1.0}"), ("/right/towel", "{rate: 2.0}"))
    with pytest.raises(ParameterError) as caught:
        parameter_file.parse(text, node="towel", source="a.yaml")
    assert str(caught.value) == (
        "'a.yaml' sets nothing for the node /towel, but for /left/towel, /right/towel: give the node's full name, "
        "--node /left/towel or node='/left/towel'"
    )


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            "/**: {ros__parameters: &a {b: *a}}",
            "an alias, which ROS does not read: write out what it stands for (line 1)",
        ),
        ("/**: {ros__parameters: " + "{a: " * 3000 + "1" + "}" * 3001 + "}", "names nested more than 100 deep"),
        ("{a: " * 3000 + "1" + "}" * 3000, "names nested more than 100 deep"),
        (
            "/**:\n  ros__parameters:\n    cloth:\n    rate: 1.0\n",
            "no value for cloth; give one, or leave 'cloth:' out",
        ),
        (
            "/**:\n  ros__parameters: {cloth: {}}\n",
            "no parameter below 'cloth:'; give one, or leave 'cloth:' out (line 2)",
        ),
        ("/**:\n  ros__parameters:\n", "no parameters below the 'ros__parameters:' of '/**:'"),
        ("/**:\n  ros__parameters: {a: 1, a: {b: 2}}\n", "'a' both as a value and as a group"),
        ("/**:\n  ros__parameters: {a: {b: 2}, a: 1}\n", "'a' both as a value and as a group"),
        (
            "/**:\n  ros__parameters: {a: [1, 2.0, x]}\n",
            "different types, int and double and string; give all one type",
        ),
        ("/**:\n  ros__parameters: {a: [[1], [2]]}\n", "a list or group within the list a"),
        ("/**:\n  ros__parameters: {a: [{b: 1}]}\n", "a list or group within the list a"),
        ("/**:\n  ros__parameters: {}\n  rate: 1.0\n", "'rate:' behind the 'ros__parameters:' of '/**:'"),
        (
            "/**: {ros__parameters: {a: {b.c: {d: 1}, e: 2}}}\n",
            "the group 'b.c' with a . within 'a:'; write a group in",
        ),
        ("ros__parameters: {rate: 1.0}\n", "is no parameter file"),
        ("2x: {ros__parameters: {rate: 1.0}}\n", "the node name '2x:'; names are of letters"),
        ("ns: {a/b: {ros__parameters: {rate: 1.0}}}\n", "with a / within 'ns:'; write the whole name as one"),
        ("? [a]\n: {ros__parameters: {rate: 1.0}}\n", "a key that is no name"),
        ("/**: {ros__parameters: {rate: [1.0", "is not YAML"),
    ],
)
def test_text_that_ros_misreads_is_refused_with_line(text: str, words: str) -> None:
    with pytest.raises(ParameterError) as caught:
        parameter_file.parse(text)
    assert words in str(caught.value)


def test_too_deeply_nested_yaml_is_refused() -> None:
    import yaml

    with pytest.raises(yaml.YAMLError, match="nested too deeply"):
        ros_yaml.load("[" * 3000 + "]" * 3000)


@pytest.mark.parametrize(("text", "line"), [("a: 1\nb: 2\na: 3\n", 3), ("s:\n  - x: 1\n    x: 1\n", 3)])
def test_a_key_that_is_given_twice_is_refused_with_its_line(text: str, line: int) -> None:
    with pytest.raises(yaml.YAMLError, match=f"given twice, in line {line} again"):
        ros_yaml.load(text)
    assert ros_yaml.load("s:\n  - x: 1\n  - x: 1\n") == {"s": [{"x": 1}, {"x": 1}]}


def test_repeated_values_are_written_without_aliases() -> None:
    names = ["left", "right"]
    text = parameter_file.dump({"grippers": names, "cloth.anchors": names})
    assert parameter_file.parse(text) == {"grippers": names, "cloth.anchors": names}


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("null", "null"),
        ("0x1F", 31),
        ("-0x1f", -31),
        ("017", 15),
        ("08", 8.0),
        ("99999999999999999999", 1e20),
        ("9" * 5000, "9" * 5000),
        ("1e400", "1e400"),
        ("0x1p3", 8.0),
        ("1_000", "1_000"),
        ("-.inf", -math.inf),
        ("Infinity", math.inf),
        ("-.nan", "-.nan"),
        ("On", True),
        ("oN", "oN"),
    ],
)
def test_plain_value_is_parsed_as_in_c(text: str, value: object) -> None:
    parsed = ros_yaml.parse_plain_scalar(text)
    assert (parsed, type(parsed)) == (value, type(value))


def test_a_text_ends_at_a_null_character() -> None:
    assert parameter_file.parse('/**: {ros__parameters: {frame_id: "a\\0b"}}') == {"frame_id": "a"}


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="no device here never ends")
def test_a_device_that_never_ends_is_refused() -> None:
    with pytest.raises(ParameterError, match="'/dev/zero' is a device or a pipe; name a file on disk"):
        Scene.from_file("/dev/zero")


def test_shipped_file_finds_its_mesh_from_any_folder(tmp_path: Path) -> None:
    path = Path(__file__).parents[2] / "config" / "stack.yaml"
    assert Scene.from_file(path).files.keys() == {"stack.obj"}


@pytest.mark.parametrize(
    "values",
    [
        {"rate": 60.0, "frame_id": "world"},
        {"rate": 60.0, "air.drag": 0.0, "cloth.size": (1.0, 2.0), "note": "a long text " * 20},
        {"air.drag": -0.0, "cloth.size": (1, 2), "last": True, "cloth.anchors": ()},
    ],
)
def test_sectionwise_dump_equals_whole_dump(values: dict[str, Any]) -> None:
    tree: dict[str, Any] = {}
    for name, value in values.items():
        section, _, last = name.rpartition(".")
        (tree.setdefault(section, {}) if section else tree)[last] = list(value) if isinstance(value, tuple) else value
    for node in ("/**", "/left/towel", "x" * 200):
        assert parameter_file.dump(values, node=node) == ros_yaml.dump({node: {ros_sections.KEY: tree}})
