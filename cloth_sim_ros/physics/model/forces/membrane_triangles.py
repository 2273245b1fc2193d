# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Membrane of woven cloth: triangles of constant strain with moduli by thread direction."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cloth_sim_ros.engine.binding import checked_floats, checked_indices
from cloth_sim_ros.physics.model.forces.force import Array, EngineForce
from cloth_sim_ros.physics.model.parts import ElementList, Part, SpringGrid


class MembraneTriangles(EngineForce):
    """Membrane force of orthotropic Saint-Venant-Kirchhoff triangles; docs/derivations/membrane.md derives it.

    a and b are the present images of unit vectors along warp and weft. Green's strains are e1 = (a·a - 1)/2 and e2 =
    (b·b - 1)/2, the shear is γ = a·b. The energy per area at rest is C11 e1²/2 + C12 e1 e2 + C22 e2²/2 + G γ²/2.
    Damping adds the stress D (ė1, ė2, γ̇), times the size sqrt(2 area) of the triangle unless `sized` is False. The
    force has no resultant and no torque. It resists compression most at 1/sqrt(3) of the rest length, then less. A
    collapsed triangle is an unstable equilibrium without a preferred side.

    With `growth`, C11, C22 and G grow with the square of e1, e2 and γ up to a limit, C11 and C22 only in tension.

    Args:
        triangles: particles of each triangle, shape (m, 3).
        corners: rest coordinates of the corners along warp and weft [m], shape (m, 3, 2).
        moduli: C11, C12, C22, G [N/m], shape (4,); positive semidefinite.
        viscosities: D11, D12, D22, D33, shape (4,), positive semidefinite, in N s/m², or N s/m with `sized` False.
        sized: whether damping grows with the size of the triangle.
        growth: strain at which C11, C22 and G stop growing, and their growth there [N/m], shape (3, 2); None for
            constant moduli.
        share: fraction of its area that a triangle stands for, 0.5 if two layers of triangles cover the sheet.
        grid: rows and columns of particles if the sheet is a grid. The engine then evaluates its hinges and panels by
            rows.
        name: the force's name in a model.

    Raises:
        ValueError: for a triangle without area, a particle that a triangle names twice, or numbers that are not finite
            or not positive semidefinite, or a modulus that falls.
    """

    def __init__(
        self,
        triangles: ArrayLike,
        corners: ArrayLike,
        *,
        moduli: ArrayLike,
        viscosities: ArrayLike = (0.0, 0.0, 0.0, 0.0),
        sized: bool = True,
        growth: ArrayLike | None = None,
        share: float = 1.0,
        grid: tuple[int, int] | None = None,
        name: str = "membrane",
    ) -> None:
        self.name = name
        self.triangles: NDArray[np.int64] = checked_indices(
            f"triangles of '{name}'", triangles, 3, np.iinfo(np.int64).max
        )
        i, j, k = self.triangles.T
        repeated = np.flatnonzero((i == j) | (j == k) | (k == i))
        if repeated.size:
            raise ValueError(
                f"triangle {repeated[0]} of '{name}' is {self.triangles[repeated[0]].tolist()}; it needs three "
                "different particles"
            )
        shape = (len(self.triangles), 3, 2)
        #: Rest coordinates of the corners along warp and weft [m], shape (m, 3, 2).
        self.corners = points = checked_floats(f"corners of '{name}'", corners, shape, one_for_all=False)
        #: C11, C12, C22, G [N/m], and D11, D12, D22, D33.
        self.moduli = _checked_stiffness(f"moduli of '{name}'", moduli)
        self.viscosities = _checked_stiffness(f"viscosities of '{name}'", viscosities)
        self.damped = bool(np.any(self.viscosities))
        #: Strains at which C11, C22 and G stop growing, and their growth [N/m], shape (3, 2); None if constant.
        self.growth = None if growth is None else _checked_growth(f"growth of '{name}'", growth)
        self.grid = grid
        (x1, y1), (x2, y2) = (points[:, 1] - points[:, 0]).T, (points[:, 2] - points[:, 0]).T
        determinant = x1 * y2 - x2 * y1
        flat = np.flatnonzero(~(np.abs(determinant) > 0.0))
        if flat.size:
            raise ValueError(f"triangle {flat[0]} of '{name}' has no area at rest; its corners must not be in line")
        size = np.sqrt(np.abs(determinant)) if sized else np.ones_like(determinant)
        #: Area at rest that each triangle stands for [m^2], shape (m,).
        self.areas: Array = 0.5 * share * np.abs(determinant)
        damping = self.areas * size if self.damped else np.zeros_like(self.areas)
        gradients = y2 / determinant, -y1 / determinant, -x2 / determinant, x1 / determinant
        #: p1, p2, q1, q2 [1/m], area and damping of each triangle as in the engine's law, shape (m, 6).
        self.coefficients: Array = np.stack([*gradients, self.areas, damping], axis=1)

    def parts(self, particle_count: int) -> Sequence[Part]:
        triangles = checked_indices(f"triangles of '{self.name}'", self.triangles, 3, particle_count)
        if not len(triangles):
            return ()
        shared, kind = [self.moduli, self.viscosities], "membrane"
        if self.growth is not None:
            limits, increases = self.growth.T
            rates = np.divide(increases, limits * limits, out=np.zeros(3), where=increases > 0.0)
            shared, kind = [*shared, np.stack([limits, rates], axis=1).ravel()], "stiffening_membrane"
        elements = ElementList(
            kind=kind,
            particles=triangles,
            coefficients=self.coefficients,
            shared_coefficients=np.concatenate(shared),
        )
        if self.grid is None:
            return (elements,)
        if self.grid[0] * self.grid[1] != particle_count:
            raise ValueError(
                f"'{self.name}' is a sheet of {self.grid[0]} x {self.grid[1]} particles, and the model has "
                f"{particle_count}"
            )
        return SpringGrid(rows=self.grid[0], columns=self.grid[1], families=()), elements


def _checked_growth(name: str, growth: ArrayLike) -> Array:
    """Check strain limits and increases [N/m] of three growing moduli; return them as an array, shape (3, 2).

    Raises:
        ValueError: unless they are finite, not negative, and an increase has a limit above 0.
    """
    array = checked_floats(name, growth, (3, 2), one_for_all=False)
    if (array < 0.0).any() or ((array[:, 1] > 0.0) & (array[:, 0] == 0.0)).any():
        raise ValueError(
            f"{name} is {array.tolist()}; limits and increases must be at least 0, and with an increase the limit "
            "above 0"
        )
    return array


def _checked_stiffness(name: str, numbers: ArrayLike) -> Array:
    """Check that C11, C12, C22, C33 are positive semidefinite; return them as an array, shape (4,).

    Raises:
        ValueError: unless they are finite and positive semidefinite.
    """
    array = checked_floats(name, numbers, (4,), one_for_all=False)
    warp, coupling, weft, shear = array.tolist()
    if min(warp, weft, shear) < 0.0 or coupling * coupling > warp * weft:
        raise ValueError(
            f"{name} are {array.tolist()}; C11, C22 and C33 must be at least 0, and C12² at most C11 C22, else energy "
            "comes from nowhere"
        )
    return array
