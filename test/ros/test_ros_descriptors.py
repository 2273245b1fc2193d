# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Ranges of parameter descriptors: both ends are accepted, values just outside are refused."""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Iterator
from typing import Any

import pytest
from rclpy.node import Node
from support.ros_client import Client

from cloth_sim_ros import Scene
from cloth_sim_ros.ros.io.parameters import parameter_descriptor
from cloth_sim_ros.scene.parameters.declare import Parameter, ParameterError

DECLARED = {entry.name: entry for entry in Scene.declared(["table"])}
RANGED = [name for name, entry in DECLARED.items() if entry.kind in ("double", "int")]
ARRAYS = [name for name, entry in DECLARED.items() if entry.is_array and entry.element in ("double", "int")]
NUMBERS = itertools.count()
#: Other parameters that give a parameter its full range.
REQUIRED: dict[str, dict[str, Any]] = {
    "material.bending_modulus": {"bending.model": "crossed"},
    "bending.friction_moment": {"bending.model": "crossed", "material.bending_modulus": 1.0},
    "material.bending_modulus_weft": {"bending.model": "crossed", "material.bending_modulus": 1.0},
    "material.stretch_modulus": {"material.shear_modulus": 0.0, "bending.stiffness": 0.0},
    "bending.stiffness": {"material.stretch_modulus": 1e9},
    "bending.stiffness_weft": {"material.stretch_modulus": 1e9},
    "table.size": {"table.shape": "box"},
}


@pytest.fixture(scope="module")
def node() -> Iterator[Node]:
    with Client("descriptors") as client:
        yield client.node


def ends(entry: Parameter) -> tuple[Any, Any]:
    """The ends of a descriptor's range."""
    descriptor = parameter_descriptor(entry)
    (limits,) = descriptor.floating_point_range if entry.kind == "double" else descriptor.integer_range
    return limits.from_value, limits.to_value


def is_accepted(entry: Parameter, value: Any) -> bool:
    """Return true if a cloth accepts a value."""
    for required in ({}, REQUIRED.get(entry.name, {})):
        with contextlib.suppress(ParameterError):
            Scene.from_parameters({"cloth.resolution": [5, 5], **required, entry.name: value})
            return True
    return False


def declare(node: Node, entry: Parameter, value: Any) -> Any:
    """Declare a new parameter with another's descriptor, whose range rclpy checks, and return its value."""
    name = f"p{next(NUMBERS)}"
    return node.declare_parameter(name, value, parameter_descriptor(entry)).value


@pytest.mark.parametrize("name", [name for name in RANGED if not name.startswith("table.")])
def test_ends_of_a_range_are_accepted(node: Node, name: str) -> None:
    entry = DECLARED[name]
    for value in ends(entry):
        assert entry.check(value) == value
        assert is_accepted(entry, value), value
        assert declare(node, entry, value) == value


@pytest.mark.parametrize("name", RANGED)
def test_values_just_outside_a_range_are_refused(node: Node, name: str) -> None:
    entry = DECLARED[name]
    low, high = ends(entry)
    if entry.kind == "double":
        outside = [math.nextafter(low, -math.inf), math.nextafter(high, math.inf), low - 1.0, high * 1.01]
    else:
        outside = [low - 1, high + 1]
    for value in outside:
        with pytest.raises(ParameterError, match=name):
            entry.check(value)
    # rclpy accepts values that it considers equal to an end; the check above covers them.
    for value in (outside[-2], outside[-1]):
        with pytest.raises(Exception, match="out of range"):
            declare(node, entry, value)


@pytest.mark.parametrize("name", ARRAYS)
def test_array_bounds_of_descriptor_match_the_check(name: str) -> None:
    entry = DECLARED[name]
    said = parameter_descriptor(entry).additional_constraints
    if entry.min is None:
        assert entry.constraint in said
        return
    low = f"each above {entry.min} and at most" if entry.excludes_min else f"each from {entry.min} to"
    assert f"{low} {entry.max}" in said
    count = entry.length or 1
    kind = type(entry.default[0])
    assert entry.check([kind(entry.max)] * count)
    if entry.excludes_min:
        with pytest.raises(ParameterError, match="above"):
            entry.check([kind(entry.min)] * count)
    else:
        assert entry.check([kind(entry.min)] * count)


def test_limits_without_range_are_in_constraints() -> None:
    said = {name: parameter_descriptor(entry).additional_constraints for name, entry in DECLARED.items()}
    assert "0.0, or at least 1e-12" in said["tolerance"]
    assert "at most 4000000 particles" in said["cloth.resolution"]
    assert "above 0.0" in said["material.stretch_modulus"]
    for name in ("cloth.orientation", "table.orientation"):
        assert "not all 0" in said[name]
    for name in ("contact.friction", "gripper.friction", "table.friction"):
        assert "the second no larger" in said[name]
    for name in ("frame_id", "gripper.frame", "table.frame"):
        assert "no / as its first character" in said[name]
