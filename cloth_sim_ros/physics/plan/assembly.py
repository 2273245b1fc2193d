# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Assembly of a model's forces into parts for the engine.

It also estimates the cost of one step of these parts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.engine.binding import FAMILIES, KINDS, check, library
from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.model.forces.force import Array, Force
from cloth_sim_ros.physics.model.forces.grips import Grips
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.model.parts import ContactPart, ElementList, SpringGrid, min_damping_time

if TYPE_CHECKING:
    from cloth_sim_ros.physics.model.forces.contact import Contact

#: Arithmetic operations of a step: to move a particle, of a grid's spring, of an air panel and of added mass on a cell
#: of a grid. They include gathering. Choices that depend on them are the same on every machine.
MOVE_OPERATIONS, GRID_SPRING_OPERATIONS = 40, 26
GRID_CELL_OPERATIONS = {"quad": 45, "mass_quad": 140, "quadratic": 12}
#: Element kinds of added mass.
MASS_KINDS = ("mass_triangle", "mass_quad")
#: Element kind whose moduli grow with strain.
STIFFENING_KIND = "stiffening_membrane"
#: Element kind with plastic lengths.
PLASTIC_KIND = "bending_friction"
#: Element kinds whose forces multirate runs evaluate less often.
HINGE_KINDS = ("crossed", "altitude")
ELEMENT_OPERATIONS = {"spring": 50, "joint": 40, "crossed": 160, "altitude": 160, "triangle": 120, "quad": 160}
ELEMENT_OPERATIONS |= dict.fromkeys(("edge_edge", "point_face"), 160)
ELEMENT_OPERATIONS |= {"membrane": 130, "stiffening_membrane": 160, "mass_triangle": 240, "mass_quad": 300}
ELEMENT_OPERATIONS |= {"quadratic": 120, "bending_friction": 160, "coupling": 40}


@attrs.define(eq=False)
class Assembly:
    """The forces of a model, sorted into the engine's parts: grid, element lists, grips, contact, uniform, Python."""

    model: Model
    #: Forces in Python (numpy).
    python_forces: list[Force] = attrs.field(factory=list)
    grips: Grips | None = None
    contact: Contact | None = None
    gravity: Array = attrs.field(factory=lambda: np.zeros(3))
    wind: Array = attrs.field(factory=lambda: np.zeros(3))
    drag: float = 0.0
    #: All springs of the model's sheet, if it has one.
    grid: SpringGrid | None = None
    element_lists: list[ElementList] = attrs.field(factory=list)

    @classmethod
    def of(cls, model: Model) -> Assembly:
        """Return a model's forces, sorted into parts.

        Raises:
            ValueError: if a force does not fit the model, or if two forces must be merged into one.
        """
        assembly = cls(model)
        grids: list[SpringGrid] = []
        for force in model.forces:
            if isinstance(force, Grips):
                if assembly.grips is not None:
                    raise ValueError(
                        f"two forces hold particles, '{assembly.grips.name}' and '{force.name}'; merge them into one"
                    )
                assembly.grips = force
            parts = force.parts(model.particle_count)
            if parts is None:
                assembly.python_forces.append(force)
                continue
            for part in parts:
                if isinstance(part, SpringGrid):
                    grids.append(part)
                elif isinstance(part, ElementList):
                    if part.kind in MASS_KINDS and any(
                        elements.kind in MASS_KINDS for elements in assembly.element_lists
                    ):
                        raise ValueError("two forces of a model have added mass; merge their panels into one")
                    if part.kind == PLASTIC_KIND and assembly.plastic is not None:
                        raise ValueError("two forces of a model have friction of bending; merge their hinges into one")
                    assembly.element_lists.append(part)
                elif isinstance(part, ContactPart):
                    if assembly.contact is not None:
                        raise ValueError(
                            f"two forces have obstacles, '{assembly.contact.name}' and '{force.name}'; merge them "
                            f"into one"
                        )
                    assembly.contact = part.contact
                else:
                    assembly.gravity, assembly.wind = assembly.gravity + part.gravity, assembly.wind + part.wind
                    assembly.drag += part.drag
        assembly.grid = _merge_grids(grids)
        return assembly

    @property
    def plastic(self) -> ElementList | None:
        """Element list of the hinges with bending friction; None without any."""
        return next((part for part in self.element_lists if part.kind == PLASTIC_KIND), None)

    @property
    def stiffens(self) -> bool:
        """True if the moduli of a membrane grow with strain."""
        return any(part.kind == STIFFENING_KIND for part in self.element_lists)

    def upload(self, handle: int) -> None:
        """Upload uniform forces, grid and element lists to the engine's plan, given by its pointer."""
        self.upload_uniform(handle)
        if self.grid is not None:
            family_table = _family_table(self.grid)
            check(library().cloth_plan_grid(handle, self.grid.rows, self.grid.columns, family_table.ctypes.data))
        for part in self.element_lists:
            _upload_elements(handle, part)
        if self.element_lists and self.grid is None:
            self._upload_order(handle)

    def upload_uniform(self, handle: int) -> None:
        """Upload to an engine's plan gravity, wind and drag, which act on all particles alike."""
        check(library().cloth_plan_uniform(handle, self.gravity.ctypes.data, self.wind.ctypes.data, self.drag))

    def pair_counts(self) -> list[int]:
        """Return the number of 3x3 blocks of each element list: one a spring or joint, three a membrane, else 0."""
        blocks = {"spring": 1, "joint": 1, "membrane": 3, "stiffening_membrane": 3}
        return [blocks.get(part.kind, 0) * len(part.particles) for part in self.element_lists]

    def min_damping_time(self) -> float:
        """Return the least ratio c / k [s] of damping to stiffness of springs, joints, membranes; else infinity."""
        coefficients = [part.coefficients for part in self.element_lists if part.kind in ("spring", "joint")]
        damping_times = [min_damping_time(numbers[:, -2], numbers[:, -1]) for numbers in coefficients]
        families = () if self.grid is None else self.grid.families
        damping_times += [min_damping_time(f.stiffness / f.rest_length, f.damping) for f in families]
        damping_times += [_membrane_damping_time(part) for part in self.element_lists if part.is_membrane]
        return min(damping_times, default=math.inf)

    def step_cost(self) -> float:
        """Return the estimated time of a step for one particle [ns]."""
        count = self.model.particle_count
        total = MOVE_OPERATIONS * count
        if self.grid is not None:
            total += GRID_SPRING_OPERATIONS * count * len(self.grid.families)
        total += sum(self._operations(part) for part in self.element_lists)
        # A call of Python takes as long as a hundred particles.
        python_cost = CONSTANTS.python_force_time * (count + 100) / count * len(self.python_forces)
        return CONSTANTS.operation_time * total / count + python_cost

    def hinge_cost(self) -> float:
        """Return the estimated time of a step for one particle that hinge forces take [ns], a part of `step_cost`."""
        total = sum(self._operations(part) for part in self.element_lists if part.kind in HINGE_KINDS)
        return CONSTANTS.operation_time * total / self.model.particle_count

    def _operations(self, part: ElementList) -> int:
        """Return the number of arithmetic operations that all elements of a list take in a step."""
        is_cell = self.grid is not None and part.kind in GRID_CELL_OPERATIONS
        return (GRID_CELL_OPERATIONS if is_cell else ELEMENT_OPERATIONS)[part.kind] * len(part.particles)

    def _upload_order(self, handle: int) -> None:
        """Upload an order of particles that brings neighbours together in memory; results keep the model's order."""
        from cloth_sim_ros.physics.model.ordering import local_order

        count = self.model.particle_count
        order = local_order(count, np.concatenate([_particle_pairs(part.particles) for part in self.element_lists]))
        if order is not None:
            rank = np.empty(count, dtype=np.int64)
            rank[order] = np.arange(count)
            check(library().cloth_plan_order(handle, rank.ctypes.data))


def _merge_grids(parts: Sequence[SpringGrid]) -> SpringGrid | None:
    """Return one grid with all spring families of a sheet, because the engine sweeps over them together."""
    if not parts:
        return None
    rows, columns = parts[0].rows, parts[0].columns
    names: set[str] = set()
    for part in parts:
        if (part.rows, part.columns) != (rows, columns):
            raise ValueError(
                f"one model has sheets of {rows} x {columns} and {part.rows} x {part.columns} particles; make "
                "two models, or one of them of PairSprings"
            )
        for family in part.families:
            if family.name in names:
                raise ValueError(f"two forces have springs '{family.name}' of one sheet; make them one")
            names.add(family.name)
    return SpringGrid(rows=rows, columns=columns, families=tuple(family for part in parts for family in part.families))


def _family_table(sheet: SpringGrid) -> Array:
    """Return the engine's table of a grid's springs, (families, 6): a row for each known family, even if absent."""
    table = np.zeros((len(FAMILIES), 6))
    table[:, 2], table[:, 5] = 1.0, -1.0
    for family in sheet.families:
        parity = -1 if family.parity is None else family.parity
        coefficients = (1, family.stiffness, family.rest_length, family.damping, family.border, parity)
        table[FAMILIES.index(family.name)] = coefficients
    return table


def _upload_elements(handle: int, part: ElementList) -> None:
    kind, width, n_coefficients = KINDS[part.kind]
    particles = np.ascontiguousarray(part.particles, dtype=np.int64)
    coefficients = np.ascontiguousarray(part.coefficients, dtype=np.float64)
    if particles.shape[1] != width or coefficients.shape != (len(particles), n_coefficients):
        raise ValueError(
            f"a list of kind '{part.kind}' has shapes {particles.shape} and {coefficients.shape}; they must be "
            f"(m, {width}) and (m, {n_coefficients})"
        )
    shared = (
        None if part.shared_coefficients is None else np.ascontiguousarray(part.shared_coefficients, dtype=np.float64)
    )
    addresses = particles.ctypes.data, coefficients.ctypes.data, None if shared is None else shared.ctypes.data
    check(library().cloth_plan_list(handle, kind, len(particles), *addresses))


def _membrane_damping_time(part: ElementList) -> float:
    """Return the least ratio of viscosity to modulus [s] of a list of membrane triangles."""
    assert part.shared_coefficients is not None
    times = min_damping_time(part.shared_coefficients[[0, 2, 3]], part.shared_coefficients[[4, 6, 7]])
    sizes = part.coefficients[:, 5] / part.coefficients[:, 4]
    return times * float(sizes.min(initial=np.inf)) if np.isfinite(times) else times


def _particle_pairs(groups: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return all pairs of particles within each row, shape (m, 2)."""
    width = groups.shape[1]
    return np.concatenate([groups[:, [i, j]] for i in range(width) for j in range(i + 1, width)])
