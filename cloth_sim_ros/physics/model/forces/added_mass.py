# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Added mass: air that the surface carries along, panel by panel."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from cloth_sim_ros.engine.binding import checked_floats, checked_indices
from cloth_sim_ros.physics.model.forces.force import Array, EngineForce
from cloth_sim_ros.physics.model.parts import ElementList, Part


class AddedMass(EngineForce):
    """Added mass: inertia of the air that moves with the panels of a cloth, along their normals only.

    The kinetic energy of the air is

        T = rho / 2 sum of A/k (n . (v - w))^2

    over the k corners of each panel. A is the panel's present area, n its unit normal, v the corner's velocity and w
    the wind. By Lagrange's equations each particle has the mass matrix ``m 1 + sum of rho A/k n n'``. They add forces
    of second degree in the velocities (docs/derivations/added_mass.md). The air has no weight. A panel without area
    carries none.

    The conserved energy has the kinetic part ``v'Mv / 2`` and the potential ``-w'Mw / 2``, with the mass matrix M of
    the air.

    The stiffness and damping blocks bound the effect of the wind on a cloth at rest. They ignore the cloth's own speed,
    as those of `AirPanels`.

    Args:
        panels: particles of each panel in order around it, shape (m, 3) or (m, 4).
        density: rho, mass of the air per area [kg/m^2], at least 0.
        wind: velocity of the air [m/s], shape (3,); it is constant.

    Raises:
        ValueError: if there are no panels, or for a density or a wind that is not finite.
    """

    name = "added_mass"
    damped = True
    damps_waves = False

    def __init__(self, panels: ArrayLike, *, density: float, wind: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        # As objects: the check below reports rows of different lengths.
        corners = 4 if np.shape(np.asarray(panels, dtype=object))[1:] == (4,) else 3
        self.panels = checked_indices("panels", panels, corners, np.iinfo(np.int64).max)
        if not len(self.panels):
            raise ValueError("there are no panels; a surface carries air along: give panels of three or four particles")
        self.density = float(checked_floats("density", density, (), lower=0.0))
        self.wind: Array = checked_floats("wind", wind, (3,), one_for_all=False)

    def in_wind(self, wind: ArrayLike) -> AddedMass:
        """Return a copy of this force with another wind [m/s], shape (3,)."""
        panels = copy.copy(self)
        panels.wind = checked_floats("wind", wind, (3,), one_for_all=False)
        return panels

    def parts(self, particle_count: int) -> Sequence[Part]:
        panels = checked_indices("panels", self.panels, self.panels.shape[1], particle_count)
        kind = "mass_triangle" if panels.shape[1] == 3 else "mass_quad"
        shared = np.array([self.density, 0.0, *self.wind])
        none = np.empty((len(panels), 0))
        return (ElementList(kind=kind, particles=panels, coefficients=none, shared_coefficients=shared),)
