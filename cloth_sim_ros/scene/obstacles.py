# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Obstacles of a scene: parameters, names, and rigid shapes.

`<name>.shape` describes an obstacle. Those that `obstacles` names exist; others can be added later.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from cloth_sim_ros.physics.model.sheets.grid import GridSheet
from cloth_sim_ros.physics.model.sheets.raw import RawSprings
from cloth_sim_ros.physics.plan.gripper_path import normalized
from cloth_sim_ros.scene import sections
from cloth_sim_ros.scene.parameters import declare as parameters
from cloth_sim_ros.scene.parameters.declare import NAME, Parameter, ParameterError
from cloth_sim_ros.scene.physics_scene import Sheet

if TYPE_CHECKING:
    from cloth_sim_ros.physics.contact.obstacles import Obstacle
    from cloth_sim_ros.scene.mesh_file import SolidMesh

#: Parameters of a present obstacle that may change.
LIVE_LEAVES = ("friction", "frame")
#: Last part of the parameter that describes an obstacle; without it, its other parameters have no meaning.
_SHAPE_LEAF = "shape"


def declarations(name: str) -> tuple[Parameter, ...]:
    """Return the declarations of all parameters of an obstacle, e.g. `table.size` for the name `table`."""
    return parameters.declarations(sections.ObstacleParameters, f"{name}.")


def described_obstacles(values: Iterable[str], groups: Collection[str]) -> list[str]:
    """Return the obstacles whose `<name>.shape` is among full names of parameters, in their order.

    Args:
        values: full names.
        groups: first parts of the names of all other parameters, which no obstacle may have.
    """
    split = [name.rpartition(".") for name in values]
    return [name for name, _, leaf in split if leaf == _SHAPE_LEAF and NAME.fullmatch(name) and name not in groups]


def hint(name: str, groups: Collection[str]) -> str:
    """Return advice to set `<name>.shape`, a sentence for the message on an unknown parameter; empty if unfitting."""
    obstacle, _, leaf = name.rpartition(".")
    leaves = [entry.name.rpartition(".")[2] for entry in declarations("o")]
    if leaf not in leaves or not NAME.fullmatch(obstacle) or obstacle in groups:
        return ""
    return f" If '{obstacle}' is to be an obstacle, set {obstacle}.{_SHAPE_LEAF} with it, or before"


def build_descriptions(values: Mapping[str, Any], names: Iterable[str]) -> dict[str, sections.ObstacleParameters]:
    """Build the `ObstacleParameters` of each named obstacle from checked values by full name; return them by name."""
    return {name: parameters.build(sections.ObstacleParameters, dict(values), f"{name}.") for name in names}


def check_distinct(kind: str, names: Sequence[str]) -> None:
    """Raise ParameterError if a name of grippers, obstacles or cameras (`kind`) is no ROS name, or occurs twice.

    Raises:
        ParameterError: naming it.
    """
    for name in names:
        if not NAME.fullmatch(name):
            raise ParameterError(f"{kind} name '{name}' is no ROS name; use letters, digits and _, a letter first")
        if names.count(name) > 1:
            raise ParameterError(f"two {kind}s are named '{name}'; give each its own name")


def check_change(name: str, before: sections.ObstacleParameters, now: sections.ObstacleParameters) -> None:
    """Raise ParameterError if a present obstacle's parameters differ in more than `friction` and `frame`.

    Raises:
        ParameterError: naming the parameter.
    """
    old, new = parameters.flatten(before), parameters.flatten(now)
    fixed = [leaf for leaf in new if new[leaf] != old[leaf] and leaf not in LIVE_LEAVES]
    if fixed:
        raise ParameterError(
            f"{name}.{fixed[0]} can't change while '{name}' is there; take it out of obstacles first, or move it by "
            f"~/{name}/target"
        )


def check_names(
    names: Sequence[str], described_names: Collection[str], grippers: Collection[str], groups: Collection[str]
) -> None:
    """Raise ParameterError if an obstacle's name is invalid or taken, or its `<name>.shape` is not set.

    Args:
        names: names of the present obstacles.
        described_names: names of the obstacles whose shape is set.
        grippers: names of the grippers.
        groups: first parts of the names of all other parameters.

    Raises:
        ParameterError: naming the obstacle.
    """
    check_distinct("obstacle", names)
    for name in names:
        if name in groups:
            raise ParameterError(f"an obstacle is named '{name}', as parameters are; give it another name")
        if name not in described_names and name not in grippers:
            raise ParameterError(f"obstacles names '{name}', and {name}.{_SHAPE_LEAF} is not set; set it")
    for name in [*names, *described_names]:
        if name in grippers:
            raise ParameterError(f"'{name}' names a gripper and an obstacle; give the obstacle another name")


def check_meshes(values: Mapping[str, Any], known: Mapping[str, Any]) -> None:
    """Raise ParameterError if values name a new mesh file while the cloth runs: a recording would lack its content.

    Raises:
        ParameterError: naming the parameter.
    """
    for name, value in values.items():
        if name.endswith(".mesh") and value and value != known.get(name):
            raise ParameterError(f"{name} can't change while the cloth runs; describe the obstacle at start")


def build_solid(name: str, description: sections.ObstacleParameters, files: Mapping[str, bytes]) -> Obstacle:
    """Build the rigid shape of an obstacle from its description and the contents of files by name, or raise; cached.

    Raises:
        ParameterError: for an invalid description.
    """
    is_mesh = description.shape == "mesh"
    if is_mesh and not description.mesh:
        raise ParameterError(f"{name}.shape is mesh, and {name}.mesh is not set; give the mesh's file")
    if is_mesh and description.mesh not in files:
        raise ParameterError(f"the content of '{description.mesh}' is missing; build the scene with from_parameters")
    return _cached_solid(name, description, files[description.mesh] if is_mesh else b"")


@lru_cache(maxsize=512)
def _cached_solid(name: str, description: sections.ObstacleParameters, content: bytes) -> Obstacle:
    """Build the rigid shape of an obstacle from its description and its mesh file's content, or raise; cached.

    Raises:
        ParameterError: for an invalid description.
    """
    from cloth_sim_ros.physics.contact.obstacles import Obstacle

    try:
        normalized(description.orientation)
    except ValueError as error:
        raise ParameterError(f"{name}.orientation: {error}") from error
    check_friction_count(f"{name}.friction", description.friction)
    friction = (description.friction[0], description.friction[-1])
    size = () if description.shape in ("plane", "mesh") else description.size
    vertices = triangles = None
    try:
        if description.shape == "mesh":
            mesh = solid_mesh(content, description.mesh, description.scale)
            vertices, triangles = mesh.vertices, mesh.triangles
        return Obstacle(
            name=name, shape=description.shape, size=size, friction=friction, vertices=vertices, triangles=triangles
        )
    except ValueError as error:
        raise ParameterError(str(error)) from error


@lru_cache(maxsize=128)
def solid_mesh(content: bytes, name: str, scale: float) -> SolidMesh:
    """Parse a mesh file's content as the mesh of a solid [m], repaired if open; raise ValueError. Results are cached.

    Args:
        content: content of the file.
        name: name of the file.
        scale: factor from the file's unit to metres.

    Raises:
        ValueError: if the file holds no solid mesh.
    """
    from cloth_sim_ros.scene import mesh_file

    return mesh_file.parse_solid(content, name=name, scale=scale)


def check_friction_count(name: str, friction: Sequence[float]) -> None:
    """Raise ParameterError unless the parameter `name` has one or two coefficients of friction."""
    if len(friction) not in (1, 2):
        raise ParameterError(
            f"{name} has {len(friction)} entries, {list(friction)}; give one number, or static and kinetic"
        )


def check_friction(name: str, friction: Sequence[float]) -> None:
    """Raise ParameterError unless `friction` is one number, or static and kinetic coefficient, the latter no larger."""
    check_friction_count(name, friction)
    if friction[-1] > friction[0]:
        raise ParameterError(
            f"{name} is {friction[0]:g} at rest and {friction[-1]:g} in motion; the latter must be no larger: give "
            f"[{friction[-1]:g}, {friction[0]:g}], or one number"
        )


def check_cloth(sheet: Sheet, thickness: float, *, touches_itself: bool) -> None:
    """Raise ParameterError if contact cannot act on a cloth: surface missing, degenerate, or finer than the thickness.

    Args:
        sheet: geometry of the cloth.
        thickness: distance at which contact starts to act [m].
        touches_itself: true for contact of the cloth with itself.

    Raises:
        ParameterError: for contact with itself without a surface, a triangle without area, a joint on a triangle's
            edge, or a thickness above half the shortest edge.
    """
    triangles = sheet.triangles()
    if not len(triangles):
        if touches_itself:
            raise ParameterError(
                "contact.self needs a surface, and the file of cloth.springs has none: give it a table 'triangles', or "
                "set contact.self to false"
            )
        return
    if isinstance(sheet, RawSprings):
        _check_raw_triangles(sheet, touches_itself)
    shortest = _shortest_edge(sheet)
    if thickness > 0.5 * shortest:
        raise ParameterError(
            f"contact.thickness is {thickness:g} m, more than half the cloth's shortest edge, {shortest:.4g} m; take "
            f"{0.49 * shortest:.2g} m or less, or a coarser cloth"
        )


def _check_raw_triangles(sheet: RawSprings, touches_itself: bool) -> None:
    triangles, positions = sheet.triangles(), sheet.positions()
    corner = positions[triangles]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    for wrong, fault in (
        (
            (triangles == np.roll(triangles, 1, axis=1)).any(axis=1),
            "contact needs three different particles a triangle",
        ),
        (touches_itself & ~(np.abs(normal).max(axis=1) > 0.0), "it has no area at the start"),
        ((sheet.edge_lengths() == 0.0).any(axis=1), "a joint is one of its edges"),
    ):
        if wrong.any():
            row = int(np.argmax(wrong))
            raise ParameterError(
                f"row {row} of table 'triangles' of cloth.springs is {triangles[row].tolist()}; {fault}: remove the row"
            )


def _shortest_edge(sheet: Sheet) -> float:
    if isinstance(sheet, GridSheet):
        return min(sheet.spacing)
    if isinstance(sheet, RawSprings):
        return float(sheet.edge_lengths().min())
    away = sheet.rest_positions[sheet.surface.edges[:, 1]] - sheet.rest_positions[sheet.surface.edges[:, 0]]
    square = away[:, 0] * away[:, 0] + away[:, 1] * away[:, 1] + away[:, 2] * away[:, 2]
    return math.sqrt(float(square.min()))
