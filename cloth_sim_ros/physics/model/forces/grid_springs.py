# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Springs of a regular sheet, by direction."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.engine.binding import FAMILIES, checked_floats
from cloth_sim_ros.physics.model.forces.force import Array, EngineForce
from cloth_sim_ros.physics.model.forces.pair_springs import PairSprings
from cloth_sim_ros.physics.model.parts import GridFamily, Part, SpringGrid
from cloth_sim_ros.physics.old_names import with_old_names

#: Ends of a family's springs relative to their owner's row and column: (row, column) of each end.
FAMILY_ENDS = {
    "right": ((0, 0), (0, 1)),
    "down": ((0, 0), (1, 0)),
    "diagonal": ((0, 0), (1, 1)),
    "antidiagonal": ((0, 1), (1, 0)),
    "right2": ((0, 0), (0, 2)),
    "down2": ((0, 0), (2, 0)),
}


@with_old_names(listed="pair_springs")
class GridSprings(EngineForce):
    """Springs of a sheet with `rows` times `columns` particles, by direction; indices are row * columns + column.

    The law is that of `PairSprings`. The engine calculates all families of a sheet in one sweep over its rows.

    Args:
        rows: number of rows of particles.
        columns: number of columns of particles.
        families: springs by direction, each at most once.
        name: the force's name in a model.

    Raises:
        ValueError: for a sheet without particles, an unknown or repeated family, or a property out of range.
    """

    def __init__(self, rows: int, columns: int, families: Sequence[GridFamily], *, name: str = "grid") -> None:
        if not isinstance(rows, int | np.integer) or not isinstance(columns, int | np.integer):
            raise ValueError(f"a sheet of {rows!r} x {columns!r} particles; both must be whole numbers")
        if rows < 1 or columns < 1:
            raise ValueError(f"a sheet of {rows} x {columns} particles; it needs at least 1 x 1")
        names = [family.name for family in families]
        for family in families:
            if family.name not in FAMILIES:
                raise ValueError(f"no spring family '{family.name}'; there are {', '.join(FAMILIES)}")
            if names.count(family.name) > 1:
                raise ValueError(f"family '{family.name}' is given {names.count(family.name)} times; give it once")
            if not float(checked_floats(f"rest length of '{family.name}'", family.rest_length, ())) > 0.0:
                raise ValueError(
                    f"rest length of '{family.name}' is {family.rest_length} m; it must be finite and above 0"
                )
            for quantity in ("stiffness", "damping", "border"):
                checked_floats(f"{quantity} of '{family.name}'", getattr(family, quantity), (), lower=0.0)
            if family.parity not in (None, 0, 1):
                raise ValueError(f"parity of '{family.name}' is {family.parity}; it must be 0, 1 or None")
        self.rows, self.columns, self.name = int(rows), int(columns), name
        self.families = tuple(sorted(families, key=lambda family: FAMILIES.index(family.name)))
        self.damped = any(family.damping > 0.0 for family in families)

    def parts(self, particle_count: int) -> Sequence[Part]:
        if particle_count != self.rows * self.columns:
            raise ValueError(
                f"'{self.name}' is a sheet of {self.rows} x {self.columns} particles; the model has {particle_count}"
            )
        return (SpringGrid(rows=self.rows, columns=self.columns, families=self.families),)

    @cached_property
    def pair_springs(self) -> PairSprings:
        """These springs as a list of particle pairs, in a force that is built on first use."""
        family_springs = [self._family_springs(family) for family in self.families]
        pairs = np.concatenate([np.empty((0, 2), dtype=np.int64), *(pairs for pairs, _ in family_springs)])
        coefficients = np.concatenate([np.empty((0, 3)), *(numbers for _, numbers in family_springs)])
        return PairSprings(pairs, coefficients[:, 0], coefficients[:, 1], coefficients[:, 2], name=self.name)

    @property
    def pairs(self) -> NDArray[np.int64]:
        """Particle indices of the springs' ends, shape (m, 2)."""
        return self.pair_springs.pairs

    def _family_springs(self, family: GridFamily) -> tuple[NDArray[np.int64], Array]:
        """Return pairs of a family, (m, 2), and rest length [m], k_s [N] and k_d [N s/m] of each, (m, 3)."""
        (row0, column0), (row1, column1) = FAMILY_ENDS[family.name]
        down, across = max(row0, row1), max(column0, column1)
        rows, columns = np.arange(max(self.rows - down, 0)), np.arange(max(self.columns - across, 0))
        row, column = (index.ravel() for index in np.meshgrid(rows, columns, indexing="ij"))
        if family.parity is not None:
            has_parity = (row + column) % 2 == family.parity
            row, column = row[has_parity], column[has_parity]
        pairs = np.stack(
            [(row + row0) * self.columns + column + column0, (row + row1) * self.columns + column + column1], axis=1
        )
        is_border = np.zeros(len(row), dtype=bool)
        if down == 0:
            is_border |= (row == 0) | (row == self.rows - 1)
        if across == 0:
            is_border |= (column == 0) | (column == self.columns - 1)
        factor = np.where(is_border, family.border, 1.0)
        coefficients = np.full(len(row), family.rest_length), factor * family.stiffness, factor * family.damping
        return pairs.astype(np.int64), np.stack(coefficients, axis=1)
