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
from cloth_sim_ros.physics.constants import CONSTANTS
from cloth_sim_ros.physics.forces.force import Array, Force
from cloth_sim_ros.physics.forces.grips import Grips
from cloth_sim_ros.physics.model import Model
from cloth_sim_ros.physics.parts import Gridded, Listed, Surrounded, least_decay

if TYPE_CHECKING:
    from cloth_sim_ros.physics.forces.contact import Contact

#: Arithmetic operations of a step: to move a particle, of a grid's spring, of an air panel on a grid's cell. They
#: include gathering. Choices that depend on them are the same on every machine.
MOVE, GRID_SPRING, GRID_PANEL = 40, 26, 45
#: Element kinds whose forces multirate runs evaluate less often.
HINGES = ("crossed", "altitude")
ELEMENT = {"spring": 50, "joint": 40, "crossed": 160, "altitude": 160, "triangle": 120, "quad": 160}


@attrs.define(eq=False)
class Assembly:
    """The forces of a model, sorted by kind."""

    model: Model
    #: Forces in Python (numpy).
    own: list[Force] = attrs.field(factory=list)
    grips: Grips | None = None
    contact: Contact | None = None
    gravity: Array = attrs.field(factory=lambda: np.zeros(3))
    wind: Array = attrs.field(factory=lambda: np.zeros(3))
    drag: float = 0.0
    #: All springs of the model's sheet, if it has one.
    gridded: Gridded | None = None
    listed: list[Listed] = attrs.field(factory=list)

    @classmethod
    def of(cls, model: Model) -> Assembly:
        """Sort a model's forces.

        Raises:
            ValueError: if a force does not fit the model, or if two forces must be merged into one.
        """
        found = cls(model)
        sheets: list[Gridded] = []
        for force in model.forces:
            if isinstance(force, Grips):
                if found.grips is not None:
                    raise ValueError(
                        f"two forces hold particles, '{found.grips.name}' and '{force.name}'; merge them into one"
                    )
                found.grips = force
            parts = force.parts(model.particle_count)
            if parts is None:
                found.own.append(force)
                continue
            for part in parts:
                if isinstance(part, Gridded):
                    sheets.append(part)
                elif isinstance(part, Listed):
                    found.listed.append(part)
                elif isinstance(part, Surrounded):
                    if found.contact is not None:
                        raise ValueError(
                            f"two forces have obstacles, '{found.contact.name}' and '{force.name}'; merge them into one"
                        )
                    found.contact = part.contact
                else:
                    found.gravity, found.wind = found.gravity + part.gravity, found.wind + part.wind
                    found.drag += part.drag
        found.gridded = _one_sheet(sheets)
        return found

    def hand_over(self, handle: int) -> None:
        """Upload all parts to the engine's plan, given by its pointer."""
        self.uniform_to(handle)
        if self.gridded is not None:
            table = _table(self.gridded)
            check(library().cloth_plan_grid(handle, self.gridded.rows, self.gridded.columns, table.ctypes.data))
        for part in self.listed:
            _add_list(handle, part)
        if self.listed and self.gridded is None:
            self._order(handle)

    def uniform_to(self, handle: int) -> None:
        """Upload gravity, wind and drag, which act on all particles alike."""
        check(library().cloth_plan_uniform(handle, self.gravity.ctypes.data, self.wind.ctypes.data, self.drag))

    def pair_counts(self) -> list[int]:
        """Return the number of elements of each list; 0 if the list is neither of springs nor of joints."""
        return [len(part.particles) if part.kind in ("spring", "joint") else 0 for part in self.listed]

    def decay(self) -> float:
        """Return the least c / k [s] of springs and joints, see `min_damping_time`."""
        pairs = [part.numbers for part in self.listed if part.kind in ("spring", "joint")]
        found = [least_decay(numbers[:, -2], numbers[:, -1]) for numbers in pairs]
        families = () if self.gridded is None else self.gridded.families
        found += [least_decay(each.stiffness / each.rest_length, each.damping) for each in families]
        return min(found, default=math.inf)

    def step_cost(self) -> float:
        """Return the estimated time of a step for one particle [ns]."""
        count = self.model.particle_count
        total = MOVE * count
        if self.gridded is not None:
            total += GRID_SPRING * count * len(self.gridded.families)
        total += sum(self._operations(part) for part in self.listed)
        # A call of Python takes as long as a hundred particles.
        return CONSTANTS.operation * total / count + CONSTANTS.own * (count + 100) / count * len(self.own)

    def hinge_cost(self) -> float:
        """Return the part of `step_cost` that hinges take [ns]."""
        total = sum(ELEMENT[part.kind] * len(part.particles) for part in self.listed if part.kind in HINGES)
        return CONSTANTS.operation * total / self.model.particle_count

    def _operations(self, part: Listed) -> int:
        """Return the operations of a step of all elements of a list."""
        by_rows = part.kind == "quad" and self.gridded is not None
        return (GRID_PANEL if by_rows else ELEMENT[part.kind]) * len(part.particles)

    def _order(self, handle: int) -> None:
        """Upload an order of particles in which neighbours lie close together; it is invisible outside."""
        from cloth_sim_ros.physics.ordering import local_order

        count = self.model.particle_count
        order = local_order(count, np.concatenate([_pairs(part.particles) for part in self.listed]))
        if order is not None:
            rank = np.empty(count, dtype=np.int64)
            rank[order] = np.arange(count)
            check(library().cloth_plan_order(handle, rank.ctypes.data))


def _one_sheet(parts: Sequence[Gridded]) -> Gridded | None:
    """Merge all spring families of a sheet: the engine sweeps over them together."""
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
    return Gridded(rows=rows, columns=columns, families=tuple(family for part in parts for family in part.families))


def _table(sheet: Gridded) -> Array:
    """Return the engine's coefficient table: one row for each family, shape (families, 6)."""
    table = np.zeros((len(FAMILIES), 6))
    table[:, 2], table[:, 5] = 1.0, -1.0
    for family in sheet.families:
        parity = -1 if family.parity is None else family.parity
        numbers = (1, family.stiffness, family.rest_length, family.damping, family.border, parity)
        table[FAMILIES.index(family.name)] = numbers
    return table


def _add_list(handle: int, part: Listed) -> None:
    kind, width, numbers = KINDS[part.kind]
    particles = np.ascontiguousarray(part.particles, dtype=np.int64)
    values = np.ascontiguousarray(part.numbers, dtype=np.float64)
    if particles.shape[1] != width or values.shape != (len(particles), numbers):
        raise ValueError(
            f"a list of kind '{part.kind}' has shapes {particles.shape} and {values.shape}; they must be "
            f"(m, {width}) and (m, {numbers})"
        )
    common = None if part.common is None else np.ascontiguousarray(part.common, dtype=np.float64)
    addresses = particles.ctypes.data, values.ctypes.data, None if common is None else common.ctypes.data
    check(library().cloth_plan_list(handle, kind, len(particles), *addresses))


def _pairs(groups: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return all pairs of particles within each row, shape (m, 2)."""
    width = groups.shape[1]
    return np.concatenate([groups[:, [i, j]] for i in range(width) for j in range(i + 1, width)])
