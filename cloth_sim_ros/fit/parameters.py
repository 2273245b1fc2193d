# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fittable parameters: their names, search ranges and scenes."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping, Sequence
from typing import Any

import attrs

from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.parameters.warnings import ineffective_parameters
from cloth_sim_ros.scene.scene import Scene

#: Full names by short name.
_SHORT = {
    "stretch": "material.stretch_modulus",
    "stretch_weft": "material.stretch_modulus_weft",
    "shear": "material.shear_modulus",
    "bending_friction": "bending.friction_moment",
    "poisson": "material.poisson_ratio",
    "damping": "material.damping",
    "viscosity": "material.viscosity",
    "density": "material.density",
    "drag": "air.drag",
    "normal_drag": "wind.normal_drag",
    "tangential_drag": "wind.tangential_drag",
    "added_mass": "air.added_mass",
    "friction": "contact.friction",
}
#: Full names, of springs and of hinges, by short name: the scene's bending model chooses.
_BENDING = {
    "bending": ("bending.stiffness", "material.bending_modulus"),
    "bending_weft": ("bending.stiffness_weft", "material.bending_modulus_weft"),
}
#: Further full names; each obstacle of the scene adds `<obstacle>.friction`.
_GRIPPER_NAMES = ("gripper.stiffness", "gripper.damping", "gripper.friction")
_OTHER_NAMES = (
    *("material.bending_modulus", "material.bending_modulus_weft"),
    *("bending.stiffness", "bending.stiffness_weft"),
    "bending.yield_curvature",
    "contact.damping",
    *_GRIPPER_NAMES,
)
#: Parameters of motion alone: in still air they do not act on a cloth at rest.
_OF_MOTION = frozenset(
    {
        "material.damping",
        "material.viscosity",
        "contact.damping",
        "gripper.damping",
        "air.drag",
        "air.added_mass",
        "wind.normal_drag",
        "wind.tangential_drag",
    }
)
#: Ratio of the search limits to the starting value.
SEARCH_FACTOR = 100.0


class FitError(ValueError):
    """Error: a fit is impossible; the message gives cause and remedy."""


@attrs.frozen(kw_only=True)
class FitParameter:
    """Fitted parameter: its name, unit, starting value and limits.

    For an array (static and kinetic friction) the first entry is fitted; the others keep their ratio to it.
    """

    #: Full name, e.g. ``material.stretch_modulus``.
    name: str
    unit: str
    #: Starting value, above 0, in `unit`.
    start: float
    #: Limits of the search, in `unit`.
    minimum: float
    maximum: float

    @property
    def short_name(self) -> str:
        """Last part of the name; the full name if the last part is ambiguous."""
        group, _, last = self.name.rpartition(".")
        return self.name if last in ("friction", "stiffness") or group in ("gripper", "contact") else last


def choose_parameters(
    scene: Scene, names: Sequence[str], start: Mapping[str, float] | None = None
) -> list[FitParameter]:
    """Return the fit parameters of a scene by their short or full names. Raises FitError.

    Args:
        scene: provides the starting values.
        names: short or full names.
        start: other starting values, by short or full name.

    Raises:
        FitError: if a name is unknown or given twice, has no effect in the scene, or starts at 0.
    """
    starts = {_full_name(scene, name): float(value) for name, value in (start or {}).items()}
    full_names = [_full_name(scene, name) for name in names]
    if not full_names:
        raise FitError("no parameter is given; e.g. --parameters stretch,shear,bending,damping")
    for name in full_names:
        if full_names.count(name) > 1:
            raise FitError(f"parameter '{name}' is given twice")
    stray = [name for name in starts if name not in full_names]
    if stray:
        raise FitError(f"--start names '{stray[0]}', which is not among the parameters: {', '.join(full_names)}")
    return [_fit_parameter(scene, name, starts.get(name)) for name in full_names]


def scene_with(scene: Scene, parameters: Sequence[FitParameter], values: Sequence[float], **further: Any) -> Scene:
    """Return a copy of a scene with other values of parameters, and of `further` ones. Raises ParameterError.

    Raises:
        ParameterError: if the values are invalid.
    """
    current = scene.parameters()
    changed = dict(further)
    for parameter, value in zip(parameters, values, strict=True):
        current_value = current[parameter.name]
        if isinstance(current_value, tuple):
            ratio = float(value) / current_value[0] if current_value[0] else 0.0
            changed[parameter.name] = tuple(entry * ratio if ratio else float(value) for entry in current_value)
        else:
            changed[parameter.name] = float(value)
    return Scene.from_parameters({**current, **changed}, files=scene.files)


def acts_at_rest(scene: Scene, parameter: FitParameter) -> bool:
    """Return true if a parameter may change the shape of the cloth at rest."""
    return parameter.name not in _OF_MOTION or any(scene.wind.velocity)


def _full_name(scene: Scene, name: str) -> str:
    if name in _BENDING:
        of_springs, of_hinges = _BENDING[name]
        return of_springs if scene.bending.model in ("axial", "opposite") else of_hinges
    frictions = [f"{obstacle}.friction" for obstacle in scene.obstacle_names]
    known = {**_SHORT, **{full_name: full_name for full_name in (*_SHORT.values(), *_OTHER_NAMES, *frictions)}}
    if name in known:
        return known[name]
    close = difflib.get_close_matches(name, [*known, *_BENDING], n=1)
    hint = f"; did you mean '{close[0]}'?" if close else ""
    if name in scene.parameters():
        raise FitError(f"'{name}' is no parameter of the sheet that clouds can identify; {_list_known(frictions)}")
    raise FitError(f"unknown parameter '{name}'{hint or '; ' + _list_known(frictions)}")


def _list_known(frictions: Sequence[str]) -> str:
    return "known parameters: " + ", ".join([*_SHORT, *_BENDING, *_OTHER_NAMES, *frictions])


def _fit_parameter(scene: Scene, name: str, start: float | None) -> FitParameter:
    (entry,) = (entry for entry in scene.entries if entry.name == name)
    current = scene.parameters()[name]
    value = (current[0] if isinstance(current, tuple) else current) if start is None else start
    if not (math.isfinite(value) and value > 0.0):
        _check_effect(scene, name, 0.5 * min(entry.max or 1.0, 1.0))
        remedy = f"a fit needs a start above 0, within a factor of about ten: --start {name}=VALUE"
        raise FitError(f"{name} begins at {value:g}; {remedy}")
    minimum = max(value / SEARCH_FACTOR, entry.min or 0.0)
    maximum = value * SEARCH_FACTOR if entry.max is None else min(value * SEARCH_FACTOR, entry.max)
    if not minimum <= value <= maximum:
        raise FitError(f"{name} begins at {value:g} {entry.unit}; it must be from {entry.min:g} to {entry.max:g}")
    _check_effect(scene, name, value)
    return FitParameter(name=name, unit=entry.unit, start=value, minimum=minimum, maximum=maximum)


def _check_effect(scene: Scene, name: str, value: float) -> None:
    """Raise FitError for a parameter that has no effect in the scene, because other parameters disable it.

    Raises:
        FitError: if the parameter has no effect in the scene.
    """
    probe = FitParameter(name=name, unit="", start=value, minimum=value, maximum=value)
    try:
        # The value must differ from the default, because only set parameters are checked.
        tried = scene_with(scene, [probe], [value * 0.9990234375])
    except ParameterError as error:
        raise FitError(str(error)) from error
    for sentence in ineffective_parameters(tried, [name]):
        raise FitError(sentence.replace(" is set and has", " has", 1) + "; omit it")
