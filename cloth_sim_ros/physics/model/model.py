# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The constant part of a cloth: masses, anchored particles and forces."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from cloth_sim_ros.engine.band import fixed_sum
from cloth_sim_ros.physics.model.forces.force import Array, Force


class Model:
    """Masses, anchors and forces of a cloth's particles: all that stays constant during its motion.

    Args:
        masses: particle masses [kg], shape (particle_count,), positive.
        forces: the forces, with different names.
        anchors: indices of particles that keep their position.

    Raises:
        ValueError: for a mass that is not positive and finite, an anchor out of range, or two forces of one name.
    """

    def __init__(self, masses: ArrayLike, forces: Sequence[Force], *, anchors: Iterable[int] = ()) -> None:
        try:
            self.masses: Array = np.array(masses, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise ValueError(f"masses are {masses!r}; they must be numbers") from error
        if self.masses.ndim != 1 or self.masses.size == 0:
            raise ValueError(f"masses have shape {self.masses.shape}; give one mass a particle, at least one")
        #: Number of particles, anchored ones included.
        self.particle_count = int(self.masses.size)
        wrong = np.flatnonzero(~(np.isfinite(self.masses) & (self.masses > 0.0)))
        if wrong.size:
            raise ValueError(
                f"mass of particle {wrong[0]} is {self.masses[wrong[0]]} kg; it must be finite and above 0"
            )
        self.forces = tuple(forces)
        for force in self.forces:
            if not isinstance(force, Force):
                raise ValueError(f"{force!r} is among the forces; each must be a Force")
        names = [force.name for force in self.forces]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"two forces are named '{name}'; give each its own name")
        fixed = np.array(list(anchors))
        if fixed.size and fixed.dtype.kind not in "iu":
            raise ValueError(f"anchors {fixed.tolist()} are no whole numbers; give indices of particles")
        self.anchors = np.unique(fixed.astype(np.int64))
        if self.anchors.size and not (self.anchors[0] >= 0 and self.anchors[-1] < self.particle_count):
            raise ValueError(f"anchors {self.anchors.tolist()} must lie between 0 and {self.particle_count - 1}")
        #: 1/m [1/kg], zero for anchored particles, shape (particle_count,).
        self.inverse_masses: Array = 1.0 / self.masses
        self.inverse_masses[self.anchors] = 0.0

    @cached_property
    def mass(self) -> float:
        """Mass of all particles [kg]."""
        return fixed_sum(self.masses)

    def force(self, name: str) -> Force:
        """Return the model's force of this name; raise KeyError if it has none.

        Raises:
            KeyError: if the model has no such force.
        """
        for force in self.forces:
            if force.name == name:
                return force
        raise KeyError(f"no force '{name}'; the model has {[force.name for force in self.forces]}")
