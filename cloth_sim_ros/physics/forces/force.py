# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a force is: what the engine is told of it, or, for a force of one's own, its formulas in numpy."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, NoReturn

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.parts import Part

Array = NDArray[np.float64]

# Empty members below are meant (noqa: B027): a force without stiffness or damping adds none.


class Force:
    """One force of a model.

    The engine's forces say in `parts` what they consist of. A force of one's own leaves that out and overrides
    `add_force`, and `energy`, `add_stiffness` and so on where it has them: it costs its own time and no more. Its
    stiffness and damping bound the step; a force that grows with positions or velocities and does not tell them may
    become unstable.

    Positions ``x`` [m], velocities ``v`` [m/s] and forces ``f`` [N] are component-major, shape (3, particle_count),
    float64 and C-contiguous. Times ``t`` [s] are simulated time. Blocks have shape (6, particle_count): the entries xx,
    yy, zz, xy, xz, yz of one symmetric 3x3 matrix a particle.
    """

    #: Short name, unique within a model.
    name: str = "force"
    #: True where the force depends on velocities.
    damped: bool = False
    #: Whether its damping, where it has any, takes out waves of the whole cloth.
    damps_waves: ClassVar[bool] = True

    def parts(self, particle_count: int) -> Sequence[Part] | None:
        """Return what the engine is to do; None for a force in numpy.

        Raises:
            ValueError: if the force does not fit so many particles.
        """
        return None

    def steady(self) -> bool:
        """Whether the force at given positions and velocities stays what it is until the next event."""
        return True

    def add_force(self, t: float, x: Array, v: Array, f: Array) -> None:
        """Add the force [N] to ``f``."""
        raise NotImplementedError(f"force '{self.name}' has neither parts nor add_force")

    def energy(self, t: float, x: Array) -> float:
        """Return the potential energy [J] whose negative gradient is the elastic part of the force."""
        return 0.0

    def dissipation(self, t: float, x: Array, v: Array) -> float:
        """Return the power that damping takes out of the motion [W]."""
        return 0.0

    def supply(self, t: float, x: Array, v: Array) -> float:
        """Return the power [W] that the force puts into the motion beside what its energy loses."""
        return 0.0

    def add_stiffness(self, x: Array, blocks: Array) -> None:
        """Add particle blocks B [N/m] that bound the stiffness K at x: u'Ku <= sum over particles of u_i' B_i u_i."""

    def add_damping(self, x: Array, blocks: Array) -> None:
        """Add particle blocks [N s/m] that bound the damping matrix as `add_stiffness` bounds the stiffness."""

    def add_jacobian_product(self, t: float, x: Array, v: Array, dx: Array, dv: Array, out: Array) -> None:
        """Add the derivative of the force along (dx, dv), ``(df/dx) dx + (df/dv) dv`` [N], to ``out``."""


class EngineForce(Force):
    """A force of the engine's: it says what it consists of, and a plan says what that gives."""

    @abstractmethod
    def parts(self, particle_count: int) -> Sequence[Part]:
        """Return what the engine is to do.

        Raises:
            ValueError: if the force does not fit so many particles.
        """

    def _ask(self, *_: object) -> NoReturn:
        raise TypeError(f"force '{self.name}' alone gives no numbers; ask compile(Model(masses, [force])), its plan")

    _asked: Any = _ask
    add_force = energy = dissipation = supply = add_stiffness = add_damping = add_jacobian_product = _asked
