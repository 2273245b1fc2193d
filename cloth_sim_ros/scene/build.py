# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Construction of model and plan from a scene.

Parts that the scene does not use are not built.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.engine.binding import PATH_NUMBERS
from cloth_sim_ros.physics.arithmetic.deterministic_math import ordered_sum
from cloth_sim_ros.physics.model.controls import Grasps
from cloth_sim_ros.physics.model.forces.drag import Drag
from cloth_sim_ros.physics.model.forces.force import Array, Force
from cloth_sim_ros.physics.model.forces.gravity import Gravity
from cloth_sim_ros.physics.model.forces.grid_springs import GridSprings
from cloth_sim_ros.physics.model.forces.grips import Grips
from cloth_sim_ros.physics.model.forces.pair_springs import PairSprings, damping_coefficient
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.model.parts import GridFamily
from cloth_sim_ros.physics.model.sheets.grid import GridSheet
from cloth_sim_ros.physics.model.sheets.material import ThreadStiffness, grid_threads
from cloth_sim_ros.physics.model.sheets.merging import component_labels
from cloth_sim_ros.physics.model.sheets.mesh import MeshSheet
from cloth_sim_ros.physics.model.sheets.raw import RawSprings
from cloth_sim_ros.physics.model.sheets.surface import checkerboards, grid_cells
from cloth_sim_ros.physics.plan.gripper_path import normalized, to_body_frame
from cloth_sim_ros.physics.plan.plan import Plan, compile
from cloth_sim_ros.scene.bending import bending_forces, friction_of_hinges
from cloth_sim_ros.scene.gripper_pads import pads_of
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.physics_scene import PhysicsScene, Sheet
from cloth_sim_ros.scene.thread_directions import (
    along_grid,
    axial_stiffness,
    is_oblique,
    stretch_moduli,
)

if TYPE_CHECKING:
    from cloth_sim_ros.physics.model.forces.contact import ContactSurface
    from cloth_sim_ros.physics.model.sheets.membrane import FabricModuli


def build_sheet(scene: PhysicsScene) -> Sheet:
    """Build the sheet of a scene, from a file (cached by content; repairs of a mesh are logged) or as a grid.

    Raises:
        ParameterError: for a file whose content makes no sheet.
    """
    cloth = scene.cloth
    if cloth.mesh or cloth.springs:
        name = "cloth.mesh" if cloth.mesh else "cloth.springs"
        path = cloth.mesh or cloth.springs
        try:
            several = scene.contact.self_ or any(cloth.joints)
            return _parsed_sheet(name, path, scene.files[path], several, cloth.merge, cloth.scale)
        except ValueError as error:
            raise ParameterError(f"{name} '{path}': {error}") from error
    rows, columns = cloth.resolution
    height, width = cloth.size
    return GridSheet(height=height, width=width, rows=rows, columns=columns, layout=cloth.shear_layout)  # type: ignore[arg-type]


@lru_cache(maxsize=8)
def _parsed_sheet(
    parameter: str, path: str, data: bytes, several: bool, merge: bool, scale: float
) -> MeshSheet | RawSprings:
    if parameter == "cloth.mesh":
        from cloth_sim_ros.scene import mesh_file

        return mesh_file.parse(data, name=path, several=several, merge=merge, scale=scale)
    from cloth_sim_ros.scene import springs_file

    return springs_file.parse(data)


def grid_threads_of(scene: PhysicsScene, sheet: GridSheet) -> ThreadStiffness:
    """Convert a scene's moduli to a grid's spring stiffnesses, force per strain [N], or raise ParameterError.

    Raises:
        ParameterError: if the moduli can't be met.
    """
    try:
        return grid_threads(
            stretch_modulus=along_grid(scene, stretch_moduli(scene), "material.stretch_modulus"),
            shear_modulus=scene.material.shear_modulus,
            spacing=sheet.spacing,
            layout=sheet.layout,
            bend_stiffness=along_grid(scene, axial_stiffness(scene), "bending.stiffness"),
        )
    except ValueError as error:
        raise ParameterError(str(error)) from error


def anchored_particles(scene: PhysicsScene, sheet: Sheet) -> list[int]:
    """Return the sorted indices of the particles that `cloth.anchors` names; raise ParameterError for an invalid name.

    Raises:
        ParameterError: for an anchor that is neither an edge or corner of a grid nor a particle index.
    """
    count = len(sheet.positions())
    return sorted(
        {particle for name in scene.cloth.anchors for particle in named_particles("cloth.anchors", name, sheet, count)}
    )


def joined_particles(scene: PhysicsScene, sheet: Sheet) -> NDArray[np.int64]:
    """Return the pairs of particles that `cloth.joints` joins, (m, 2), without joints to obstacles; raise if invalid.

    Raises:
        ParameterError: for a joint that does not name two different particles, or two edges of equal length; for two
            particles that are joined twice; for pieces of a mesh that joints leave apart.
    """
    count, pairs = len(sheet.positions()), list[tuple[int, int]]()
    joint_of: dict[frozenset[int], str] = {}
    for joint, ends in _joint_ends(scene):
        if any(_is_obstacle(scene, sheet, end) for end in ends):
            continue
        first, second = (named_particles("cloth.joints", end, sheet, count) for end in ends)
        if len(first) != len(second):
            raise ParameterError(
                f"cloth.joints has '{joint}', which joins {len(first)} particles with {len(second)}; name equally many"
            )
        for pair in zip(first, second, strict=True):
            if pair[0] == pair[1]:
                raise ParameterError(f"cloth.joints has '{joint}', which joins particle {pair[0]} to itself; name two")
            if frozenset(pair) in joint_of:
                raise ParameterError(
                    f"cloth.joints has '{joint_of[frozenset(pair)]}' and '{joint}', which both join particles "
                    f"{pair[0]} and {pair[1]}; give one, or a larger cloth.joint_stiffness"
                )
            joint_of[frozenset(pair)] = joint
            pairs.append(pair)
    joints = np.array(pairs, dtype=np.int64).reshape(-1, 2)
    if any(scene.cloth.joints) and isinstance(sheet, MeshSheet) and not scene.contact.self_:
        _check_pieces(scene, sheet, joints)
    return joints


def obstacle_joints(scene: PhysicsScene, sheet: Sheet) -> list[tuple[str, int]]:
    """Return (obstacle name, particle) of each joint to a present obstacle, in the order of the parameter `obstacles`.

    Raises:
        ParameterError: as `joined_particles`; for a joint of two obstacles, or one that is named twice.
    """
    joints = _described_obstacle_joints(scene, sheet)
    return [joint for name in scene.obstacle_names for joint in joints if joint[0] == name]


def _described_obstacle_joints(scene: PhysicsScene, sheet: Sheet) -> list[tuple[str, int]]:
    """Return (obstacle name, particle) of each joint to a described obstacle, present or not, in the scene's order."""
    if not any(scene.cloth.joints):
        return []
    joints, count = list[tuple[str, int]](), len(sheet.positions())
    for joint, ends in _joint_ends(scene):
        obstacles = [end for end in ends if _is_obstacle(scene, sheet, end)]
        if len(obstacles) == 2:
            raise ParameterError(f"cloth.joints has '{joint}', which joins two obstacles; name a particle and one")
        for name in obstacles:
            particles = named_particles("cloth.joints", ends[1 - ends.index(name)], sheet, count)
            joints += [(name, particle) for particle in particles]
    for (name, particle), n_joints in Counter(joints).items():
        if n_joints > 1:
            raise ParameterError(
                f"cloth.joints joins particle {particle} and obstacle '{name}' {n_joints} times; name the joint once, "
                "or give a larger cloth.joint_stiffness"
            )
    return joints


def _joint_ends(scene: PhysicsScene) -> Iterator[tuple[str, list[str]]]:
    """Yield each entry of `cloth.joints` with the names of its two ends; raise ParameterError unless there are two."""
    for joint in filter(None, scene.cloth.joints):
        ends = joint.split("-")
        if len(ends) != 2 or not all(ends):
            raise ParameterError(f"cloth.joints has '{joint}'; give two particles, e.g. '12-340'")
        yield joint, ends


def _is_obstacle(scene: PhysicsScene, sheet: Sheet, end: str) -> bool:
    """Return True if a joint's end names an obstacle, present or not, and no edge or corner of a grid sheet."""
    return end in scene.described and not (isinstance(sheet, GridSheet) and sheet.has_edge(end))


def _check_pieces(scene: PhysicsScene, sheet: MeshSheet, joints: NDArray[np.int64]) -> None:
    """Raise ParameterError for a mesh with a piece that neither joints (m, 2) nor obstacles connect to particle 0."""
    count, names = len(sheet.positions()), list(scene.described)
    held = [(particle, count + names.index(name)) for name, particle in _described_obstacle_joints(scene, sheet)]
    connections = np.concatenate([sheet.surface.edges, joints, np.array(held, dtype=np.int64).reshape(-1, 2)])
    label = component_labels(connections, count + len(names))[:count]
    apart = np.flatnonzero(label != label[0])
    if apart.size:
        raise ParameterError(
            f"cloth.joints leave the mesh in {len(np.unique(label))} pieces: nothing connects particle {apart[0]} with "
            "particle 0; join them too, or set contact.self: true, which keeps pieces apart"
        )


def named_particles(parameter: str, name: str, sheet: Sheet, count: int) -> list[int]:
    """Return the particles that a name means: an index, a grid's edge or corner, or none if empty. Raise for others.

    Raises:
        ParameterError: naming the parameter, for another name or a number that is too large.
    """
    if name.isdecimal():
        # Python refuses to parse integers of more than a few thousand digits.
        digits = name.lstrip("0") or "0"
        if len(digits) > len(str(count)) or int(digits) >= count:
            shown = name if len(name) <= 20 else f"{name[:20]}... ({len(name)} digits)"
            raise ParameterError(f"{parameter} names particle {shown}; there are {count}, counted from 0")
        return [int(digits)]
    if name and not isinstance(sheet, GridSheet):
        kinds = ", and no obstacle has that name" if parameter == "cloth.joints" else ""
        raise ParameterError(
            f"{parameter} names '{name}'; only a grid has edges{kinds}: give particle numbers, or none by ['']"
        )
    try:
        return [int(particle) for particle in sheet.edge(name)] if name and isinstance(sheet, GridSheet) else []
    except ValueError as error:
        kinds = "a particle's number" + (" or an obstacle's name" if parameter == "cloth.joints" else "")
        raise ParameterError(f"{parameter}: {error}, or give {kinds}") from error


def build_model(scene: PhysicsScene) -> Model:
    """Build a new physical model of a scene: masses, forces and anchors. Raise ValueError for invalid combinations."""
    sheet = build_sheet(scene)
    masses = sheet.masses(scene.material.density)
    joints = joined_particles(scene, sheet)
    forces = [
        *_elastic_forces(scene, sheet, masses),
        *_joints(scene, joints, masses),
        *uniform_forces(scene),
        *_air_panels(scene, sheet),
        *_added_mass(scene, sheet),
    ]
    if scene.gripper_names or obstacle_joints(scene, sheet):
        forces.append(_grips(scene, sheet, masses))
    solids, pads, contact_parameters = scene.solids, pads_of(scene, ordered_sum(masses.tolist())), scene.contact
    if solids or pads or contact_parameters.self_:
        from cloth_sim_ros.physics.model.forces.contact import Contact

        faces = contact_surface(scene, sheet) if contact_parameters.self_ or solids else None
        contact = Contact(
            solids,
            thickness=contact_parameters.thickness,
            damping=contact_parameters.damping,
            jaws=pads,
            surface=faces if contact_parameters.self_ else None,
            faces=faces if solids else None,
        )
        contact.set_paths(np.concatenate([_starting_paths(scene), contact.paths[len(solids) :]]))
        forces.append(contact)
    return Model(masses, forces, anchors=anchored_particles(scene, sheet))


def _grips(scene: PhysicsScene, sheet: Sheet, masses: Array) -> Grips:
    """Build the force of all grippers, which grasp nothing yet, and of joints to obstacles at their initial poses."""
    joints, n_grippers = obstacle_joints(scene, sheet), len(scene.gripper_names)
    if not joints:
        return Grips(n_grippers)
    paths, x = _starting_paths(scene), np.ascontiguousarray(scene.initial_positions().T)
    poses = np.concatenate([paths[:, 1:4], paths[:, 13:17]], axis=1)
    obstacles, grasps = joint_grasps(scene, joints, masses, attachment_points(joints, scene.obstacle_names, poses, x))
    grips = Grips(n_grippers + len(obstacles))
    starts = np.concatenate([np.zeros(n_grippers, dtype=np.int64), grasps.starts])
    paths = np.concatenate([grips.paths[:n_grippers], paths[obstacles]])
    grips.set_grips(paths, starts, grasps.particles, grasps.offsets, grasps.stiffness, grasps.damping)
    return grips


def attachment_points(joints: list[tuple[str, int]], names: list[str], poses: Array, x: Array) -> Array:
    """Return the position of each joint's particle in the frame of its obstacle [m], shape (joints, 3).

    Args:
        joints: as from `obstacle_joints`.
        names: names of the obstacles.
        poses: poses of the obstacles, shape (obstacles, 7).
        x: positions [m], shape (3, n).
    """
    points = [to_body_frame(poses[names.index(name)], x[:, [particle]]) for name, particle in joints]
    return np.concatenate(points)


def joint_grasps(
    scene: PhysicsScene, joints: list[tuple[str, int]], masses: Array, offsets: Array
) -> tuple[NDArray[np.int64], Grasps]:
    """Return indices of obstacles with joints, ascending, and the springs of these joints as `Grasps` in this order.

    Args:
        scene: gives obstacles, stiffness and damping.
        joints: as from `obstacle_joints`.
        masses: particle masses [kg], shape (n,).
        offsets: points on the obstacles [m], shape (joints, 3).
    """
    particles, names = np.array([particle for _, particle in joints], dtype=np.int64), scene.obstacle_names
    obstacles, first = np.unique([names.index(name) for name, _ in joints], return_index=True)
    stiffness = np.full(len(joints), scene.cloth.joint_stiffness)
    # An obstacle is a fixed end, so the lecture's m is the particle's mass.
    damping = damping_coefficient(scene.cloth.joint_damping, stiffness, masses[particles])
    starts = np.append(first, len(joints)).astype(np.int64)
    return obstacles, Grasps(starts, particles, offsets, stiffness, damping)


def contact_surface(scene: PhysicsScene, sheet: Sheet) -> ContactSurface | None:
    """Build the cloth's contact surface; None for a cloth without triangles, whose particles alone touch obstacles."""
    from cloth_sim_ros.physics.model.forces.contact import ContactSurface

    triangles, contact = sheet.triangles(), scene.contact
    if not len(triangles):
        return None
    joints = joined_particles(scene, sheet)
    if isinstance(sheet, RawSprings):
        joints = np.concatenate([joints, sheet.term.pairs[sheet.term.rest_length == 0.0]])
    return ContactSurface(
        triangles,
        sheet.positions(),
        thickness=contact.thickness,
        friction=(contact.friction[0], contact.friction[-1]),
        edge_lengths=sheet.edge_lengths() if isinstance(sheet, RawSprings) else None,
        joints=joints,
    )


def _starting_paths(scene: PhysicsScene) -> Array:
    """Return paths that rest at the initial poses of the present obstacles, shape (obstacles, PATH_NUMBERS)."""
    rows = np.zeros((len(scene.obstacle_names), PATH_NUMBERS))
    for row, name in zip(rows, scene.obstacle_names, strict=True):
        row[1:4], row[13:17] = scene.described[name].position, normalized(scene.described[name].orientation)
    return rows


def uniform_forces(scene: PhysicsScene) -> list[Force]:
    """Build a list of the forces that act on all particles alike: gravity, drag, the wind's part of drag, if not 0."""
    forces = list[Force]()
    if any(scene.gravity):
        forces.append(Gravity(scene.gravity))
    if scene.air.drag:
        forces.append(Drag(scene.air.drag))
    if any(scene.wind.velocity) and scene.air.drag:
        from cloth_sim_ros.physics.model.forces.wind import Wind

        forces.append(Wind(scene.wind.velocity, scene.air.drag))
    return forces


def _air_panels(scene: PhysicsScene, sheet: Sheet) -> list[Force]:
    """Build the drag of the air on the surface's panels, as a list; empty if both coefficients are 0."""
    wind = scene.wind
    if not wind.normal_drag and not wind.tangential_drag:
        return []
    from cloth_sim_ros.physics.model.forces.air_panels import AirPanels

    panels = _panels(sheet)
    return [AirPanels(panels, normal=wind.normal_drag, tangential=wind.tangential_drag, wind=wind.velocity)]


def _added_mass(scene: PhysicsScene, sheet: Sheet) -> list[Force]:
    """Build the inertia of the air that the surface carries along, as a list; empty if it is 0."""
    if not scene.air.added_mass:
        return []
    from cloth_sim_ros.physics.model.forces.added_mass import AddedMass

    return [AddedMass(_panels(sheet), density=scene.air.added_mass, wind=scene.wind.velocity)]


def _panels(sheet: Sheet) -> NDArray[np.int64]:
    """Return the corner particles of the panels on which air acts: cells of a grid (m, 4), or triangles (m, 3).

    A grid has panels per cell, not per triangle. Therefore the area of each particle is proportional to its mass.
    """
    return grid_cells(sheet.rows, sheet.columns) if isinstance(sheet, GridSheet) else sheet.triangles()


def build_plan(scene: PhysicsScene) -> Plan:
    """Build a scene's model and compile it to a new plan for the engine; raise ValueError for invalid combinations."""
    return compile(build_model(scene))


def _grid_families(scene: PhysicsScene, sheet: GridSheet, threads: ThreadStiffness) -> dict[str, list[GridFamily]]:
    material = scene.material
    return sheet.families(
        threads,
        k_d0=material.damping,
        density=material.density,
        retardation=material.viscosity / material.stretch_modulus,
    )


def membrane_forces(scene: PhysicsScene, sheet: GridSheet | MeshSheet) -> list[Force]:
    """Return a list: the triangle membrane, then a grid's axial bending springs, whose stiffness the membrane lacks."""
    from cloth_sim_ros.physics.model.sheets.membrane import membrane

    springs: list[GridSprings] = []
    subtracted = (0.0, 0.0)
    if isinstance(sheet, GridSheet) and scene.bending.model == "axial":
        threads, subtracted = axial_threads(scene, sheet)
        bend = _grid_families(scene, sheet, threads).get("bend")
        springs = sheet.springs({"bend": bend}) if bend else []
    material, triangles, share = scene.material, sheet.triangles(), 1.0
    if isinstance(sheet, GridSheet) and sheet.layout == "both":
        # With a single diagonal a cell may fold shut along it, and the hinge of the other one degenerates.
        triangles, share = np.concatenate(checkerboards(sheet.rows, sheet.columns)), 0.5
    try:
        force = membrane(
            sheet.positions(),
            triangles,
            fabric_moduli(scene),
            warp=material.warp_direction,
            k_d0=material.damping,
            density=material.density,
            viscosity=material.viscosity,
            subtracted=subtracted,
            share=share,
            grid=(sheet.rows, sheet.columns) if isinstance(sheet, GridSheet) else None,
        )
    except ValueError as error:
        raise ParameterError(f"membrane.model triangles: {error}") from error
    return [force, *springs]


def axial_threads(scene: PhysicsScene, sheet: GridSheet) -> tuple[ThreadStiffness, tuple[float, float]]:
    """Return a grid's axial bending springs as threads, and the stretch stiffness that they add (warp, weft) [N/m].

    The stiffness is along warp and weft. The threads have neither edges nor diagonals.

    Raises:
        ParameterError: if they are not along warp and weft.
    """
    warp, weft = axial_stiffness(scene)
    if is_oblique(scene) and (warp or weft):
        raise ParameterError(
            f"bending.model axial follows the grid's rows and columns, and material.warp_direction is "
            f"{list(scene.material.warp_direction)}; choose quadratic, crossed, altitude or none, or another direction"
        )
    hx, hy = sheet.spacing
    along_rows, along_columns = along_grid(scene, (warp, weft), "bending.stiffness")
    threads = ThreadStiffness(
        along_rows=0.0,
        along_columns=0.0,
        diagonal=0.0,
        bend_along_rows=along_rows * hy,
        bend_along_columns=along_columns * hx,
        poisson_ratio=scene.material.poisson_ratio,
    )
    return threads, (2.0 * warp, 2.0 * weft)


#: Parameters of `material` that make the moduli of triangles grow.
STIFFENING = ("warp_stiffening", "weft_stiffening", "shear_stiffening")


def fabric_moduli(scene: PhysicsScene) -> FabricModuli:
    """Return a scene's moduli for a membrane of triangles; raise ParameterError if Poisson's ratio does not fit them.

    Raises:
        ParameterError: for a Poisson's ratio that the moduli exclude.
    """
    from cloth_sim_ros.physics.model.sheets.membrane import FabricModuli

    warp, weft = stretch_moduli(scene)
    material = scene.material
    try:
        return FabricModuli(
            warp=warp,
            weft=weft,
            shear=material.shear_modulus,
            poisson_ratio=material.poisson_ratio,
            **{name: tuple(getattr(material, name)) for name in STIFFENING},
        )
    except ValueError as error:
        raise ParameterError(f"material.{error}") from error


def _elastic_forces(scene: PhysicsScene, sheet: Sheet, masses: Array) -> list[Force]:
    material = scene.material
    forces: list[Force]
    existing = None
    if isinstance(sheet, RawSprings):
        forces, existing = [sheet.term], sheet.term.pairs[sheet.term.rest_length > 0.0]
    elif scene.membrane.model == "triangles":
        forces = membrane_forces(scene, sheet)
    elif isinstance(sheet, GridSheet):
        forces = [*sheet.springs(_grid_families(scene, sheet, grid_threads_of(scene, sheet)))]
    else:
        forces = [
            sheet.springs(
                stretch_modulus=material.stretch_modulus,
                k_d0=material.damping,
                density=material.density,
                viscosity=material.viscosity,
            )
        ]
    if scene.bending.model not in ("none", "axial"):
        # A pair that has a spring gets no second one. Across a cell's diagonal that spring is the other diagonal.
        shear = [force.pairs for force in forces if force.name == "shear" and isinstance(force, GridSprings)]
        forces.extend(bending_forces(scene, sheet, masses, shear[0] if shear else existing))
    if scene.bending.friction_moment:
        forces.append(friction_of_hinges(scene, sheet))
    return forces


def _joints(scene: PhysicsScene, pairs: NDArray[np.int64], masses: Array) -> list[Force]:
    """Build the zero-length springs (S4) between joined pairs of particles (m, 2), as a list; empty without pairs."""
    if not len(pairs):
        return []
    cloth, (first, second) = scene.cloth, masses[pairs.T]
    damping = damping_coefficient(cloth.joint_damping, cloth.joint_stiffness, 2.0 / (1.0 / first + 1.0 / second))
    return [PairSprings(pairs, 0.0, cloth.joint_stiffness, damping, name="joints")]
