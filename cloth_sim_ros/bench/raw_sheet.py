# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Raw-spring square sheets: equal particles, equal springs everywhere, so that other engines can be given the same."""

from __future__ import annotations

from collections.abc import Iterable

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.dynamics import Dynamics
from cloth_sim_ros.physics.grid_plan import GridPlan
from cloth_sim_ros.physics.kernels.grid_forces import GridForces
from cloth_sim_ros.physics.kernels.grid_springs import GridFamily, GridSprings
from cloth_sim_ros.physics.model import Model
from cloth_sim_ros.physics.forces.force import Array, Force
from cloth_sim_ros.physics.forces.drag import Drag
from cloth_sim_ros.physics.forces.gravity import Gravity
from cloth_sim_ros.physics.forces.pair_springs import PairSprings, lecture_damping

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
    rest: float = 1.0
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
        for name, reach, modulus in kinds:
            rest, k_s = self.rest * reach * h, self.stiffness * modulus * h
            damping = float(lecture_damping(self.k_d0, k_s / rest, self.mass))
            families.append(GridFamily(name, k_s, rest, damping, weak=name not in ("right", "down")))
        return families

    def springs(self) -> list[PairSprings]:
        """One term a direction."""
        index, terms = self.index, []
        for family in self.families():
            (r0, c0), (r1, c1) = _SHIFTS[family.name]
            rows, columns = self.resolution - max(r0, r1), self.resolution - max(c0, c1)
            near, far = index[r0 : r0 + rows, c0 : c0 + columns], index[r1 : r1 + rows, c1 : c1 + columns]
            pairs = np.stack([near.ravel(), far.ravel()], axis=1)
            k = family.stiffness / family.rest_length
            terms.append(PairSprings(pairs, family.rest_length, k, family.damping, name=family.name, weak=family.weak))
        return terms

    def model(self, anchors: Iterable[int], extra: Iterable[Term] = ()) -> Model:
        """The sheet with one compiled pass over all its springs."""
        masses = np.full(self.resolution**2, self.mass)
        terms: list[Term] = [FusedSprings(self), Gravity(masses, self.gravity)]
        if self.drag:
            terms.append(Drag(masses, self.drag))
        return Model(masses, [*terms, *extra], anchors=anchors)

    def dynamics(self, anchors: Iterable[int], extra: Iterable[Term] = ()) -> Dynamics:
        """The sheet as it is shipped: with the fused plan."""
        dynamics = Dynamics(self.model(anchors, extra))
        springs = GridSprings(self.resolution, self.resolution, self.families())
        GridPlan(dynamics, springs, frozenset({FusedSprings.name}))
        return dynamics

    def flat(self, *, hung: bool) -> Array:
        """Positions [m], shape (particle_count, 3): flat in x-y, or hung in x-z; row 0 at y = 0 or z = 0."""
        along = np.linspace(0.0, 1.0, self.resolution)
        grid = np.zeros((self.resolution, self.resolution, 3))
        grid[..., 0] = along
        grid[..., 2 if hung else 1] = -along[:, None]
        return grid.reshape(-1, 3)


class FusedSprings(Term):
    """All springs of a raw sheet in one vectorised pass; what is not the force comes from the pair terms."""

    name = "sheet"
    damped = True

    def __init__(self, sheet: RawSheet) -> None:
        #: The springs by direction; their bounds are taken in one pass.
        self.parts = sheet.springs()
        self._forces = GridForces(GridSprings(sheet.resolution, sheet.resolution, sheet.families()))

    def add_force(self, t: float, x: Array, v: Array, f: Array) -> None:
        self._forces.add(x, v, f)

    def energy(self, t: float, x: Array) -> float:
        return sum(term.energy(t, x) for term in self.parts)

    def dissipation(self, t: float, x: Array, v: Array) -> float:
        return sum(term.dissipation(t, x, v) for term in self.parts)

    def add_stiffness(self, x: Array, blocks: Array) -> None:
        for term in self.parts:
            term.add_stiffness(x, blocks)

    def add_damping(self, x: Array, blocks: Array) -> None:
        for term in self.parts:
            term.add_damping(x, blocks)

    def add_jacobian_product(self, t: float, x: Array, v: Array, dx: Array, dv: Array, out: Array) -> None:
        for term in self.parts:
            term.add_jacobian_product(t, x, v, dx, dv, out)

    def coupled_pairs(self) -> NDArray[np.int64]:
        return np.concatenate([term.pairs for term in self.parts])

    def pair_blocks(self, x: Array, stiffness_weight: float, damping_weight: float) -> Array:
        return np.concatenate([term.pair_blocks(x, stiffness_weight, damping_weight) for term in self.parts])
