# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Quantities of warp and weft of a scene, and their axes on a grid."""

from __future__ import annotations

from typing import Protocol

from cloth_sim_ros.scene import sections
from cloth_sim_ros.scene.parameters.declare import ParameterError

#: Sine of the angle between warp and axis of a grid, below which they are the same direction.
_ALIGNED_SINE = 1e-9
#: Models in which a quantity's threads may have any direction.
_OBLIQUE_MODELS = {
    "material.stretch_modulus": "membrane.model 'triangles'",
    "material.bending_modulus": "bending.model 'shape_operator'",
}


class MaterialScene(Protocol):
    """Protocol of a `Scene` for moduli of warp and weft: parameters of material and bending."""

    @property
    def material(self) -> sections.MaterialParameters: ...

    @property
    def bending(self) -> sections.BendingParameters: ...


def stretch_moduli(scene: MaterialScene) -> tuple[float, float]:
    """Return Young's moduli (warp, weft) [N/m]; an unset one of the weft is that of the warp."""
    material = scene.material
    return material.stretch_modulus, material.stretch_modulus_weft or material.stretch_modulus


def bending_moduli(scene: MaterialScene) -> tuple[float, float]:
    """Return the bending moduli (warp, weft) [N m]; an unset one of the weft is that of the warp."""
    material = scene.material
    return material.bending_modulus, material.bending_modulus_weft or material.bending_modulus


def axial_stiffness(scene: MaterialScene) -> tuple[float, float]:
    """Return the stiffness of axial bending springs (warp, weft) [N/m]; 0 for other models of bending."""
    bending = scene.bending
    if bending.model != "axial":
        return 0.0, 0.0
    return bending.stiffness, bending.stiffness_weft or bending.stiffness


def is_oblique(scene: MaterialScene) -> bool:
    """Return True if the warp is along neither rows nor columns of a grid."""
    x, y, _ = map(abs, scene.material.warp_direction)
    return min(x, y) > _ALIGNED_SINE * max(x, y)


def along_grid(scene: MaterialScene, warp_and_weft: tuple[float, float], names: str) -> tuple[float, float]:
    """Convert (warp, weft) to (along rows, along columns) of a grid; raise ParameterError if unequal and oblique.

    Args:
        scene: gives the direction of the warp.
        warp_and_weft: the quantity.
        names: the parameters of the quantity, for the error.

    Raises:
        ParameterError: if the two differ and the warp is along neither rows nor columns, or perpendicular to both.
    """
    warp, weft = warp_and_weft
    if warp == weft:
        return warp, weft
    x, y, z = map(abs, scene.material.warp_direction)
    if not max(x, y) > _ALIGNED_SINE * z:
        raise ParameterError(
            f"material.warp_direction is {list(scene.material.warp_direction)}, perpendicular to the grid, and {names} "
            f"is {warp} along the warp and {weft} along the weft; choose a direction in its plane, e.g. [0.0, 1.0, 0.0]"
        )
    if not is_oblique(scene):
        return (weft, warp) if y > x else (warp, weft)
    model = f", or choose {_OBLIQUE_MODELS[names]}" if names in _OBLIQUE_MODELS else ""
    raise ParameterError(
        f"material.warp_direction is {list(scene.material.warp_direction)}, and {names} is {warp} along the warp and "
        f"{weft} along the weft; a grid's springs follow its rows and columns: set the direction along one of them, "
        f"e.g. [0.0, 1.0, 0.0], or both equal{model}"
    )
