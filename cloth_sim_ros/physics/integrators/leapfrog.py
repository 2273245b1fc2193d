# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Leapfrog with a midpoint velocity."""

from __future__ import annotations

from cloth_sim_ros.physics.dynamics import Dynamics
from cloth_sim_ros.physics.integrators.base import Advance, Integrator, Observer, check_step
from cloth_sim_ros.physics.integrators.extrapolated import Extrapolated
from cloth_sim_ros.physics.integrators.fixed import advance_fixed
from cloth_sim_ros.physics.integrators.march import leapfrog, leapfrog_limit
from cloth_sim_ros.physics.state import State


class Leapfrog(Integrator):
    """Drift, kick, drift; velocity-dependent forces are evaluated at a midpoint velocity, so that the order stays 2.

    The midpoint velocity is predicted with the acceleration of the step before (`march.leapfrog`); each advance
    starts that with one extra evaluation, so that no history crosses its boundary.

    Order 2. One force evaluation a step. Time-reversible and symplectic without damping. An oscillator of angular
    frequency w and damping rate c is stable for h^2 w^2 / 4 + h c <= 1 (characteristic polynomial; without damping
    h w <= 2).

    Args:
        step: fixed largest step [s]; None takes 0.9 of the stability limit.
        tolerance: target of the largest particle position error at frames [m]: the step follows the error, which
            a second run with smaller steps judges every few frames (`Extrapolated` with one column).

    Raises:
        ValueError: if one of them is not positive, or both are set.
    """

    name = "leapfrog"
    order = 2
    evaluations_per_step = 1
    suits = "loose tolerances, long undamped runs; explicit, damping well below critical"

    def __init__(self, step: float | None = None, *, tolerance: float | None = None) -> None:
        self.step = check_step(step)
        self._controlled = None
        if tolerance is not None:
            self._controlled = Extrapolated(tolerance=tolerance, step=step, columns=1)
            self._controlled.name = self.name

    def step_limit(self, omega2: float, damping_rate: float) -> float:
        return leapfrog_limit(omega2, damping_rate)

    def advance(
        self, dynamics: Dynamics, state: State, t: float, duration: float, observer: Observer | None = None
    ) -> Advance:
        if self._controlled is not None:
            return self._controlled.advance(dynamics, state, t, duration, observer)

        def run(h: float, steps: int) -> int:
            return leapfrog(dynamics, t, state.x, state.v, h, steps, observer)

        return advance_fixed(self, run, dynamics, state, duration, self.step, observer)
