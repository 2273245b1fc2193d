# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Checks of combinations of values that make no valid sheet."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from cloth_sim_ros.physics.model.sheets.grid import GridSheet
from cloth_sim_ros.physics.model.sheets.mesh import MeshSheet
from cloth_sim_ros.physics.model.sheets.raw import RawSprings
from cloth_sim_ros.scene import sections
from cloth_sim_ros.scene.bending import bending_forces, friction_of_hinges
from cloth_sim_ros.scene.build import (
    anchored_particles,
    grid_threads_of,
    joined_particles,
    membrane_forces,
    obstacle_joints,
)
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.physics_scene import PhysicsScene, Sheet
from cloth_sim_ros.scene.thread_directions import along_grid, bending_moduli, stretch_moduli

#: Values whose sheets are known to be valid, the last ones first: the check builds all elements of a sheet.
_ACCEPTED: list[tuple[Any, ...]] = []
_MAX_ACCEPTED = 4


def raw_springs_defaults(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the defaults that differ for raw springs, which have no surface: `wind.normal_drag` 0 unless it is set.

    Args:
        values: given parameters, by full name.
    """
    if not values.get("cloth.springs") or "wind.normal_drag" in values:
        return {}
    return {"wind.normal_drag": 0.0}


def check_sheet(scene: PhysicsScene) -> None:
    """Raise ParameterError if a scene's sheet, bending model, anchors, joints or air do not fit together.

    Raises:
        ParameterError: naming the parameter.
    """
    cloth, model, modulus = scene.cloth, scene.bending.model, scene.material.bending_modulus
    if cloth.mesh and cloth.springs:
        raise ParameterError(f"both cloth.mesh '{cloth.mesh}' and cloth.springs '{cloth.springs}' are set; set one")
    bending = scene.bending
    if bending.flat and bending.rest_angle:
        raise ParameterError(f"bending.flat is true and bending.rest_angle {bending.rest_angle} rad; set one of them")
    for path in (cloth.mesh, cloth.springs, bending.rest_angles, scene.initial_state):
        if path and path not in scene.files:
            raise ParameterError(f"the content of '{path}' is missing; build the scene with from_parameters")
    sheet = scene.sheet
    values = _element_values(scene)
    is_accepted = values in _ACCEPTED
    if not is_accepted:
        _check_threads(scene, sheet)
    if isinstance(sheet, GridSheet):
        if scene.membrane.model == "springs":
            grid_threads_of(scene, sheet)
    elif model == "axial" or (isinstance(sheet, RawSprings) and model != "none" and not len(sheet.triangles())):
        has_hinges = len(sheet.triangles()) > 0
        fitting = "none, or give the springs file triangles"
        if has_hinges:
            of_mesh = "" if isinstance(sheet, RawSprings) else ", shape_operator"
            fitting = f"none, opposite, crossed, altitude{of_mesh} or quadratic"
        raise ParameterError(f"bending.model '{model}' is not for this cloth; choose {fitting}")
    anchored_particles(scene, sheet)
    joined_particles(scene, sheet)
    obstacle_joints(scene, sheet)
    if (scene.wind.normal_drag or scene.wind.tangential_drag) and not len(sheet.triangles()):
        raise ParameterError(
            "wind.normal_drag and wind.tangential_drag need a surface; raw springs have none: set both to 0"
        )
    if scene.air.added_mass and not len(sheet.triangles()):
        raise ParameterError(
            f"air.added_mass is {scene.air.added_mass} kg/m^2 and needs a surface; raw springs have none: set it to 0"
        )
    if model in ("axial", "opposite") and (modulus or scene.material.bending_modulus_weft):
        from cloth_sim_ros.physics.model.sheets.bending import refuse_bending_modulus

        try:
            refuse_bending_modulus(model)
        except ValueError as error:
            name = "bending_modulus" if modulus else "bending_modulus_weft"
            fabric = scene.material.fabric
            of_fabric = f", of the fabric '{fabric}'" if fabric else ""
            remedy = "; or set material.bending_modulus and material.bending_modulus_weft to 0.0" if fabric else ""
            raise ParameterError(
                f"material.{name} is {getattr(scene.material, name)} N m{of_fabric}: {error}{remedy}"
            ) from error
    if scene.bending.friction_moment and model not in ("crossed", "altitude", "quadratic"):
        raise ParameterError(
            f"bending.friction_moment is {scene.bending.friction_moment} N, and bending.model '{model}' has no hinges "
            "with a bending modulus; choose crossed, altitude or quadratic, or set bending.friction_moment to 0.0"
        )
    if model in sections.MODULUS_MODELS and not modulus:
        raise ParameterError(
            f"bending model '{model}' needs material.bending_modulus above 0 N m, e.g. 1.0e-5; or choose 'none'"
        )
    if scene.bending.friction_moment and not is_accepted:
        try:
            friction_of_hinges(scene, sheet)
        except ValueError as error:
            raise ParameterError(f"bending.friction_moment is {scene.bending.friction_moment} N: {error}") from error
    if model in ("quadratic", "shape_operator") and not is_accepted:
        try:
            bending_forces(scene, sheet, sheet.masses(1.0), None)
        except ParameterError:
            raise
        except ValueError as error:
            raise ParameterError(f"bending.model is '{model}': {error}") from error
    if model not in ("none", "axial") and (isinstance(sheet, RawSprings) or bending.rest_angles):
        try:
            bending_forces(scene, sheet, sheet.masses(1.0), None)
        except ParameterError:
            raise
        except ValueError as error:
            raise ParameterError(f"cloth.springs '{cloth.springs}': {error}") from error
    if not is_accepted:
        _ACCEPTED[:] = [values, *_ACCEPTED[: _MAX_ACCEPTED - 1]]


def _element_values(scene: PhysicsScene) -> tuple[Any, ...]:
    """Return a tuple of all values on which the elements of a sheet depend: equal for equal sheets."""
    contents = [scene.files.get(path) for path in (scene.cloth.mesh, scene.cloth.springs, scene.bending.rest_angles)]
    return (scene.cloth, scene.material, scene.membrane, scene.bending, *contents)


def _check_threads(scene: PhysicsScene, sheet: Sheet) -> None:
    """Raise ParameterError for moduli of warp and weft that the elements of a sheet can't represent."""
    if scene.membrane.model == "triangles":
        if isinstance(sheet, RawSprings):
            raise ParameterError("membrane.model 'triangles' is not for cloth.springs, which has springs of its own")
        membrane_forces(scene, sheet)
    elif isinstance(sheet, MeshSheet):
        warp, weft = stretch_moduli(scene)
        if warp != weft:
            raise ParameterError(
                f"material.stretch_modulus_weft is {weft} N/m and stretch_modulus {warp} N/m; the springs of a mesh "
                "are alike in all directions: set membrane.model to triangles, or stretch_modulus_weft to 0.0"
            )
    warp, weft = bending_moduli(scene)
    if warp == weft or scene.bending.model not in sections.MODULUS_MODELS:
        return
    if isinstance(sheet, RawSprings):
        raise ParameterError(
            f"material.bending_modulus_weft is {weft} N m and bending_modulus {warp} N m; cloth.springs has no "
            "directions of threads: set bending_modulus_weft to 0.0"
        )
    if not warp > 0.0:
        raise ParameterError(f"material.bending_modulus_weft is {weft} N m without bending_modulus; set both")
    if scene.bending.model == "shape_operator":
        return
    if isinstance(sheet, GridSheet):
        along_grid(scene, (warp, weft), "material.bending_modulus")
    else:
        try:
            bending_forces(scene, sheet, sheet.masses(1.0), None)
        except ValueError as error:
            raise ParameterError(
                f"material.bending_modulus_weft is {weft} N m beside bending_modulus {warp} N m: {error}"
            ) from error
