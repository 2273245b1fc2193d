# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Air on the cloth's surface: each triangle is a panel that the air pushes more across than along."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from cloth_sim_ros.physics.kernels import air_panels as kernels
from cloth_sim_ros.physics.terms.base import Array, Term


class AirPanels(Term):
    """Linear drag of every triangle relative to the air, a third of it at each of its corners.

        F = -A/3 (c_n n n' + c_t (1 - n n')) (v - w)

    with the triangle's present area A and unit normal n, the corner's velocity v and the wind w. It takes no side of
    the cloth for its front. Dissipation is that of still air, v'Bv; what the wind adds, w'Bv, is its work (`supply`).

    The damping blocks are exact. The force also turns with the panels, which no potential describes; the stiffness
    blocks bound that for a cloth at rest in the wind. Of the cloth's own speed they know nothing: what it adds is small
    beside the springs (c |v| L against k_s / l0), and left to the error control.

    Args:
        triangles: particles of each triangle, shape (m, 3).
        normal: c_n, drag across the surface [N s/m^3], at least 0.
        tangential: c_t, drag along the surface [N s/m^3], at least 0.
        wind: velocity of the air [m/s], shape (3,).

    Raises:
        ValueError: for no triangles, or a coefficient or a wind that is not finite.
    """

    name = "air"
    damped = True

    def __init__(
        self, triangles: ArrayLike, *, normal: float, tangential: float, wind: ArrayLike = (0.0, 0.0, 0.0)
    ) -> None:
        self.triangles = np.ascontiguousarray(triangles, dtype=np.int64).reshape(-1, 3)
        if not len(self.triangles) or self.triangles.min() < 0:
            raise ValueError("air acts on a surface: give its triangles, particles counted from 0")
        for what, value in (("normal", normal), ("tangential", tangential)):
            if not (np.isfinite(value) and value >= 0.0):
                raise ValueError(f"{what} drag is {value} N s/m^3; it must be finite and at least 0")
        self.wind: Array = np.array(wind, dtype=np.float64).reshape(3)
        if not np.isfinite(self.wind).all():
            raise ValueError(f"the wind is {self.wind.tolist()} m/s; it must be finite")
        self.normal, self.tangential = float(normal), float(tangential)

    def add_force(self, t: float, x: Array, v: Array, f: Array) -> None:
        kernels.add_forces(self.triangles, self.normal, self.tangential, self.wind, x, v, f)

    def dissipation(self, t: float, x: Array, v: Array) -> float:
        return float(kernels.powers(self.triangles, self.normal, self.tangential, self.wind, x, v)[0])

    def supply(self, t: float, x: Array, v: Array) -> float:
        return float(kernels.powers(self.triangles, self.normal, self.tangential, self.wind, x, v)[1])

    def add_stiffness(self, x: Array, blocks: Array) -> None:
        if self.wind.any():
            speed = float(np.sqrt(np.sum(self.wind * self.wind)))
            kernels.add_turning(self.triangles, self.normal, self.tangential, speed, x, blocks)

    def add_damping(self, x: Array, blocks: Array) -> None:
        kernels.add_blocks(self.triangles, self.normal, self.tangential, x, blocks)

    def add_jacobian_product(self, t: float, x: Array, v: Array, dx: Array, dv: Array, out: Array) -> None:
        kernels.add_jacobian_product(self.triangles, self.normal, self.tangential, self.wind, x, v, dx, dv, out)
