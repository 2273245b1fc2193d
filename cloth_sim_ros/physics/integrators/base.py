# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What an integrator is."""

from __future__ import annotations

from abc import ABC, abstractmethod

import attrs

from cloth_sim_ros.physics.dynamics import Dynamics
from cloth_sim_ros.physics.state import State
from cloth_sim_ros.physics.terms.base import Array


class Observer(ABC):
    """Integrates quantities along the motion, without changing a bit of it.

    Integrators call it at quadrature points: the sum of weight * g(t, x, v) is the time integral of g over the advance, at the
    integrator's order.
    """

    @abstractmethod
    def restart(self) -> None:
        """Forget what was observed since the advance began: it is attempted anew."""

    @abstractmethod
    def observe(self, t: float, x: Array, v: Array, weight: float) -> None:
        """Take note of one quadrature point; the arrays may only be read, and only during the call."""


class UnstableError(RuntimeError):
    """The motion became non-finite, or no step was small enough for it."""


@attrs.frozen(kw_only=True)
class Advance:
    """What an integrator did over one stretch of time."""

    steps: int
    #: Force evaluations, those of rejected steps included.
    evaluations: int
    #: Smallest step taken [s].
    step: float
    #: Largest step that is stable by the bounds at the start [s].
    limit: float
    #: Attempts thrown away because the motion stiffened while they ran.
    rejected: int = 0


class Integrator(ABC):
    """Advances a state over a stretch of time, in as many steps as it needs, ending exactly on its end."""

    name: str
    order: int
    evaluations_per_step: int

    @abstractmethod
    def step_limit(self, omega2: float, damping_rate: float) -> float:
        """Return the largest stable step [s] for a squared frequency [1/s^2] and a damping rate c/m [1/s]."""

    @abstractmethod
    def advance(
        self, dynamics: Dynamics, state: State, t: float, duration: float, observer: Observer | None = None
    ) -> Advance:
        """Advance ``state`` in place from time t [s] by duration [s].

        Raises:
            UnstableError: if the motion does not stay finite.
        """
