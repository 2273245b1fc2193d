# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fabrics: named sets of material parameters with their source, from the package or from a file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import attrs

from cloth_sim_ros.scene import input_file, sections
from cloth_sim_ros.scene.files import FABRIC, file_content, is_fabric_file
from cloth_sim_ros.scene.parameters import declare, ros_yaml
from cloth_sim_ros.scene.parameters.declare import Faults, ParameterError

_FILE = Path(__file__).with_name("fabrics.yaml")
_FIELDS = ("title", "source", "licence", "drape_coefficient", "thickness", "parameters")


@attrs.frozen(kw_only=True)
class Fabric:
    """Named fabric: title, source and licence of its values, and the parameters that it sets."""

    name: str
    title: str = ""
    #: Publication or laboratory of the values, and their licence.
    source: str = ""
    licence: str = ""
    #: Smallest and largest coefficient of the Cusick drape test, 30 cm on 18 cm; None if it is not known.
    drape_coefficient: tuple[float, float] | None = None
    #: Thickness [m]; None if it is not known.
    thickness: float | None = None
    #: Values by full name, e.g. ``material.density``.
    parameters: dict[str, Any] = attrs.field(factory=dict)


@cache
def fabrics() -> dict[str, Fabric]:
    """Return the package's fabrics by name, read from its file once and cached."""
    tree = ros_yaml.load(_FILE.read_text(encoding="utf-8"))
    return {name: _fabric(name, content) for name, content in tree.items()}


def fabric_parameters(
    values: Mapping[str, Any], files: Mapping[str, bytes], folder: str | Path = "."
) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Return the parameters that `material.fabric` sets, and its file's content by name; read that file if necessary.

    Args:
        values: given parameters by full name.
        files: content of files that is already loaded.
        folder: base of a relative file name.

    Raises:
        ParameterError: for an unknown fabric, or a file that can't be read or has invalid values.
    """
    name = values.get(FABRIC)
    if not isinstance(name, str) or not name:
        return {}, {}
    if not is_fabric_file(name):
        if name not in fabrics():
            raise ParameterError(
                f"{FABRIC} is '{name}'; it must be one of {', '.join(fabrics())}, or the path of a file, e.g. "
                f"./{name}.yaml"
            )
        return dict(fabrics()[name].parameters), {}
    content = files[name] if name in files else file_content(FABRIC, Path(folder) / name)
    return dict(read_fabric(name, content).parameters), {name: content}


def with_changes(values: Mapping[str, Any], changes: Mapping[str, Any], files: Mapping[str, bytes]) -> dict[str, Any]:
    """Return a scene's values after changes; a changed fabric also removes the values that the former one set.

    A changed fabric replaces the values of the former one, and every other value that it sets.

    Args:
        values: all values of the scene by full name.
        changes: values that replace them.
        files: content of the files that both name.

    Raises:
        ParameterError: as `fabric_parameters`.
    """
    if FABRIC not in changes:
        return {**values, **changes}
    former = fabric_parameters(values, files)[0]
    remaining = {name: value for name, value in values.items() if name not in former}
    return {**remaining, **fabric_parameters(changes, files)[0], **changes}


def read_fabric(name: str, content: bytes) -> Fabric:
    """Parse the content of a fabric's file, a YAML of the fields of `Fabric`; raise ParameterError if it is invalid.

    Args:
        name: name of the file, for errors.
        content: bytes of the file.

    Raises:
        ParameterError: naming the file and the fault.
    """
    import yaml

    if len(content) > input_file.MAX_TEXT:
        raise ParameterError(f"{FABRIC} '{name}' has {len(content)} bytes; at most {input_file.MAX_TEXT} are read")
    try:
        return _fabric(name, ros_yaml.load(content.decode()))
    except UnicodeDecodeError as error:
        raise ParameterError(f"{FABRIC} '{name}' is no text in UTF-8: {error}") from error
    except yaml.YAMLError as error:
        raise ParameterError(f"{FABRIC} '{name}' is no YAML: {error}") from error
    except ParameterError as error:
        raise ParameterError("\n".join(f"{FABRIC} '{name}': {sentence}" for sentence in error.sentences)) from error


def _fabric(name: str, content: Any) -> Fabric:
    """Build a fabric from a parsed YAML tree; raise ParameterError that names all missing or invalid fields.

    Raises:
        ParameterError: for missing or invalid fields.
    """
    if not isinstance(content, dict) or not isinstance(content.get("parameters"), dict):
        raise ParameterError(
            "it has no parameters; write 'parameters:' and below it lines such as 'material.density: 0.2'"
        )
    faults = Faults()
    faults.add(f"unknown field '{field}'; there are {', '.join(_FIELDS)}" for field in content if field not in _FIELDS)
    for field in ("title", "source", "licence"):
        if not isinstance(content.get(field, ""), str):
            faults.add([f"{field} is {content[field]!r}; it must be a text"])
    thickness = content.get("thickness")
    if thickness is not None and not (_is_number(thickness) and thickness > 0.0):
        faults.add([f"thickness is {thickness!r}; it must be a number of metres above 0"])
    drape = content.get("drape_coefficient")
    if drape is not None and not (
        isinstance(drape, list) and len(drape) == 2 and all(map(_is_number, drape)) and 0.0 <= drape[0] <= drape[1] <= 1
    ):
        faults.add([f"drape_coefficient is {drape!r}; it must be the smallest and the largest one, from 0 to 1"])
    values = {str(key): value for key, value in content["parameters"].items()}
    parameters = faults.collect(lambda: declare.check(_fabric_declarations(), values))
    faults.refuse()
    return Fabric(
        name=name,
        title=content.get("title", ""),
        source=content.get("source", ""),
        licence=content.get("licence", ""),
        drape_coefficient=None if drape is None else (float(drape[0]), float(drape[1])),
        thickness=None if thickness is None else float(thickness),
        parameters=parameters,
    )


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


@cache
def _fabric_declarations() -> tuple[declare.Parameter, ...]:
    """Return the declarations of parameters that a fabric may set: material, membrane, bending without rest angles."""
    entries = [
        *declare.declarations(sections.MaterialParameters, "material."),
        *declare.declarations(sections.MembraneParameters, "membrane."),
        *declare.declarations(sections.BendingParameters, "bending."),
    ]
    refused = (FABRIC, "bending.rest_angles")
    return tuple(entry for entry in entries if entry.name not in refused)
