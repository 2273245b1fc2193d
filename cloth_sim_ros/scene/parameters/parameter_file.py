# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""ROS parameter files, read without ROS as a node would read them."""

from __future__ import annotations

import functools
import pickle
from pathlib import Path
from typing import Any

from cloth_sim_ros.scene import input_file
from cloth_sim_ros.scene.input_file import InputFileError
from cloth_sim_ros.scene.parameters import ros_sections, ros_yaml
from cloth_sim_ros.scene.parameters.declare import ParameterError


def read(path: str | Path, *, node: str = "cloth_sim", strict: bool = False) -> dict[str, Any]:
    """Read a ROS parameter file; return the values that apply to a node, by full name, or raise ParameterError.

    Sections with the node's full name or a matching wildcard apply. Sections of one name are merged, in the place of
    the first. If several sections set a parameter, the last one wins, even over the node's own.

    Args:
        path: path of the file.
        node: name of the node with its namespace, e.g. ``/left/towel``.
        strict: refuse a file that sets nothing for this node, but something for others.

    Raises:
        ParameterError: for a file that can't be read, is no YAML or no parameter file, or sets parameters only for
        nodes of this name in other namespaces.
    """
    return parse(read_text(path), node=node, source=str(path), strict=strict)


def read_text(path: str | Path) -> str:
    """Read the text of a parameter file, for `parse`; raise ParameterError if it can't be read or is too large.

    Raises:
        ParameterError: for a file that can't be read, or is too large.
    """
    try:
        text = input_file.read_text(path)
    except InputFileError as error:
        raise ParameterError(f"parameter file {error}") from error
    except (OSError, ValueError) as error:
        raise ParameterError(f"cannot read parameter file '{path}': {error}") from error
    return text


def parse(text: str, *, node: str = "cloth_sim", source: str = "text", strict: bool = False) -> dict[str, Any]:
    """Parse a parameter file's text; return the values that apply to a node; arguments and errors as of `read`."""
    sections = _sections(text, source)
    full = f"/{node.strip('/') or 'cloth_sim'}"
    matching = [content for name, content in sections.items() if ros_sections.matches(name, full)]
    if sections and not matching:
        _refuse_other_namespaces(list(sections), full, source)
    if strict and not matching and (words := other_nodes(text, node=full, source=source)):
        raise ParameterError(f"'{source}' sets nothing for the node {full}; {words}")
    return {name: value for content in matching for name, value in content.items()}


def other_nodes(text: str, *, node: str, source: str) -> str:
    """Return the nodes whose parameters a text sets instead of `node`'s, and a remedy, as a clause; else empty.

    Args:
        text: text of a parameter file.
        node: full name of the node.
        source: name of the file.

    Raises:
        ParameterError: as `parse`.
    """
    sections = _sections(text, source)
    full = f"/{node.strip('/')}"
    owners = [name for name, values in sections.items() if values]
    if not owners or any(ros_sections.matches(name, full) for name in sections):
        return ""
    first = f"/{owners[0].removeprefix('/')}"
    named = "" if "*" in first else f", or give the name, --node {first} or node='{first}'"
    return (
        f"it sets parameters of {', '.join(owners)}: write '/**:', which means every node, or '{full}:' for "
        f"'{owners[0]}:' in the file{named}"
    )


def _sections(text: str, source: str) -> dict[str, dict[str, Any]]:
    import yaml

    try:
        return ros_sections.read(text, source=source)
    except yaml.YAMLError as error:
        raise ParameterError(f"'{source}' is not YAML: {error}") from error


def _refuse_other_namespaces(sections: list[str], node: str, source: str) -> None:
    """Raise ParameterError if sections, none of which applies to a node, name its namesakes in other namespaces."""
    base_name = node.rpartition("/")[2]
    absolute_names = [f"/{name.removeprefix('/')}" for name in sections if "*" not in name]
    full_names = [name for name in dict.fromkeys(absolute_names) if name.rpartition("/")[2] == base_name]
    if full_names:
        raise ParameterError(
            f"'{source}' sets nothing for the node {node}, but for {', '.join(full_names)}: give the node's full name, "
            f"--node {full_names[0]} or node='{full_names[0]}'"
        )


def dump(values: dict[str, Any], *, node: str = "/**") -> str:
    """Return the text of a ROS parameter file that sets the given parameters for a node; floats keep every bit."""
    tree: dict[str, Any] = {}
    for name, value in values.items():
        branch = tree
        *sections, last = name.split(".")
        for part in sections:
            branch = branch.setdefault(part, {})
        branch[last] = list(value) if isinstance(value, tuple) else value
    if not any(isinstance(content, dict | list) for content in tree.values()):
        # A mapping of single values only is written in one line.
        return ros_yaml.dump({node: {ros_sections.KEY: tree}})
    return _head(node) + "".join(_lines(pickle.dumps((name, content))) for name, content in tree.items())


#: Sentinel entry with a nested value, so that the entries before it get lines of their own; it is cut off again. No
#: section has a name with a full stop.
_SENTINEL: dict[str, Any] = {"the.last": []}
_SENTINEL_LINES = "    the.last: []\n"


@functools.lru_cache(maxsize=16)
def _head(node: str) -> str:
    """Return the text of a parameter file before a node's parameters."""
    return ros_yaml.dump({node: {ros_sections.KEY: _SENTINEL}}).removesuffix(_SENTINEL_LINES)


@functools.lru_cache(maxsize=256)
def _lines(entry: bytes) -> str:
    """Return the lines of one group of parameters, which is given as pickled bytes: these distinguish 1 from 1.0.

    The cache pays off because scenes of a study share nearly all sections, and formatting one takes long.
    """
    name, content = pickle.loads(entry)
    text = ros_yaml.dump({"/**": {ros_sections.KEY: {name: content, **_SENTINEL}}})
    return text.removeprefix(_head("/**")).removesuffix(_SENTINEL_LINES)
