# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Scenes of recorded sessions and states that lack newer parameters."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from cloth_sim_ros.scene import sections
from cloth_sim_ros.scene.parameters import parameter_file
from cloth_sim_ros.scene.parameters.declare import ParameterError

#: Values of parameters that a session lacks. It was recorded before they existed and runs again as it ran then.
LEGACY_VALUES: dict[str, Any] = {"cloth.merge": False, "gripper.max_speed": 0.0, "wind.normal_drag": 0.0}


class RebuildableScene(Protocol):
    """Protocol of a `Scene` that can be built again with other parameters."""

    @property
    def cloth(self) -> sections.ClothParameters: ...

    @property
    def files(self) -> dict[str, bytes]: ...

    def parameters(self) -> dict[str, Any]: ...

    def from_parameters(self, values: dict[str, Any], *, files: Mapping[str, bytes]) -> object: ...


def recorded_values(scene_yaml: str, *, node: str) -> dict[str, Any]:
    """Parse a recorded scene's parameters by full name; those newer than the recording keep the former behaviour.

    Args:
        scene_yaml: parameter file of the scene.
        node: name of its node with the namespace.

    Raises:
        ParameterError: if the text is no parameter file.
    """
    return {**LEGACY_VALUES, **parameter_file.parse(scene_yaml, node=node, source="scene.yaml")}


def merge_hint(scene: RebuildableScene) -> str:
    """Return the end of a sentence that advises `cloth.merge: false`, if the initial state fits then; else empty."""
    if not scene.cloth.mesh or not scene.cloth.merge:
        return ""
    try:
        scene.from_parameters({**scene.parameters(), "cloth.merge": False}, files=scene.files)
    except ParameterError:
        return ""
    return ": vertices of the mesh were merged since; with cloth.merge: false it fits"
