# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A sheet as a triangle mesh of particles and springs."""

from __future__ import annotations

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.forces.pair_springs import PairSprings, damping_coefficient
from cloth_sim_ros.physics.model.sheets.surface import Surface

#: Poisson's ratio and shear modulus over Young's modulus of a network of edge springs on triangles: both follow from
#: the network.
POISSON_RATIO = 1.0 / 3.0
SHEAR_OVER_STRETCH = 3.0 / 8.0


@attrs.frozen(eq=False, kw_only=True)
class MeshSheet:
    """Rest shape and topology of a sheet that is a triangle mesh."""

    #: Rest positions [m], shape (particle_count, 3), every particle in at least one triangle.
    rest_positions: Array
    surface: Surface
    #: Sentences on merged vertices, and on repairs and doubts, from reading a file.
    notes: tuple[str, ...] = ()
    repairs: tuple[str, ...] = ()

    def positions(self) -> Array:
        """Return a copy of the rest positions [m], shape (particle_count, 3)."""
        return self.rest_positions.copy()

    def triangles(self) -> NDArray[np.int64]:
        """Return the particle indices of the surface's triangles, shape (m, 3), uncopied."""
        return self.surface.triangles

    def areas(self) -> Array:
        """Return the area of each triangle at rest [m^2], shape (m,)."""
        a, b, c = (self.rest_positions[self.surface.triangles[:, i]] for i in range(3))
        normal = np.cross(b - a, c - a)
        return np.asarray(0.5 * np.sqrt(normal[:, 0] ** 2 + normal[:, 1] ** 2 + normal[:, 2] ** 2), dtype=np.float64)

    def masses(self, density: float) -> Array:
        """Return particle masses [kg] for a mass per area [kg/m^2]: a third of each triangle to each corner."""
        thirds = np.repeat(self.areas() / 3.0, 3)
        shares = np.bincount(self.surface.triangles.ravel(), thirds, minlength=len(self.rest_positions))
        return np.asarray(density * shares, dtype=np.float64)

    def springs(
        self, *, stretch_modulus: float, k_d0: float, density: float, viscosity: float = 0.0, name: str = "structural"
    ) -> PairSprings:
        """Return edge springs of a sheet of Young's modulus `stretch_modulus` [N/m], exact on regular triangles.

        An edge of length L between triangles of areas A1, A2 has k = Y (A1 + A2) / L^2 (van Gelder, J. Graphics Tools
        3(2), 1998). A border edge has one triangle. On equilateral triangles the formula is exact: k = Y sqrt(3)/2,
        isotropic with Poisson's ratio 1/3 and shear modulus 3/8 Y. Elsewhere it is an approximation; docs/springs.md
        gives its deviation. Damping is k_d0 sqrt(k m) with the mean mass of the edge's ends, or, with a viscosity, k
        viscosity / Y.

        Args:
            stretch_modulus: Young's modulus Y [N/m].
            k_d0: dimensionless damping.
            density: mass per area [kg/m^2].
            viscosity: viscosity of the sheet [N s/m]; 0 uses k_d0.
            name: the force's name in a model.
        """
        a, b = self.surface.edges.T
        x, y, z = (self.rest_positions[b] - self.rest_positions[a]).T
        square = x * x + y * y + z * z
        areas = np.append(self.areas(), 0.0)  # edge_triangles has -1 for no triangle
        first, second = areas[self.surface.edge_triangles].T
        stiffness = stretch_modulus * (first + second) / square
        masses = self.masses(density)
        if viscosity:
            damping = stiffness * (viscosity / stretch_modulus)
        else:
            damping = damping_coefficient(k_d0, stiffness, 0.5 * (masses[a] + masses[b]))
        length = np.sqrt(square)
        return PairSprings(self.surface.edges, length, stiffness * length, damping, name=name)
