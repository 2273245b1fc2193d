# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fabric of a textile test, from a fabric's name, a fabric file or a scene file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import attrs
import yaml

from cloth_sim_ros.laboratory.equilibrium import LaboratoryError
from cloth_sim_ros.scene.fabrics import Fabric, fabrics, read_fabric
from cloth_sim_ros.scene.files import FABRIC, is_fabric_file
from cloth_sim_ros.scene.named_files import named_files
from cloth_sim_ros.scene.parameters import parameter_file, ros_yaml
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.scene import Scene

#: Groups of a scene's parameters that describe its fabric.
_GROUPS = ("material", "membrane", "bending")
#: Parameters of these groups that belong to one sheet.
_SHEET_FABRICS = (FABRIC, "bending.rest_angles", "bending.rest_angle", "bending.flat")


@attrs.frozen(kw_only=True)
class FabricSample:
    """Fabric of a textile test, with its parameters by full name."""

    fabric: Fabric
    #: Every parameter of the fabric by full name, defaults included.
    parameters: dict[str, Any]

    @property
    def title(self) -> str:
        """Readable name of the fabric."""
        return self.fabric.title or self.fabric.name

    @property
    def density(self) -> float:
        """Mass of the fabric per area [kg/m^2]."""
        return float(self.parameters["material.density"])

    def warp_and_weft(self, name: str) -> tuple[float, float]:
        """Return a parameter's values (warp, weft) by the name of the one along warp, which stands for a weft of 0."""
        warp = float(self.parameters[name])
        return warp, float(self.parameters[f"{name}_weft"]) or warp

    def scene(self, values: Mapping[str, Any], files: Mapping[str, bytes] | None = None) -> Scene:
        """Build a scene with a cloth of the fabric, without grippers; raise ParameterError for invalid values.

        Args:
            values: further parameters, which override the fabric's.
            files: content of files that they name.

        Raises:
            ParameterError: for values that make no scene.
        """
        return Scene.from_parameters({"grippers": [""], **self.parameters, **values}, files=files)


def read_sample(source: str, overrides: Mapping[str, Any] | None = None) -> FabricSample:
    """Read the fabric of a test by its name, or from a fabric file or a scene file (ROS parameters), or raise.

    Args:
        source: name of a fabric, or path of a file.
        overrides: parameters of the fabric that replace its own, by full name.

    Raises:
        ParameterError: for an unknown fabric, a file that can't be read, or an invalid value.
        LaboratoryError: for overrides that are no parameters of a fabric, and for a bending modulus without effect.
    """
    fabric = _fabric(source)
    for name in overrides or {}:
        if name.partition(".")[0] not in _GROUPS or name in _SHEET_FABRICS:
            raise LaboratoryError(f"'{name}' is no parameter of a fabric; give one of {', '.join(_GROUPS)}")
    scene = Scene.from_parameters({"cloth.anchors": [""], **fabric.parameters, **(overrides or {})})
    if scene.bending.model == "none" and scene.material.bending_modulus:
        raise LaboratoryError(
            f"bending.model is none, so material.bending_modulus, {scene.material.bending_modulus:g} N m, has no "
            "effect: choose another model, e.g. crossed, or set the modulus to 0.0"
        )
    return FabricSample(fabric=fabric, parameters=_fabric_parameters(scene))


def scene_files_of(source: str) -> list[Path]:
    """Return the files that the scene file of a test names; none for a fabric's name or a fabric file.

    Raises:
        ParameterError: for a file that can't be read.
    """
    if (
        source in fabrics()
        or not Path(source).is_file()
        or "parameters" in _yaml(source, parameter_file.read_text(source))
    ):
        return []
    return named_files(source)


def _yaml(source: str, text: str) -> dict[str, Any]:
    """Return the content of a YAML file; an empty one if it has no members."""
    try:
        content = ros_yaml.load(text)
    except yaml.YAMLError as error:
        raise ParameterError(f"'{source}' is no YAML: {error}") from error
    return content if isinstance(content, dict) else {}


def _fabric(source: str) -> Fabric:
    if source in fabrics():
        return fabrics()[source]
    if not is_fabric_file(source) and not Path(source).exists():
        raise ParameterError(f"'{source}' is neither a file nor a fabric; the fabrics are {', '.join(fabrics())}")
    text = parameter_file.read_text(source)
    if "parameters" in _yaml(source, text):
        return read_fabric(source, text.encode())
    values = parameter_file.parse(text, source=source, strict=True)
    scene = Scene.from_parameters(values, folder=Path(source).parent)
    base = fabrics().get(str(values.get(FABRIC, "")))
    return Fabric(
        name=source,
        title=f"fabric of {Path(source).name}",
        drape_coefficient=None if base is None else base.drape_coefficient,
        parameters=_fabric_parameters(scene),
    )


def _fabric_parameters(scene: Scene) -> dict[str, Any]:
    """Return the parameters of a scene that describe its fabric, by full name."""
    return {
        name: value
        for name, value in scene.parameters().items()
        if name.partition(".")[0] in _GROUPS and name not in _SHEET_FABRICS
    }
