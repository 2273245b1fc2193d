# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Construction of the bending forces of a scene: hinges, triangles, and internal friction."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.arithmetic.deterministic_math import row_sum
from cloth_sim_ros.physics.model.forces.force import Array, Force
from cloth_sim_ros.physics.model.sheets.grid import GridSheet
from cloth_sim_ros.physics.model.sheets.hinge_shape import HingeShape
from cloth_sim_ros.physics.model.sheets.mesh import MeshSheet
from cloth_sim_ros.physics.model.sheets.raw import RawSprings
from cloth_sim_ros.physics.model.sheets.surface import grid_hinges
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.physics_scene import PhysicsScene, Sheet
from cloth_sim_ros.scene.thread_directions import along_grid, bending_moduli

if TYPE_CHECKING:
    from cloth_sim_ros.physics.model.sheets.rest_angles import RestAngles


def bending_forces(scene: PhysicsScene, sheet: Sheet, masses: Array, existing: NDArray[np.int64] | None) -> list[Force]:
    """Build the bending forces, as a list, for a `bending.model` except `none` and `axial`; raise ValueError if unfit.

    Hinges have S7 (opposite), S7 and S8 (crossed), S7 and S9 (altitude), or are quadratic. Triangles have a shape
    operator.

    Raises:
        ValueError: for raw springs whose triangles are no surface, or whose rest lengths make no triangle.
    """
    from cloth_sim_ros.physics.model.sheets import bending as calibration

    model = scene.bending.model
    if model == "shape_operator":
        return [_shape_operator_couplings(scene, sheet, masses)]
    rest_positions = sheet.positions()
    modulus = scene.material.bending_modulus
    options: dict[str, Any] = {}
    if isinstance(sheet, RawSprings):
        hinges = sheet.surface.hinges
        shape = options["shape"] = sheet.hinge_shape(hinges)
        if model == "opposite":
            options["spring_stiffness"] = scene.bending.stiffness * shape.edge
        else:
            options["hinge_constants"] = calibration.shape_hinge_constants(shape, bending_modulus=modulus)
    elif model == "opposite":
        hinges = sheet.surface.hinges
        ends = rest_positions[hinges[:, 1]] - rest_positions[hinges[:, 0]]
        options["spring_stiffness"] = scene.bending.stiffness * np.sqrt(row_sum((ends * ends).T))
    elif isinstance(sheet, GridSheet):
        # The hinges of both triangulations are used. Therefore the sheet bends alike both ways and does not twist.
        hinges = grid_hinges(sheet.rows, sheet.columns)
        options["hinge_constants"] = calibration.grid_hinge_constants(
            hinges,
            columns=sheet.columns,
            spacing=sheet.spacing,
            bending_modulus=along_grid(scene, bending_moduli(scene), "material.bending_modulus"),
        )
        if model == "quadratic":
            options["weights"] = calibration.grid_hinge_weights(hinges, columns=sheet.columns, spacing=sheet.spacing)
    else:
        hinges = sheet.surface.hinges
        warp, weft = bending_moduli(scene)
        isotropic = modulus if warp == weft else 1.0
        constants = calibration.mesh_hinge_constants(hinges, rest_positions, bending_modulus=isotropic)
        if warp != weft:
            from cloth_sim_ros.physics.model.sheets.thread_bending import thread_factors

            direction = scene.material.warp_direction
            constants = constants * thread_factors(
                hinges, rest_positions, constants, moduli=(warp, weft), warp=direction
            )
        options["hinge_constants"] = constants
    return [
        *calibration.bending_terms(
            model,  # type: ignore[arg-type]
            hinges,
            rest_positions,
            rest_angle=_rest_angle(scene, hinges),
            damping=scene.material.damping,
            masses=masses,
            existing=existing,
            **options,
        )
    ]


def _shape_operator_couplings(scene: PhysicsScene, sheet: Sheet, masses: Array) -> Force:
    """Build the shape-operator force of bending; raise ValueError for raw springs, rest angles or a curved rest shape.

    Raises:
        ValueError: for a sheet that is not flat at rest.
    """
    from cloth_sim_ros.physics.model.sheets.bending import check_flat
    from cloth_sim_ros.physics.model.sheets.shape_operator import ShapeOperator

    bending = scene.bending
    if isinstance(sheet, RawSprings):
        raise ParameterError("bending.model 'shape_operator' is not for cloth.springs; choose quadratic, or none")
    if bending.rest_angle or bending.rest_angles:
        name, value = ("rest_angle", bending.rest_angle) if bending.rest_angle else ("rest_angles", bending.rest_angles)
        raise ParameterError(
            f"bending.{name} is {value!r}, and shape operators are flat at rest; remove it, or choose crossed or "
            "altitude"
        )
    positions, triangles = sheet.positions(), sheet.triangles()
    if isinstance(sheet, MeshSheet) and not bending.flat:
        hinges = sheet.surface.hinges
        check_flat(hinges, HingeShape.of(hinges, positions), "shape operators")
    warp, weft = bending_moduli(scene)
    operator = ShapeOperator.of(triangles, positions, warp=scene.material.warp_direction)
    moduli = (warp, weft, 0.5 * math.sqrt(warp * weft))
    return operator.couplings(moduli, damping=scene.material.damping, masses=masses)


def friction_of_hinges(scene: PhysicsScene, sheet: Sheet) -> Force:
    """Build the force of bending friction in a sheet's hinges, from `bending.friction_moment` and `yield_curvature`.

    A grid has it in the hinges of its edges: they bend as threads do. Their moment is then the same in all directions.

    Raises:
        ValueError: for hinges that are nearly shut at rest.
    """
    from cloth_sim_ros.physics.model.sheets import bending as calibration
    from cloth_sim_ros.physics.model.sheets.hinge_friction import hinge_friction

    bending, share = scene.bending, 1.0
    modulus = bending.friction_moment / bending.yield_curvature
    if isinstance(sheet, GridSheet):
        hinges, share = grid_hinges(sheet.rows, sheet.columns), 0.5
        constants = calibration.grid_hinge_constants(
            hinges, columns=sheet.columns, spacing=sheet.spacing, bending_modulus=modulus
        )
        row, column = np.divmod(hinges[:, :2], sheet.columns)
        is_edge = (row[:, 0] == row[:, 1]) | (column[:, 0] == column[:, 1])
        hinges, constants = hinges[is_edge], constants[is_edge]
        shape = HingeShape.of(hinges, sheet.positions())
    else:
        hinges = sheet.surface.hinges
        raw = sheet if isinstance(sheet, RawSprings) else None
        shape = HingeShape.of(hinges, sheet.positions()) if raw is None else raw.hinge_shape(hinges)
        constants = calibration.shape_hinge_constants(shape, bending_modulus=modulus)
    angle = _rest_angle(scene, hinges)
    shape = shape if angle is None else shape.folded(angle)
    moments = share * bending.friction_moment * shape.edge
    return hinge_friction(hinges, shape, hinge_constants=constants, moments=moments)


@lru_cache(maxsize=8)
def _parsed_rest_angles(data: bytes) -> RestAngles:
    from cloth_sim_ros.scene import springs_file

    return springs_file.parse_rest_angles(data)


def _rest_angle(scene: PhysicsScene, hinges: NDArray[np.int64]) -> float | Array | None:
    """Return the rest angles that parameters set for hinges (h, 4) [rad]: a number, an array (h,), or None if unset.

    NaN stands for the angle of the rest shape, None for the angles of all.
    """
    bending = scene.bending
    default = 0.0 if bending.flat else bending.rest_angle or None
    if not bending.rest_angles:
        return default
    try:
        angles = _parsed_rest_angles(scene.files[bending.rest_angles]).of_hinges(hinges)
    except ValueError as error:
        raise ParameterError(f"bending.rest_angles '{bending.rest_angles}': {error}") from error
    return angles if default is None else np.where(np.isnan(angles), default, angles)
