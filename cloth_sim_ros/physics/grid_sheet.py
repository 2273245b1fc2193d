# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A rectangular sheet as a regular grid of particles and springs."""

from __future__ import annotations

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.material import Threads
from cloth_sim_ros.physics.surface import Layout, Surface, grid_diagonals, grid_triangles
from cloth_sim_ros.physics.terms.base import Array
from cloth_sim_ros.physics.terms.pair_springs import PairSprings, lecture_damping


@attrs.frozen(kw_only=True)
class GridSheet:
    """Geometry of a flat sheet of rows x columns particles, numbered row * columns + column.

    It lies in its own x-y plane about the origin: columns along x, row 0 at the top (largest y).
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
        """Rest positions [m], shape (rows * columns, 3)."""
        x = np.linspace(-0.5, 0.5, self.columns) * self.width
        y = np.linspace(0.5, -0.5, self.rows) * self.height
        grid = np.zeros((self.rows, self.columns, 3))
        grid[..., 0] = x
        grid[..., 1] = y[:, None]
        return grid.reshape(-1, 3)

    def masses(self, density: float) -> Array:
        """Particle masses [kg] for a mass per area [kg/m^2]: half at the borders, a quarter at the corners."""
        hx, hy = self.spacing
        return (density * hx * hy * _border_weights(self.rows)[:, None] * _border_weights(self.columns)).ravel()

    def triangles(self) -> NDArray[np.int64]:
        """Triangles of the surface, shape (m, 3)."""
        return grid_triangles(self.rows, self.columns, self.layout)

    @property
    def surface(self) -> Surface:
        """The surface of the grid's triangles."""
        return Surface.from_triangles(self.triangles(), particle_count=self.rows * self.columns)

    def edge(self, name: str) -> NDArray[np.int64]:
        """Return the particles of an edge (top, bottom, left, right) or a corner (top_left, ...).

        Raises:
            ValueError: for another name.
        """
        index = np.arange(self.rows * self.columns).reshape(self.rows, self.columns)
        rows = {"top": index[0], "bottom": index[-1]}
        columns = {"left": index[:, 0], "right": index[:, -1]}
        places: dict[str, NDArray[np.int64]] = {**rows, **columns}
        for row, first in rows.items():
            for side, column in (("left", 0), ("right", -1)):
                places[f"{row}_{side}"] = first[[column]]
        if name not in places:
            raise ValueError(f"'{name}' is no edge or corner of a grid; there are {', '.join(places)}")
        return places[name]

    def springs(self, threads: Threads, *, k_d0: float, density: float, retardation: float = 0.0) -> list[PairSprings]:
        """Return the terms `structural`, `shear` and, with bending threads, `bend`.

        Border threads carry half of k_s. Damping is k_d = k_d0 sqrt(k m) with the mass of a particle inside the sheet,
        so that it scales with the border's half stiffness and half mass as the springs do; with a retardation time [s]
        it is that time times the stiffness k instead.
        """
        hx, hy = self.spacing
        index = np.arange(self.rows * self.columns).reshape(self.rows, self.columns)
        row_weight = np.broadcast_to(_border_weights(self.rows)[:, None], index.shape)
        column_weight = np.broadcast_to(_border_weights(self.columns), index.shape)
        mass = density * hx * hy

        def family(
            pairs: list[tuple[NDArray[np.int64], NDArray[np.int64], Array, float, float]], name: str
        ) -> PairSprings:
            ends, rest, stiffness, damping = [], [], [], []
            for near, far, weight, length, k_s in pairs:
                ends.append(np.stack([near.ravel(), far.ravel()], axis=1))
                rest.append(np.full(near.size, length))
                stiffness.append(weight.ravel() * (k_s / length))
                k = k_s / length
                damping.append(weight.ravel() * (k * retardation or lecture_damping(k_d0, k, mass)))
            return PairSprings(
                np.concatenate(ends),
                np.concatenate(rest),
                np.concatenate(stiffness),
                np.concatenate(damping),
                name=name,
                weak=name != "structural",
            )

        terms = [
            family(
                [
                    (index[:, :-1], index[:, 1:], row_weight[:, 1:], hx, threads.along_rows),
                    (index[:-1], index[1:], column_weight[1:], hy, threads.along_columns),
                ],
                "structural",
            )
        ]
        if threads.diagonal > 0.0:
            diagonals = grid_diagonals(self.rows, self.columns, self.layout)
            terms.append(
                family(
                    [
                        (
                            diagonals[:, 0],
                            diagonals[:, 1],
                            np.ones(len(diagonals)),
                            float(np.hypot(hx, hy)),
                            threads.diagonal,
                        )
                    ],
                    "shear",
                )
            )
        if threads.bend_along_rows > 0.0:
            bends = []
            if self.columns > 2:
                bends.append((index[:, :-2], index[:, 2:], row_weight[:, 2:], 2.0 * hx, threads.bend_along_rows))
            if self.rows > 2:
                bends.append((index[:-2], index[2:], column_weight[2:], 2.0 * hy, threads.bend_along_columns))
            if bends:
                terms.append(family(bends, "bend"))
        return terms


def _border_weights(count: int) -> Array:
    weights = np.ones(count)
    weights[0] = weights[-1] = 0.5
    return weights
