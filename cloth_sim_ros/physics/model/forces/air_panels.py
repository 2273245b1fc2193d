# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Aerodynamic drag of the cloth's surface, panel by panel.

A panel is a triangle or a grid cell. Drag across the surface is larger than along it.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from cloth_sim_ros.engine.binding import checked_floats, checked_indices
from cloth_sim_ros.physics.arithmetic.arrays import lengths
from cloth_sim_ros.physics.model.forces.force import Array, EngineForce
from cloth_sim_ros.physics.model.parts import ElementList, Part
from cloth_sim_ros.physics.old_names import with_old_names


@with_old_names(blown="in_wind", common="coefficients")
class AirPanels(EngineForce):
    """Linear drag of every panel of the cloth's surface relative to the air, shared evenly by its k corners.

        F = -A/k (c_n n n' + c_t (1 - n n')) (v - w).

    A is the panel's present area, n its unit normal, v the corner's velocity and w the wind. For a quadrilateral, A n
    is half the cross product of its diagonals. A cell bent along one of them has the drag of its outline. The force
    does not distinguish the two sides of the cloth. The dissipation is that of still air, v'Bv. The wind adds the work
    w'Bv (`external_power`).

    The damping blocks are exact. The force also changes as the panels turn; this part has no potential. The stiffness
    blocks bound that change for a cloth at rest in the wind. They ignore the cloth's own speed. Its contribution, of
    size ``c |v| L``, is small compared with a spring's ``k_s / l0``, and the error control covers it.

    Args:
        panels: particles of each panel in order around it, shape (m, 3) or (m, 4).
        normal: c_n, drag across the surface [N s/m^3], at least 0.
        tangential: c_t, drag along the surface [N s/m^3], at least 0.
        wind: velocity of the air [m/s], shape (3,).

    Raises:
        ValueError: if there are no panels, or for a coefficient or a wind that is not finite.
    """

    name = "air"
    damped = True

    def __init__(
        self, panels: ArrayLike, *, normal: float, tangential: float, wind: ArrayLike = (0.0, 0.0, 0.0)
    ) -> None:
        # As objects: the check below reports rows of different lengths.
        corners = 4 if np.shape(np.asarray(panels, dtype=object))[1:] == (4,) else 3
        self.panels = checked_indices("panels", panels, corners, np.iinfo(np.int64).max)
        if not len(self.panels):
            raise ValueError("there are no panels; air acts on a surface: give panels of three or four particles")
        self.normal = float(checked_floats("normal drag", normal, (), lower=0.0))
        self.tangential = float(checked_floats("tangential drag", tangential, (), lower=0.0))
        self.wind: Array = checked_floats("wind", wind, (3,), one_for_all=False)

    def in_wind(self, wind: ArrayLike) -> AirPanels:
        """Return a copy of this force with another wind [m/s], shape (3,)."""
        panels = copy.copy(self)
        panels.wind = checked_floats("wind", wind, (3,), one_for_all=False)
        return panels

    def max_drag_rate(self, x: Array, inverse_masses: Array) -> float:
        """Return an upper bound of a particle's drag over its mass [1/s], with c_n + c_t for all directions.

        Args:
            x: positions [m], shape (3, n).
            inverse_masses: of the particles [1/kg], shape (n,).
        """
        corners = [x[:, particles] for particles in self.panels.T]
        # The area is half the cross product of two edges of a triangle, of the diagonals of a quadrilateral.
        a, b = corners[1] - corners[0], corners[2] - corners[0]
        if len(corners) == 4:
            a, b = b, corners[3] - corners[1]
        shares = 0.5 / len(corners) * lengths(np.stack([a[i - 2] * b[i - 1] - a[i - 1] * b[i - 2] for i in range(3)]))
        areas = np.zeros_like(inverse_masses)
        for particles in self.panels.T:
            np.add.at(areas, particles, shares)
        return (self.normal + self.tangential) * float((areas * inverse_masses).max())

    @property
    def coefficients(self) -> Array:
        """Drag coefficients c_n across and c_t along the surface [N s/m^3], and the wind [m/s], shape (5,)."""
        return np.array([self.normal, self.tangential, *self.wind])

    def parts(self, particle_count: int) -> Sequence[Part]:
        panels = checked_indices("panels", self.panels, self.panels.shape[1], particle_count)
        kind = "triangle" if panels.shape[1] == 3 else "quad"
        none = np.empty((len(panels), 0))
        shared = self.coefficients
        return (ElementList(kind=kind, particles=panels, coefficients=none, shared_coefficients=shared),)
