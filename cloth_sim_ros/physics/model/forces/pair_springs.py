# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Springs between pairs of particles: S1, S2, S4 to S7."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cloth_sim_ros.engine.binding import checked_floats, checked_indices
from cloth_sim_ros.physics.model.forces.force import Array, EngineForce
from cloth_sim_ros.physics.model.parts import ElementList, Part


class PairSprings(EngineForce):
    """Damped springs between pairs of particles, force k_s times strain (S1); joints (S4) if the rest length is 0.

    Let s be the position of the far end relative to the near end. A spring's force on the far end is ``F = -k_s (|s|/l0
    - 1) s/|s| - k_d (ds/dt . s/|s|) s/|s|``, a joint's is ``F = -k s - k_d ds/dt``.

    Args:
        pairs: particle indices of the near and far ends, shape (m, 2).
        rest_length: rest lengths l0 [m], shape (m,) or one number; zero makes a joint.
        stiffness: k_s, force per unit strain [N], shape (m,) or one number; of a joint k [N/m].
        damping: k_d [N s/m], shape (m,) or one number.
        name: the force's name in a model.

    Raises:
        ValueError: for a shape that does not fit, a spring from a particle to itself, or an entry that is negative or
            not finite.
    """

    def __init__(
        self,
        pairs: ArrayLike,
        rest_length: ArrayLike,
        stiffness: ArrayLike,
        damping: ArrayLike = 0.0,
        *,
        name: str = "springs",
    ) -> None:
        self.pairs: NDArray[np.int64] = checked_indices(f"pairs of '{name}'", pairs, 2, np.iinfo(np.int64).max)
        count = len(self.pairs)
        self.rest_length = checked_floats(f"rest_length of '{name}'", rest_length, (count,), lower=0.0)
        self.stiffness = checked_floats(f"stiffness of '{name}'", stiffness, (count,), lower=0.0)
        self.damping = checked_floats(f"damping of '{name}'", damping, (count,), lower=0.0)
        loops = np.flatnonzero(self.pairs[:, 0] == self.pairs[:, 1])
        if loops.size:
            particle = self.pairs[loops[0], 0]
            raise ValueError(f"spring {loops[0]} of '{name}' joins particle {particle} to itself; give two particles")
        self.name = name
        self.damped = bool(np.any(self.damping))

    @property
    def rigidity(self) -> Array:
        """Spring constant, force per extension [N/m], shape (m,): k_s / l0 of a spring, k of a joint."""
        return self.stiffness / np.where(self.rest_length > 0.0, self.rest_length, 1.0)

    def parts(self, particle_count: int) -> Sequence[Part]:
        pairs = checked_indices(f"pairs of '{self.name}'", self.pairs, 2, particle_count)
        is_joint = self.rest_length == 0.0
        elements: list[Part] = []
        if not is_joint.all():
            coefficients = np.stack([self.stiffness, self.rigidity, self.damping], axis=1)[~is_joint]
            elements.append(ElementList(kind="spring", particles=pairs[~is_joint], coefficients=coefficients))
        if is_joint.any():
            coefficients = np.stack([self.stiffness, self.damping], axis=1)[is_joint]
            elements.append(ElementList(kind="joint", particles=pairs[is_joint], coefficients=coefficients))
        return elements


def damping_coefficient(k_d0: ArrayLike, rigidity: ArrayLike, mass: ArrayLike) -> Array:
    """Return the damping coefficient k_d = k_d0 sqrt(m k) [N s/m] of a spring of dimensionless damping k_d0.

    Args:
        k_d0: dimensionless damping.
        rigidity: k = k_s / l0 [N/m].
        mass: m [kg].
    """
    return np.asarray(k_d0) * np.sqrt(np.asarray(mass, dtype=float) * np.asarray(rigidity, dtype=float))
