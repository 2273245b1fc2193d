# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Raw springs for experts: particles and springs as plain arrays, without moduli."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.arithmetic.deterministic_math import row_sum
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.forces.pair_springs import PairSprings, damping_coefficient
from cloth_sim_ros.physics.model.sheets.hinge_shape import HingeShape
from cloth_sim_ros.physics.model.sheets.surface import Surface
from cloth_sim_ros.physics.model.sheets.tables import checked_column, checked_table, pair_rows

_KEYS = ("positions", "masses", "springs", "rest_lengths", "stiffness", "k_d", "k_d0", "velocities", "triangles")


@attrs.frozen(eq=False, kw_only=True, slots=False)
class RawSprings:
    """Cloth as plain arrays: masses, positions, springs with k_s and k_d, and triangles of its surface, if any."""

    #: Starting positions [m], shape (particle_count, 3).
    start: Array
    #: Starting velocities [m/s], shape (particle_count, 3).
    velocities: Array
    #: Particle masses [kg], shape (particle_count,).
    mass: Array
    term: PairSprings
    surface_triangles: NDArray[np.int64]

    @classmethod
    def from_tables(cls, tables: dict[str, Any]) -> RawSprings:
        """Return the springs and particles of the named tables of a springs file, checked.

        Args:
            tables: the tables:

                - `positions` (n, 3) [m]
                - `masses` [kg], one or n
                - `springs` (m, 2), particle indices
                - `rest_lengths` [m], one or m; default: the distance at the start; 0 for a joint (S4)
                - `stiffness` k_s [N] (of a joint N/m), one or m
                - `k_d` [N s/m] or the dimensionless `k_d0`, one or m
                - `velocities` (n, 3) [m/s]
                - `triangles` (t, 3): the surface, which is shown, touches obstacles and itself, and has hinges

        Raises:
            ValueError: naming the table and the fault.
        """
        unknown = sorted(set(tables) - set(_KEYS))
        if unknown:
            raise ValueError(f"unknown table '{unknown[0]}'; there are {', '.join(_KEYS)}")
        for name in ("positions", "masses", "springs", "stiffness"):
            if name not in tables:
                raise ValueError(f"table '{name}' is missing")
        positions = checked_table("positions", tables["positions"], np.float64, 3)
        count = len(positions)
        velocities = checked_table("velocities", tables.get("velocities", np.zeros((count, 3))), np.float64, 3)
        if velocities.shape != positions.shape:
            raise ValueError(f"table 'velocities' has {len(velocities)} rows, 'positions' {count}; give one a particle")
        masses = checked_column("masses", tables["masses"], count)
        bad_masses = np.flatnonzero(~(np.isfinite(masses) & (masses > 0.0)))
        if bad_masses.size:
            raise ValueError(
                f"mass of particle {bad_masses[0]} is {masses[bad_masses[0]]} kg; it must be finite and above 0"
            )
        pairs = checked_table("springs", tables["springs"], np.int64, 2)
        triangles = checked_table("triangles", tables.get("triangles", np.empty((0, 3), np.int64)), np.int64, 3)
        for name, indices in (("springs", pairs), ("triangles", triangles)):
            wrong = np.argwhere((indices < 0) | (indices >= count))
            if wrong.size:
                row, column = wrong[0]
                raise ValueError(
                    f"row {row} of table '{name}' names particle {indices[row, column]}; "
                    f"there are {count}, counted from 0"
                )
        rest_lengths = checked_column(
            "rest_lengths", tables.get("rest_lengths", _distances(positions, pairs)), len(pairs)
        )
        k_s = checked_column("stiffness", tables["stiffness"], len(pairs))
        stiffness = k_s / np.where(rest_lengths > 0.0, rest_lengths, 1.0)
        if "k_d" in tables and "k_d0" in tables:
            raise ValueError("both tables 'k_d' and 'k_d0' are given; give one of them")
        if "k_d0" in tables:
            # The lecture's m of two unequal ends: the reduced mass times two.
            effective_mass = 2.0 / (1.0 / masses[pairs[:, 0]] + 1.0 / masses[pairs[:, 1]])
            damping = damping_coefficient(checked_column("k_d0", tables["k_d0"], len(pairs)), stiffness, effective_mass)
        else:
            damping = checked_column("k_d", tables.get("k_d", 0.0), len(pairs))
        term = PairSprings(pairs, rest_lengths, k_s, damping)
        return cls(start=positions, velocities=velocities, mass=masses, term=term, surface_triangles=triangles)

    def positions(self) -> Array:
        """Return a copy of the starting positions [m], shape (particle_count, 3)."""
        return self.start.copy()

    def masses(self, density: float) -> Array:
        """Return a copy of the given particle masses [kg], shape (particle_count,); the density is not used."""
        return self.mass.copy()

    def triangles(self) -> NDArray[np.int64]:
        """Return the particle indices of the surface's triangles, shape (m, 3); empty if there is none."""
        return self.surface_triangles

    def edge_lengths(self) -> Array:
        """Return the lengths of triangles' edges [m], (m, 3): of a spring at rest, or else of the start.

        An edge with a spring has its rest length, because the start may be stretched; other edges have their distance
        at the start.
        """
        ends = np.stack([self.surface_triangles, np.roll(self.surface_triangles, -1, axis=1)], axis=-1).reshape(-1, 2)
        return self._lengths(ends).reshape(-1, 3)

    @cached_property
    def surface(self) -> Surface:
        """Topology of the triangles: edges, hinges, boundary; computed and checked at first access.

        Raises:
            ValueError: for triangles that are no oriented surface.
        """
        try:
            return Surface.from_triangles(self.surface_triangles, particle_count=len(self.start))
        except ValueError as error:
            raise ValueError(f"table 'triangles': {error}") from error

    def hinge_shape(self, hinges: NDArray[np.int64]) -> HingeShape:
        """Return the rest shape of hinges (m, 4): sides as in `edge_lengths`, fold angles of the start.

        Raises:
            ValueError: for edges that make no triangle.
        """
        first, second, wing0, wing1 = hinges.T
        sides = [(first, wing0), (second, wing0), (first, wing1), (second, wing1)]
        lengths = [self._lengths(np.stack(pair, axis=1)) for pair in sides]
        edge = self._lengths(hinges[:, :2])
        return HingeShape.of_sides(edge, np.stack(lengths, axis=1), HingeShape.of(hinges, self.start))

    def _lengths(self, pairs: NDArray[np.int64]) -> Array:
        """Return the rest length of each pair's spring, or without a spring its distance at the start [m], (m,)."""
        lengths, rows = _distances(self.start, pairs), pair_rows(self.term.pairs, pairs)
        has_spring = rows >= 0
        lengths[has_spring] = self.term.rest_length[rows[has_spring]]
        return lengths


def _distances(positions: Array, pairs: NDArray[np.int64]) -> Array:
    """Return the distance [m] of the two particles of each pair, shape (pair_count,)."""
    away = positions[pairs[:, 1]] - positions[pairs[:, 0]]
    return np.sqrt(row_sum((away * away).T))
