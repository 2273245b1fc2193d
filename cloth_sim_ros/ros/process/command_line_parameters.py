# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parameters and parameter files of a ROS command line."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from cloth_sim_ros.scene.parameters import parameter_file, ros_sections, ros_yaml
from cloth_sim_ros.scene.parameters.declare import ParameterError

_ASSIGN = ":="


def command_line_parameters(argv: Sequence[str], *, node: str = "cloth_sim") -> dict[str, Any]:
    """Return the parameters that a command line and its parameter files set for a node, by name; needs no ROS.

    The last value counts.

    Unreadable values and files are left out: the node refuses them with its own message.

    Args:
        argv: a command line.
        node: the node's name unless the command line renames it.
    """
    rules = list(_rules(argv))
    name = _full_name([value for kind, value in rules if kind == "remap"], node)
    settings = [(kind, value) for kind, value in rules if kind != "remap"]
    if not settings:
        return {}
    import yaml

    values: dict[str, Any] = {}
    for kind, value in settings:
        with contextlib.suppress(ParameterError, yaml.YAMLError, ValueError):
            values |= parameter_file.read(value, node=name) if kind == "file" else _assignment(value, name)
    return values


def unused_files(arguments: Sequence[str], *, node: str) -> Iterator[str]:
    """Yield a sentence for each parameter file that only holds parameters of other nodes.

    Args:
        arguments: the command line.
        node: full name of the node, after remapping.
    """
    for option, path in pairwise(arguments):
        # ROS has read a pipe already.
        if option != "--params-file" or not Path(path).is_file():
            continue
        try:
            owners = parameter_file.other_nodes(parameter_file.read_text(path), node=node, source=path)
        except ParameterError:
            # ROS has accepted the file: the two readers differ in what they refuse.
            continue
        if owners:
            yield f"'{path}' sets nothing for the node {node}: {owners.partition(', or give the name')[0]}"


def _rules(argv: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield kind and text of each parameter, parameter file and remapping among the ROS arguments, in order."""
    kinds = {"-p": "parameter", "--param": "parameter", "--params-file": "file", "-r": "remap", "--remap": "remap"}
    arguments = iter(argv)
    ros = False
    for argument in arguments:
        if argument == "--ros-args":
            ros = True
        elif argument == "--":
            ros = False
        elif ros and argument in kinds:
            yield kinds[argument], next(arguments, "")


def _full_name(remappings: Sequence[str], node: str) -> str:
    """Return a node's full name after remapping, without the leading slash; the first of several rules counts."""
    names = {"__node": node, "__ns": "/"}
    for rule in reversed(remappings):
        name, assigned, value = rule.partition(_ASSIGN)
        key = name.rpartition(":")[2].replace("__name", "__node")
        if assigned and key in names:
            names[key] = value
    return "/".join(part for part in (names["__ns"].strip("/"), names["__node"]) if part)


def _assignment(rule: str, node: str) -> dict[str, Any]:
    """Return the parameter that a rule `[node:]name:=value` sets, as {name: value}; empty if it is another node's."""
    name, assigned, text = rule.partition(_ASSIGN)
    section, _, name = name.rpartition(":")
    if not assigned or (section and not ros_sections.matches(section, node)):
        return {}
    return {name: ros_yaml.load(text)}
