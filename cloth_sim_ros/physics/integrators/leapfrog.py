# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Leapfrog with a midpoint velocity."""

from __future__ import annotations

import math

import numpy as np

from cloth_sim_ros.physics.dynamics import Dynamics
from cloth_sim_ros.physics.integrators.base import Advance, Integrator, Observer, UnstableError
from cloth_sim_ros.physics.kernels.leapfrog import all_finite, drift_and_predict, kick_and_drift
from cloth_sim_ros.physics.state import State

#: Fraction of the step limit that is used: room for stiffening by stretch within one advance.
_SAFETY = 0.9
#: How often an advance is repeated with a smaller step before it is given up.
_ATTEMPTS = 12


class Leapfrog(Integrator):
    """Drift, kick, drift; velocity-dependent forces are evaluated at a midpoint velocity, so that the order stays 2.

    With h the step: ``x_m = x + h/2 v``, ``a' = a(t + h/2, x_m, v + h/2 a)``, ``v' = v + h a'``, ``x' = x_m + h/2 v'``. The midpoint velocity is
    predicted with the acceleration of the step before; each advance starts that with one extra evaluation at its start, so that no history crosses
    its boundary.

    Order 2. One force evaluation a step. Time-reversible and symplectic without damping. An oscillator of angular frequency w and damping rate c
    is stable for h^2 w^2 / 4 + h c <= 1 (characteristic polynomial; without damping h w <= 2).

    Args:
        step: fixed largest step [s]; None takes 0.9 of the stability limit.

    Raises:
        ValueError: if the step is not positive.
    """

    name = "leapfrog"
    order = 2
    evaluations_per_step = 1

    def __init__(self, step: float | None = None) -> None:
        if step is not None and not (math.isfinite(step) and step > 0.0):
            raise ValueError(f"step is {step} s; it must be finite and above 0")
        self.step = step

    def step_limit(self, omega2: float, damping_rate: float) -> float:
        if omega2 == 0.0:
            return 1.0 / damping_rate if damping_rate else math.inf
        # The positive root of h^2 w^2 / 4 + h c = 1, written without cancellation.
        return 2.0 / (damping_rate + math.sqrt(damping_rate * damping_rate + omega2))

    def advance(
        self, dynamics: Dynamics, state: State, t: float, duration: float, observer: Observer | None = None
    ) -> Advance:
        limit = self._limit(dynamics, state)
        if self.step is None:
            step = _SAFETY * limit
        elif self.step <= limit:
            step = self.step
        else:
            raise ValueError(f"step {self.step} s is above the stability limit {limit:.6g} s; take a smaller step or 0")
        start = state.copy()
        evaluations = 0
        for attempt in range(_ATTEMPTS):
            steps = max(1, math.ceil(duration / step * (1.0 - 1e-12)))
            h = duration / steps
            if observer is not None:
                observer.restart()
            self._run(dynamics, state, t, h, steps, observer)
            evaluations += steps + 1
            finite = all_finite(state.x, state.v)
            if finite and (self.step is not None or h <= self._limit(dynamics, state)):
                break
            if self.step is not None:
                raise UnstableError(
                    f"the motion became non-finite at a step of {h} s; its limit was {limit:.6g} s at the start"
                )
            state.restore(start)
            step = 0.5 * h
        else:
            raise UnstableError(f"no step down to {h:.3g} s kept the motion within its stability limit")
        return Advance(steps=steps, evaluations=evaluations, step=h, limit=limit, rejected=attempt)

    def _limit(self, dynamics: Dynamics, state: State) -> float:
        return self.step_limit(*dynamics.rates(state.x))

    @staticmethod
    def _run(dynamics: Dynamics, state: State, t: float, h: float, steps: int, observer: Observer | None) -> None:
        x, v = state.x, state.v
        a = np.empty_like(x)
        predicted = np.empty_like(x)
        dynamics.acceleration(t, x, v, a)
        for k in range(steps):
            middle = t + (k + 0.5) * h
            drift_and_predict(x, v, a, 0.5 * h, predicted)
            dynamics.acceleration(middle, x, predicted, a)
            if observer is not None:
                observer.observe(middle, x, v + 0.5 * h * a, h)
            kick_and_drift(x, v, a, 0.5 * h)
