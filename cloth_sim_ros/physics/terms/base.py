# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a force is: the members that every term of a model has."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Empty members below are meant (noqa: B027): a term without stiffness or damping adds none.


class Term(ABC):
    """One force of a model.

    Positions ``x`` [m], velocities ``v`` [m/s] and forces ``f`` [N] are component-major, shape (3, particle_count),
    float64 and
    C-contiguous. Times ``t`` [s] are simulated time. Blocks have shape (6, particle_count): the entries xx, yy, zz, xy,
    xz, yz of one
    symmetric 3x3 matrix a particle.
    """

    #: Short name, unique within a model.
    name: str = "term"
    #: True where the term may be evaluated less often than every step (multirate).
    weak: bool = False
    #: True where the force depends on velocities.
    damped: bool = False
    #: True where there are places next to which the force grows beyond all bounds.
    boundless: bool = False

    @abstractmethod
    def add_force(self, t: float, x: Array, v: Array, f: Array) -> None:
        """Add the term's force [N] to ``f``."""

    def steady(self) -> bool:
        """Whether the force at given positions and velocities stays what it is until the next event."""
        return True

    def energy(self, t: float, x: Array) -> float:
        """Return the potential energy [J] whose negative gradient is the elastic part of the force."""
        return 0.0

    def dissipation(self, t: float, x: Array, v: Array) -> float:
        """Return the power that damping takes out of the motion [W]."""
        return 0.0

    def supply(self, t: float, x: Array, v: Array) -> float:
        """Return the power [W] that moving air puts into the motion; grips book their work as they go."""
        return 0.0

    def add_stiffness(self, x: Array, blocks: Array) -> None:  # noqa: B027
        """Add particle blocks B [N/m] that bound the stiffness K at x: u'Ku <= sum over particles of u_i' B_i u_i."""

    def add_damping(self, x: Array, blocks: Array) -> None:  # noqa: B027
        """Add particle blocks [N s/m] that bound the damping matrix as `add_stiffness` bounds the stiffness."""

    def multiples(self) -> tuple[NDArray[np.int64] | None, Array | float, Array | float] | None:
        """Return particles (None for all), k [N/m] and c [N s/m] of a term whose blocks are k I and c I, wherever the
        particles are; None for any other term.
        """
        if type(self).add_stiffness is Term.add_stiffness and type(self).add_damping is Term.add_damping:
            return np.empty(0, dtype=np.int64), 0.0, 0.0
        return None

    def add_jacobian_product(self, t: float, x: Array, v: Array, dx: Array, dv: Array, out: Array) -> None:  # noqa: B027
        """Add the derivative of the force along (dx, dv), ``(df/dx) dx + (df/dv) dv`` [N], to ``out``."""

    def coupled_pairs(self) -> NDArray[np.int64] | None:
        """Return the particle pairs (m, 2) that `pair_blocks` speaks of; None where the term does not offer it.

        An implicit method then takes the particle blocks of `add_stiffness` and `add_damping` in its place: exact for a
        term that acts on single particles, a bound that slows its iteration for others.
        """
        return None

    def pair_blocks(self, x: Array, stiffness_weight: float, damping_weight: float) -> Array:
        """Return blocks B (m, 6: xx, yy, zz, xy, xz, yz) of the weighted sum of stiffness and damping matrices at x.

        B is positive semidefinite and enters that matrix at both ends of a pair, and as -B at their coupling.
        """
        raise NotImplementedError(f"term '{self.name}' has no coupled pairs")
