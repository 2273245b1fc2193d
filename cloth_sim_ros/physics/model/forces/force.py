# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Base classes of forces, in the engine or in Python."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, NoReturn

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.model.parts import Part
from cloth_sim_ros.physics.old_names import adopt_old_methods, with_old_names

Array = NDArray[np.float64]

# Empty methods below are intended (noqa: B027): a force without stiffness or damping adds none.


@with_old_names(supply="external_power")
class Force:
    """Base class of a model's forces. Those in Python have force, energy and bounds; the engine's only `parts`.

    A force of the engine describes its parts in `parts`. A Python force does not override `parts`. It overrides
    `add_force` and, if it has them, `energy`, `add_stiffness` and the other methods. A Python force costs only its own
    time. Its stiffness and damping bound the step. A force that varies with positions or velocities without reporting
    its stiffness and damping may make steps unstable.

    Positions ``x`` [m], velocities ``v`` [m/s] and forces ``f`` [N] are component-major, shape (3, particle_count),
    float64 and C-contiguous. Times ``t`` [s] are simulated time. Blocks have shape (6, particle_count): the entries xx,
    yy, zz, xy, xz, yz of one symmetric 3x3 matrix per particle.
    """

    #: Short name, unique within a model.
    name: str = "force"
    #: True if the force depends on velocities.
    damped: bool = False
    #: True if its damping, if any, damps waves of the whole cloth.
    damps_waves: ClassVar[bool] = True

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        adopt_old_methods(cls, supply="external_power")

    def parts(self, particle_count: int) -> Sequence[Part] | None:
        """Return the force's parts for the engine (springs, hinges, uniform, contact); None for a Python force.

        Raises:
            ValueError: if the force does not fit the number of particles.
        """
        return None

    def steady(self) -> bool:
        """Return true if the force does not depend explicitly on time until the next event."""
        return True

    def add_force(self, t: float, x: Array, v: Array, f: Array) -> None:
        """Add the force on each particle [N] at time t [s] to ``f`` (3, n); a Python force has to override it."""
        raise NotImplementedError(f"force '{self.name}' has neither parts nor add_force")

    def energy(self, t: float, x: Array) -> float:
        """Return the potential energy [J] whose negative gradient is the elastic part of the force; 0 by default."""
        return 0.0

    def dissipation(self, t: float, x: Array, v: Array) -> float:
        """Return the power that damping dissipates [W]; 0 by default."""
        return 0.0

    def external_power(self, t: float, x: Array, v: Array) -> float:
        """Return the power [W] that the force adds from outside, as wind does; 0 by default."""
        return 0.0

    def add_stiffness(self, x: Array, blocks: Array) -> None:
        """Add particle blocks B [N/m] that bound the stiffness K at x: u'Ku <= sum over particles of u_i' B_i u_i."""

    def add_damping(self, x: Array, blocks: Array) -> None:
        """Add particle blocks B [N s/m] that bound the damping matrix D at x: u'Du <= sum of u_i' B_i u_i."""

    def add_jacobian_product(self, t: float, x: Array, v: Array, dx: Array, dv: Array, out: Array) -> None:
        """Add the derivative of the force along (dx, dv), ``(df/dx) dx + (df/dv) dv`` [N], to ``out``."""


class EngineForce(Force):
    """Base class of a force that the engine computes, described by its parts; only a plan can evaluate it."""

    @abstractmethod
    def parts(self, particle_count: int) -> Sequence[Part]:
        """Return the force's parts for the engine: element lists, spring grids, uniform forces, contact.

        Raises:
            ValueError: if the force does not fit the number of particles.
        """

    def _refuse(self, *_: object) -> NoReturn:
        raise TypeError(f"force '{self.name}' alone can't be evaluated; use the plan compile(Model(masses, [force]))")

    _refused: Any = _refuse
    add_force = energy = dissipation = external_power = add_stiffness = add_damping = add_jacobian_product = _refused
