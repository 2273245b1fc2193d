# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Raw-spring square sheets: equal particles, equal springs everywhere, so that other engines can be given the same."""

from __future__ import annotations

from collections.abc import Iterable

import attrs
import numpy as np

from cloth_sim_ros.physics.model.forces.drag import Drag
from cloth_sim_ros.physics.model.forces.force import Array, Force
from cloth_sim_ros.physics.model.forces.gravity import Gravity
from cloth_sim_ros.physics.model.forces.grid_springs import GridSprings
from cloth_sim_ros.physics.model.forces.pair_springs import PairSprings, damping_coefficient
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.model.parts import GridFamily
from cloth_sim_ros.physics.plan.plan import Plan, compile

#: Name of the force that the springs are.
SHEET = "sheet"
GRAVITY = (0.0, 0.0, -9.81)
_SHIFTS = {
    "right": ((0, 0), (0, 1)),
    "down": ((0, 0), (1, 0)),
    "diagonal": ((0, 0), (1, 1)),
    "antidiagonal": ((0, 1), (1, 0)),
    "right2": ((0, 0), (0, 2)),
    "down2": ((0, 0), (2, 0)),
}


@attrs.frozen(kw_only=True)
class RawSheet:
    """1 m x 1 m, 0.2 kg, N x N equal particles; k_s = E h for moduli E of 1000, 200, 10 N/m times `stiffness`."""

    resolution: int
    stiffness: float = 1.0
    k_d0: float = 0.2
    drag: float = 0.0
    gravity: tuple[float, float, float] = GRAVITY
    #: Rest length relative to the spacing: below 1 the flat sheet is under tension.
    relative_rest_length: float = 1.0
    moduli: tuple[float, float, float] = (1000.0, 200.0, 10.0)

    @property
    def spacing(self) -> float:
        """Distance of neighbours [m]."""
        return 1.0 / (self.resolution - 1)

    @property
    def mass(self) -> float:
        """Mass of one particle [kg]."""
        return 0.2 / self.resolution**2

    @property
    def index(self) -> np.ndarray:
        """Particle numbers by row and column."""
        return np.arange(self.resolution**2).reshape(self.resolution, self.resolution)

    def families(self) -> list[GridFamily]:
        """Springs by direction."""
        h, (stretch, shear, bend) = self.spacing, self.moduli
        kinds = [("right", 1.0, stretch), ("down", 1.0, stretch)]
        kinds += [("diagonal", 2.0**0.5, shear), ("antidiagonal", 2.0**0.5, shear)]
        kinds += [("right2", 2.0, bend), ("down2", 2.0, bend)]
        families = []
        for name, distance, modulus in kinds:
            rest_length, k_s = self.relative_rest_length * distance * h, self.stiffness * modulus * h
            damping = float(damping_coefficient(self.k_d0, k_s / rest_length, self.mass))
            families.append(GridFamily(name=name, stiffness=k_s, rest_length=rest_length, damping=damping))
        return families

    def sheet(self) -> GridSprings:
        """All springs, as one force of the sheet."""
        return GridSprings(self.resolution, self.resolution, self.families(), name=SHEET)

    def springs(self) -> list[PairSprings]:
        """Return the springs as lists, one force per direction."""
        index, forces = self.index, []
        for family in self.families():
            (r0, c0), (r1, c1) = _SHIFTS[family.name]
            rows, columns = self.resolution - max(r0, r1), self.resolution - max(c0, c1)
            first_particles, second_particles = (
                index[r0 : r0 + rows, c0 : c0 + columns],
                index[r1 : r1 + rows, c1 : c1 + columns],
            )
            pairs = np.stack([first_particles.ravel(), second_particles.ravel()], axis=1)
            coefficients = family.rest_length, family.stiffness, family.damping
            forces.append(PairSprings(pairs, *coefficients, name=family.name))
        return forces

    def model(self, anchors: Iterable[int], extra: Iterable[Force] = (), *, listed: bool = False) -> Model:
        """The sheet, its springs in one sweep over its rows or, for comparison, listed."""
        springs: list[Force] = [*self.springs()] if listed else [self.sheet()]
        air: list[Force] = [Drag(self.drag)] if self.drag else []
        masses = np.full(self.resolution**2, self.mass)
        return Model(masses, [*springs, Gravity(self.gravity), *air, *extra], anchors=anchors)

    def plan(self, anchors: Iterable[int], extra: Iterable[Force] = (), *, listed: bool = False) -> Plan:
        """Compile its equations of motion."""
        return compile(self.model(anchors, extra, listed=listed))

    def flat(self, *, hung: bool) -> Array:
        """Positions [m], shape (particle_count, 3): flat in x-y, or hung in x-z; row 0 at y = 0 or z = 0."""
        along = np.linspace(0.0, 1.0, self.resolution)
        grid = np.zeros((self.resolution, self.resolution, 3))
        grid[..., 0] = along
        grid[..., 2 if hung else 1] = -along[:, None]
        return grid.reshape(-1, 3)
