# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Heavy elastica and a clamped strip of bending springs under the same load.

The strip is clamped level at one end and bends under its weight. The load is b = w L³/D (w weight per area, D bending
modulus), the arc length from the clamp σ = s/L. The slope φ below the level obeys φ'' = -b (1 - σ) cos φ, φ(0) = 0,
φ'(1) = 0 (Bickley, Phil. Mag. 17, 1934).
"""

from __future__ import annotations

import math
from typing import Literal

import attrs
import numpy as np

from cloth_sim_ros import Force, Gravity, Model, PairSprings, compile
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.sheets.bending import bending_terms, grid_hinge_constants
from cloth_sim_ros.physics.model.sheets.surface import Surface, grid_diagonals, grid_hinges, grid_triangles
from validation.equilibrium import find_equilibrium


@attrs.frozen(eq=False, kw_only=True)
class Elastica:
    """The exact shape of a strip of length 1 m."""

    #: b = w L³/D.
    load: float
    #: Angle of the tip below the level [rad].
    slope_at_tip: float
    #: Arc lengths from the clamp [m], ascending, (k,).
    arc: Array
    #: Distance from the clamp and height below it at those [m], (k, 2).
    curve: Array

    def at(self, arc: Array) -> Array:
        """Return distance and depth [m] at arc lengths (m,), (m, 2)."""
        from scipy.interpolate import CubicSpline

        return np.asarray(CubicSpline(self.arc, self.curve)(arc))


def heavy_elastica(slope_at_tip: float) -> Elastica:
    """Solve for the load that bends the tip by `slope_at_tip` [rad], between 0 and π/2, and for the shape.

    Raises:
        ValueError: for an angle out of range.
        RuntimeError: if the boundary value problem is not solved to 1e-10.
    """
    from scipy.integrate import solve_bvp

    if not 0.0 < slope_at_tip < 0.5 * math.pi:
        raise ValueError(f"slope_at_tip is {slope_at_tip} rad; it must lie between 0 and π/2")

    def rates(s: Array, y: Array, p: Array) -> Array:
        return np.vstack((y[1], -p[0] * (1.0 - s) * np.cos(y[0]), np.cos(y[0]), np.sin(y[0])))

    def ends(a: Array, b: Array, p: Array) -> Array:
        return np.array((a[0], b[1], b[0] - slope_at_tip, a[2], a[3]))

    s = np.linspace(0.0, 1.0, 101)
    guess = np.vstack((slope_at_tip * (1 - (1 - s) ** 3), 3 * slope_at_tip * (1 - s) ** 2, s, 0 * s))
    solved = solve_bvp(rates, ends, s, guess, p=[6.0 * slope_at_tip], tol=1e-10, max_nodes=100_000)
    if not solved.success:
        raise RuntimeError(f"the elastica of tip slope {slope_at_tip} rad was not solved: {solved.message}")
    return Elastica(load=float(solved.p[0]), slope_at_tip=slope_at_tip, arc=solved.x, curve=solved.y[2:].T.copy())


@attrs.frozen(eq=False, kw_only=True)
class Strip:
    """A clamped strip of springs at rest under its weight."""

    #: Arc length from the clamp of every column of particles beyond it [m], (c,).
    arc: Array
    #: Mean distance from the clamp and depth below it of the columns [m], (c, 2).
    curve: Array
    #: Largest sideways offset of a column's mean [m]: a strip that twists leaves its plane.
    max_lateral_offset: float


def hanging_strip(
    bending: Literal["crossed", "altitude", "quadratic"],
    exact: Elastica,
    *,
    columns: int,
    rows: int = 3,
    stretch: float = 1e6,
) -> Strip:
    """Find the equilibrium, under the load of `exact`, of a strip of length 1 m and modulus 1 N m.

    The first two columns are clamped. The hinges at a column represent the curvature of half a cell on either side.
    Therefore the continuum's clamp lies half a cell before column 1. The tip carries half a column's mass, the border
    rows half a row's.

    Args:
        bending: bending model.
        exact: the elastica; its load is applied and its shape is the initial guess.
        columns: particles along the strip, including the two clamped ones.
        rows: particles across.
        stretch: stiffness of the edge and shear springs [N/m] in units of D/L².

    Raises:
        RuntimeError: if no equilibrium is found.
    """
    cell_size = 1.0 / (columns - 1.5)
    arc = np.linspace(-0.5 * cell_size, 1.0, columns)
    column = np.tile(np.arange(columns), rows)
    row = np.repeat(np.arange(rows), columns)
    rest_positions = np.stack((arc[column], row * cell_size, np.zeros(rows * columns)), axis=1)
    masses = np.full(rows * columns, exact.load * cell_size * cell_size)  # gravity is 1
    masses[column == columns - 1] *= 0.5
    masses[(row == 0) | (row == rows - 1)] *= 0.5
    hinges = grid_hinges(rows, columns)
    edges = Surface.from_triangles(grid_triangles(rows, columns, "left")).edges
    pairs = np.concatenate((edges, grid_diagonals(rows, columns, "right")))
    lengths = np.linalg.norm(rest_positions[pairs[:, 1]] - rest_positions[pairs[:, 0]], axis=1)
    constants = grid_hinge_constants(hinges, columns=columns, spacing=(cell_size, cell_size), bending_modulus=1.0)
    forces: list[Force] = [PairSprings(pairs, lengths, stretch * lengths), Gravity((0.0, 0.0, -1.0))]
    forces += bending_terms(bending, hinges, rest_positions, hinge_constants=constants, existing=pairs)
    free = np.flatnonzero(column > 1)
    start = rest_positions.copy()
    curve = exact.at(arc[column[free]])
    start[free, 0], start[free, 2] = curve[:, 0], -curve[:, 1]
    model = Model(masses, forces)
    # Gravity is 1 m/s^2.
    is_free = np.repeat(column[:, None] > 1, 3, axis=1)
    positions = find_equilibrium(compile(model), start, is_free, accuracy=1e-6 * model.mass)
    mean_positions = np.array([positions[column == k].mean(axis=0) for k in range(2, columns)])
    centre = rest_positions[:, 1].mean()
    max_lateral_offset = float(np.abs(mean_positions[:, 1] - centre).max())
    return Strip(arc=arc[2:], curve=mean_positions[:, [0, 2]] * (1.0, -1.0), max_lateral_offset=max_lateral_offset)
