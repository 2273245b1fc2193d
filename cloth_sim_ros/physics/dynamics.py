# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Equations of motion of a model: what integrators see."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from cloth_sim_ros.physics.model import Model
from cloth_sim_ros.physics.stability import Bounds
from cloth_sim_ros.physics.terms.base import Array

if TYPE_CHECKING:
    from cloth_sim_ros.physics.integrators.base import Observer


#: Cost of a leapfrog step by terms for one particle [ns]. Measured once, as those of the plans are: constants, so that
#: what is chosen by them is the same on any machine.
TERM_STEP = 90.0


class Economy(NamedTuple):
    """What a run of the fused leapfrog saves on."""

    #: Single precision inside.
    narrow: bool = False
    #: Weak springs at every second step only; the number of steps is odd.
    alternate: bool = False

    @property
    def words(self) -> str:
        """What it saves on, to be added to a sentence."""
        weak = "; weak springs at every second step" if self.alternate else ""
        return weak + ("; in single precision" if self.narrow else "")


#: A run that saves on nothing.
THOROUGH = Economy()


class LeapfrogPlan(Protocol):
    """A fused loop that takes over the leapfrog of one model, equal to the sum of its terms to rounding."""

    @property
    def step_cost(self) -> float:
        """Estimated cost of a step for one particle [ns]."""

    def leapfrog(
        self,
        t: float,
        x: Array,
        v: Array | None,
        step: float,
        steps: int,
        observer: Observer | None,
        weight: float,
        *,
        economy: Economy,
        start: tuple[Array, Array] | None,
    ) -> None:
        """Advance x, v (3, n) in place, or from `start`, see `integrators.march.leapfrog`, from time t by so many steps
        [s]; the observer's weights are multiplied by weight. What the plan can't save on makes no difference.
        """

    def narrows(self) -> bool:
        """Whether single precision would make a difference to the next run."""

    @property
    def alternate_share(self) -> float:
        """Share of the step limit up to which weak springs may be taken at every second step; 0 where they may not."""

    def alternate_stiffest(self) -> float:
        """Bound of the squared frequency [1/s^2] up to which that holds, held as the sheet is held now."""


class FusedForces(Protocol):
    """What takes over the forces and the bounds of some terms of a model, equal to their sum to rounding."""

    #: Names of the terms that it takes over.
    names: frozenset[str]

    def add_forces(self, x: Array, v: Array, f: Array) -> None:
        """Add the forces [N] of those terms to f (3, n)."""

    def add_bounds(self, x: Array, stiff: Array, damped: Array) -> None:
        """Add what `Term.add_stiffness` and `Term.add_damping` of those terms would to blocks (6, n) [N/m], [N s/m]."""


class Dynamics:
    """Acceleration, energy and stability bounds of a model, as the sum of its terms.

    Args:
        model: masses, anchors and terms.
        plan: a fused leapfrog of the same model; without one integrators evaluate the terms one by one.
    """

    def __init__(self, model: Model, plan: LeapfrogPlan | None = None) -> None:
        self.model = model
        self.plan = plan
        #: What takes over the forces of some terms, if anything does.
        self.forces: FusedForces | None = None
        self._bounds: Bounds | None = None

    @property
    def step_cost(self) -> float:
        """Estimated cost of a leapfrog step for one particle [ns]."""
        return TERM_STEP if self.plan is None else self.plan.step_cost

    def acceleration(self, t: float, x: Array, v: Array, out: Array) -> None:
        """Set ``out`` (3, n) to the acceleration [m/s^2]; zero for anchored particles."""
        out.fill(0.0)
        if self.forces is None:
            for term in self.model.terms:
                term.add_force(t, x, v, out)
        else:
            self.forces.add_forces(x, v, out)
            for term in self.model.terms:
                if term.name not in self.forces.names:
                    term.add_force(t, x, v, out)
        out *= self.model.inverse_masses

    def energy(self, t: float, x: Array, v: Array) -> float:
        """Return kinetic plus potential energy [J]."""
        kinetic = 0.5 * float(np.sum(self.model.masses * v * v))
        return kinetic + sum(term.energy(t, x) for term in self.model.terms)

    def dissipation(self, t: float, x: Array, v: Array) -> float:
        """Return the power lost to damping [W]."""
        return sum(term.dissipation(t, x, v) for term in self.model.terms)

    def supply(self, t: float, x: Array, v: Array) -> float:
        """Return the power that moving air puts into the motion [W]."""
        return sum(term.supply(t, x, v) for term in self.model.terms)

    def rates(self, x: Array) -> tuple[float, float]:
        """Return bounds of the squared highest angular frequency [1/s^2] and of the highest damping rate c/m [1/s] at
        x.
        """
        if self._bounds is None:
            self._bounds = Bounds(self.model, self.forces or getattr(self.plan, "bounds", None))
        return self._bounds.rates(x)
