# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Air on the cloth's surface: each triangle or cell is a panel that the air pushes more across than along."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from cloth_sim_ros.engine.binding import indices
from cloth_sim_ros.physics.forces.force import Array, Force
from cloth_sim_ros.physics.parts import Listed, Part


class AirPanels(Force):
    """Linear drag of every panel relative to the air, shared evenly by its k corners.

        F = -A/k (c_n n n' + c_t (1 - n n')) (v - w)

    with the panel's present area A and unit normal n, the corner's velocity v and the wind w. Of a quadrilateral, A n
    is half the cross product of its diagonals: a cell that is bent along one of them has the air of its outline. It
    takes no side of the cloth for its front. Dissipation is that of still air, v'Bv; what the wind adds, w'Bv, is its
    work (`supply`).

    The damping blocks are exact. The force also turns with the panels, which no potential describes; the stiffness
    blocks bound that for a cloth at rest in the wind. Of the cloth's own speed they know nothing: what it adds is small
    beside the springs (c |v| L against k_s / l0), and left to the error control.

    Args:
        panels: particles of each panel in order around it, shape (m, 3) or (m, 4).
        normal: c_n, drag across the surface [N s/m^3], at least 0.
        tangential: c_t, drag along the surface [N s/m^3], at least 0.
        wind: velocity of the air [m/s], shape (3,).

    Raises:
        ValueError: for no panels, or a coefficient or a wind that is not finite.
    """

    name = "air"
    damped = True

    def __init__(
        self, panels: ArrayLike, *, normal: float, tangential: float, wind: ArrayLike = (0.0, 0.0, 0.0)
    ) -> None:
        self.panels = np.ascontiguousarray(panels, dtype=np.int64)
        if self.panels.ndim != 2 or self.panels.shape[1] not in (3, 4) or not self.panels.size or self.panels.min() < 0:
            raise ValueError(
                f"air acts on a surface: give panels of three or four particles, counted from 0; got an array of shape "
                f"{self.panels.shape}"
            )
        for what, value in (("normal", normal), ("tangential", tangential)):
            if not (np.isfinite(value) and value >= 0.0):
                raise ValueError(f"{what} drag is {value} N s/m^3; it must be finite and at least 0")
        self.wind: Array = np.array(wind, dtype=np.float64).reshape(3)
        if not np.isfinite(self.wind).all():
            raise ValueError(f"the wind is {self.wind.tolist()} m/s; it must be finite")
        self.normal, self.tangential = float(normal), float(tangential)

    def parts(self, particle_count: int) -> Sequence[Part]:
        panels = indices("panels", self.panels, self.panels.shape[1], particle_count)
        kind = "triangle" if panels.shape[1] == 3 else "quad"
        common = np.array([self.normal, self.tangential, *self.wind])
        return (Listed(kind=kind, particles=panels, numbers=np.empty((len(panels), 0)), common=common),)
