# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""ROS parameter files without ROS: `/**` and `<node>: ros__parameters:` are read, other wildcards are refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from cloth_sim_ros.scene import ros_yaml
from cloth_sim_ros.scene.parameters import ParameterError

_KEY = "ros__parameters"


def read(path: str | Path, *, node: str = "cloth_sim") -> dict[str, Any]:
    """Return the parameters that a file sets for a node, by full name; `/**` first, the node's own over it.

    Raises:
        ParameterError: for a file that can't be read, is no YAML or no parameter file.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ParameterError(f"cannot read parameter file '{path}': {error}") from error
    return parse(text, node=node, source=str(path))


def parse(text: str, *, node: str = "cloth_sim", source: str = "text") -> dict[str, Any]:
    """Return the parameters that a text sets for a node; as `read`."""
    import yaml

    try:
        tree = ros_yaml.load(text)
    except yaml.YAMLError as error:
        raise ParameterError(f"'{source}' is not YAML: {error}") from error
    if not isinstance(tree, dict):
        raise ParameterError(f"'{source}' is no parameter file; it needs '/**:' or '{node}:' with '{_KEY}:' below")
    values: dict[str, Any] = {}
    own: dict[str, Any] = {}
    for key, content in tree.items():
        name = str(key).strip("/")
        if "*" in name and name != "**":
            raise ParameterError(f"'{source}' has the wildcard '{key}'; only '/**' and node names are read")
        if not isinstance(content, dict) or not isinstance(content.get(_KEY), dict):
            raise ParameterError(f"'{source}' has no '{_KEY}:' below '{key}:'")
        if name == "**":
            values = _flat(content[_KEY])
        elif name.split("/")[-1] == node.strip("/").split("/")[-1]:
            own = _flat(content[_KEY])
    return {**values, **own}


def dump(values: dict[str, Any], *, node: str = "/**") -> str:
    """Return a parameter file that sets the given parameters; floats keep every bit."""
    tree: dict[str, Any] = {}
    for name, value in values.items():
        branch = tree
        *sections, last = name.split(".")
        for part in sections:
            branch = branch.setdefault(part, {})
        branch[last] = list(value) if isinstance(value, tuple) else value
    return ros_yaml.dump({node: {_KEY: tree}})


def _flat(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    values: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, dict):
            values.update(_flat(value, f"{prefix}{key}."))
        else:
            values[f"{prefix}{key}"] = value
    return values
