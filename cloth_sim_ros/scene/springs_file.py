# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files of tables as YAML, or as the arrays of an .npz: raw springs, and rest angles."""

from __future__ import annotations

from typing import Any

from cloth_sim_ros.physics.model.sheets.raw import RawSprings
from cloth_sim_ros.physics.model.sheets.rest_angles import RestAngles
from cloth_sim_ros.physics.state import npz
from cloth_sim_ros.scene.parameters import ros_yaml

#: Largest number of values of a YAML file; larger tables need an .npz.
_MAX_VALUES = 500_000


def parse(data: bytes) -> RawSprings:
    """Parse the bytes of a springs file, YAML or .npz, as raw springs; raise ValueError that names the faulty table.

    Raises:
        ValueError: for bytes in neither format, or tables that make no system; the message names the table.
    """
    return RawSprings.from_tables(_tables(data, "positions, masses, springs and stiffness"))


def parse_rest_angles(data: bytes) -> RestAngles:
    """Parse the bytes of a file of hinges' rest angles, YAML or .npz; raise ValueError that names the faulty table."""
    return RestAngles.from_tables(_tables(data, "edges and angles"))


def _tables(data: bytes, needed: str) -> dict[str, Any]:
    return npz.read(data) if data[:2] == b"PK" else _yaml(data, needed)


def _yaml(data: bytes, needed: str) -> dict[str, Any]:
    import yaml

    try:
        text = data.decode()
        ros_yaml.check_size(text, max_nodes=_MAX_VALUES)
        tree = yaml.load(text, Loader=ros_yaml.parser())
    except (yaml.YAMLError, ValueError, TypeError, AttributeError, LookupError) as error:
        raise ValueError(f"it is no YAML: {error}") from error
    if not isinstance(tree, dict):
        raise ValueError(f"it has no tables; it needs {needed}")
    return {str(name): value for name, value in tree.items()}
