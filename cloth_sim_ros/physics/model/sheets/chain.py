# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Chains of springs (S1, S2), joints (S4), and refinement of lattices (S3)."""

from __future__ import annotations

import math

import attrs
import numpy as np

from cloth_sim_ros.physics.model.forces.force import Array, Force
from cloth_sim_ros.physics.model.forces.gravity import Gravity
from cloth_sim_ros.physics.model.forces.pair_springs import PairSprings, damping_coefficient
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.state.state import State


@attrs.frozen(kw_only=True)
class SpringLaw:
    """Material of a uniform chain or lattice: stiffness, damping and rest length of a spring, mass of a particle.

    Damping is either the dimensionless k_d0, the lecture's material property, or the viscosity eta = k_d l0. With the
    viscosity the damping of slow modes converges under refinement.
    """

    #: Mass of one particle inside the lattice [kg].
    mass: float
    #: Rest length l0 [m].
    rest_length: float
    #: k_s: force per unit strain [N].
    stiffness: float
    #: Dimensionless damping.
    k_d0: float = 0.0
    #: k_d l0 [N s]; 0 takes the damping from k_d0.
    viscosity: float = 0.0

    def __attrs_post_init__(self) -> None:
        """Raise ValueError for numbers out of range, or if both k_d0 and viscosity are given."""
        for name in ("mass", "rest_length", "stiffness"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} is {value}; it must be finite and above 0")
        for name in ("k_d0", "viscosity"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise ValueError(f"{name} is {value}; it must be finite and at least 0")
        if self.k_d0 and self.viscosity:
            raise ValueError(f"both k_d0 {self.k_d0} and viscosity {self.viscosity} N s are given; give one of them")

    @property
    def damping(self) -> float:
        """Damping coefficient k_d = k_d0 sqrt(k_s m / l0), or viscosity / l0 [N s/m]."""
        if self.viscosity:
            return self.viscosity / self.rest_length
        return float(damping_coefficient(self.k_d0, self.stiffness / self.rest_length, self.mass))

    @property
    def frequency(self) -> float:
        """Angular frequency lambda = sqrt(k_s / (m l0)) [rad/s]; a chain's highest mode has twice that."""
        return math.sqrt(self.stiffness / (self.mass * self.rest_length))

    @property
    def sound_speed(self) -> float:
        """Speed of long longitudinal waves, l0 lambda = sqrt(k_s l0 / m) [m/s]."""
        return self.rest_length * self.frequency

    @property
    def stable_step(self) -> float:
        """Largest stable step of an undamped chain by a leapfrog, 1 / lambda [s]."""
        return 1.0 / self.frequency

    def refined(self, *, factor: int = 2, dimension: int = 1) -> SpringLaw:
        """Return the spring law of a lattice with `factor` times the resolution and the same total size and mass (S3).

        In one dimension m and l0 are divided by the factor; k_s stays. In a sheet (dimension 2) m is divided by the
        factor's square, and k_s by the factor: more threads share the same material. k_d0, or the viscosity as a
        fraction of the sheet's, is a property of the material.

        Raises:
            ValueError: for another dimension or a factor below 1.
        """
        if dimension not in (1, 2) or factor < 1:
            raise ValueError(f"dimension {dimension} must be 1 or 2, and factor {factor} at least 1")
        share = factor ** (dimension - 1)
        mass, l0 = self.mass / factor**dimension, self.rest_length / factor
        k_s, viscosity = self.stiffness / share, self.viscosity / share
        return attrs.evolve(self, mass=mass, rest_length=l0, stiffness=k_s, viscosity=viscosity)


@attrs.frozen(kw_only=True)
class Chain:
    """A line of particles joined by equal springs (S2); a simple spring (S1) if it has two particles.

    Free ends carry half a particle's mass. Therefore mass and length stay exact under refinement.
    """

    law: SpringLaw
    particle_count: int
    #: Anchored ends: none, first, last, both.
    anchored: str = "first"
    #: True if free ends carry half a mass, false for a whole one.
    half_ends: bool = True

    def __attrs_post_init__(self) -> None:
        """Raise ValueError for fewer than two particles, or for an unknown `anchored`."""
        if self.particle_count < 2:
            raise ValueError(f"particle_count is {self.particle_count}; a chain has at least 2")
        if self.anchored not in ("none", "first", "last", "both"):
            raise ValueError(f"anchored is '{self.anchored}'; it must be none, first, last or both")

    @property
    def length(self) -> float:
        """Rest length of the whole chain [m]."""
        return (self.particle_count - 1) * self.law.rest_length

    @property
    def anchors(self) -> list[int]:
        """Indices of the anchored particles."""
        last = self.particle_count - 1
        return {"none": [], "first": [0], "last": [last], "both": [0, last]}[self.anchored]

    def masses(self) -> Array:
        """Return particle masses [kg], halved at the ends if `half_ends`, shape (particle_count,)."""
        masses = np.full(self.particle_count, self.law.mass)
        if self.half_ends:
            masses[[0, -1]] *= 0.5
        return masses

    def positions(self) -> Array:
        """Return rest positions along x [m], shape (particle_count, 3)."""
        positions = np.zeros((self.particle_count, 3))
        positions[:, 0] = np.arange(self.particle_count) * self.law.rest_length
        return positions

    def model(self, *, gravity: tuple[float, float, float] = (0.0, 0.0, 0.0), further: tuple[Force, ...] = ()) -> Model:
        """Return the chain's model; `further` forces follow the springs and gravity [m/s^2]."""
        first = np.arange(self.particle_count - 1)
        pairs = np.stack([first, first + 1], axis=1)
        law = self.law
        forces: list[Force] = [PairSprings(pairs, law.rest_length, law.stiffness, law.damping)]
        if any(gravity):
            forces.append(Gravity(gravity))
        return Model(self.masses(), [*forces, *further], anchors=self.anchors)

    def state(self) -> State:
        """Return a new state of the chain: at rest along x."""
        return State(self.positions())

    def refined(self, factor: int = 2) -> Chain:
        """Return the chain with `factor` times as many springs, of the same length and mass."""
        particle_count = (self.particle_count - 1) * factor + 1
        return attrs.evolve(self, law=self.law.refined(factor=factor), particle_count=particle_count)


def joint(pair: tuple[int, int], *, stiffness: float, k_d0: float, mass: float, name: str = "joint") -> PairSprings:
    """Return a zero-length spring (S4) between two particles: F = -k s - k_d ds/dt with k_d = k_d0 sqrt(m k).

    Args:
        pair: the two particles.
        stiffness: k = k_s / l0 [N/m].
        k_d0: dimensionless damping; critical: 2 with one end fixed, sqrt(2) between two free particles of the given
            mass.
        mass: mass of one particle [kg].
        name: the force's name.
    """
    return PairSprings([pair], 0.0, stiffness, damping_coefficient(k_d0, stiffness, mass), name=name)
