# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A rectangular sheet as a regular grid of particles and springs."""

from __future__ import annotations

import math

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.forces.grid_springs import GridSprings
from cloth_sim_ros.physics.model.forces.pair_springs import damping_coefficient
from cloth_sim_ros.physics.model.parts import GridFamily
from cloth_sim_ros.physics.model.sheets.material import ThreadStiffness
from cloth_sim_ros.physics.model.sheets.surface import Layout, Surface, grid_triangles


@attrs.frozen(kw_only=True)
class GridSheet:
    """Geometry of a flat sheet of rows x columns particles; particle indices are row * columns + column.

    It lies in its own x-y plane around the origin: columns along x, row 0 at the top (largest y). `height` and `width`
    are in metres.
    """

    height: float
    width: float
    rows: int
    columns: int
    layout: Layout

    @property
    def spacing(self) -> tuple[float, float]:
        """Distance of neighbours along a row and along a column, hx and hy [m]."""
        return self.width / (self.columns - 1), self.height / (self.rows - 1)

    def positions(self) -> Array:
        """Return rest positions [m], shape (rows * columns, 3)."""
        x = np.linspace(-0.5, 0.5, self.columns) * self.width
        y = np.linspace(0.5, -0.5, self.rows) * self.height
        grid = np.zeros((self.rows, self.columns, 3))
        grid[..., 0] = x
        grid[..., 1] = y[:, None]
        return grid.reshape(-1, 3)

    def masses(self, density: float) -> Array:
        """Return particle masses [kg] for a mass per area [kg/m^2]: half at borders, a quarter at corners."""
        hx, hy = self.spacing
        return (density * hx * hy * _border_weights(self.rows)[:, None] * _border_weights(self.columns)).ravel()

    def triangles(self) -> NDArray[np.int64]:
        """Return the particle indices of the surface's triangles, shape (m, 3)."""
        return grid_triangles(self.rows, self.columns, self.layout)

    @property
    def surface(self) -> Surface:
        """Topology of the grid's triangles: edges, hinges, boundary; computed at each access."""
        return Surface.from_triangles(self.triangles(), particle_count=self.rows * self.columns)

    def has_edge(self, name: str) -> bool:
        """Return true if `edge` knows this name of an edge or corner."""
        return name in self._edges()

    def edge(self, name: str) -> NDArray[np.int64]:
        """Return the particles of an edge (top, bottom, left, right) or corner (top_left, ...); refuse other names.

        Raises:
            ValueError: for another name.
        """
        particles = self._edges()
        if name not in particles:
            raise ValueError(f"'{name}' is no edge or corner of a grid; there are {', '.join(particles)}")
        return particles[name]

    def _edges(self) -> dict[str, NDArray[np.int64]]:
        """Return the particle indices of each edge and corner, by its name."""
        index = np.arange(self.rows * self.columns).reshape(self.rows, self.columns)
        rows = {"top": index[0], "bottom": index[-1]}
        columns = {"left": index[:, 0], "right": index[:, -1]}
        particles: dict[str, NDArray[np.int64]] = {**rows, **columns}
        for row, first in rows.items():
            for end_name, column in (("left", 0), ("right", -1)):
                particles[f"{row}_{end_name}"] = first[[column]]
        return particles

    def families(
        self, threads: ThreadStiffness, *, k_d0: float, density: float, retardation: float = 0.0
    ) -> dict[str, list[GridFamily]]:
        """Return the spring families of the forces `structural`, `shear` and, with bending threads, `bend`, by name.

        Border threads carry half of k_s. Damping is k_d = k_d0 sqrt(k m) with the mass m of a particle inside the
        sheet. Therefore it scales at the border with half the stiffness and half the mass, as the springs do. With a
        retardation time the damping is that time times the stiffness k instead.

        Args:
            threads: spring stiffnesses.
            k_d0: dimensionless damping.
            density: mass per area [kg/m^2].
            retardation: retardation time [s]; 0 uses k_d0.
        """
        hx, hy = self.spacing
        mass = density * hx * hy

        def family(name: str, k_s: float, l0: float, *, border: float = 1.0, parity: int | None = None) -> GridFamily:
            k = k_s / l0
            damping = k * retardation or float(damping_coefficient(k_d0, k, mass))
            return GridFamily(name=name, stiffness=k_s, rest_length=l0, damping=damping, border=border, parity=parity)

        right = family("right", threads.along_rows, hx, border=0.5)
        down = family("down", threads.along_columns, hy, border=0.5)
        terms = {"structural": [right, down]}
        if threads.diagonal > 0.0:
            # As in `grid_diagonals`: left runs down to the right; alternating is left if row + column is even.
            parities: dict[Layout, tuple[list[int | None], list[int | None]]] = {
                "left": ([None], []),
                "right": ([], [None]),
                "alternating": ([0], [1]),
                "both": ([None], [None]),
            }
            lefts, rights = parities[self.layout]
            length = math.sqrt(hx * hx + hy * hy)
            terms["shear"] = [family("diagonal", threads.diagonal, length, parity=parity) for parity in lefts]
            terms["shear"] += [family("antidiagonal", threads.diagonal, length, parity=parity) for parity in rights]
        bends = []
        if threads.bend_along_rows > 0.0 and self.columns > 2:
            bends.append(family("right2", threads.bend_along_rows, 2.0 * hx, border=0.5))
        if threads.bend_along_columns > 0.0 and self.rows > 2:
            bends.append(family("down2", threads.bend_along_columns, 2.0 * hy, border=0.5))
        if bends:
            terms["bend"] = bends
        return terms

    def springs(self, named: dict[str, list[GridFamily]]) -> list[GridSprings]:
        """Return a list with one force of grid springs for each name and its families."""
        return [GridSprings(self.rows, self.columns, families, name=name) for name, families in named.items()]


def _border_weights(count: int) -> Array:
    weights = np.ones(count)
    weights[0] = weights[-1] = 0.5
    return weights
