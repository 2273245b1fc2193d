# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One advance of the implicit method, attempted until its stages converge and its error is small enough."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from cloth_sim_ros.physics.dynamics import Dynamics
from cloth_sim_ros.physics.integrators.base import Advance, Observer, UnstableError
from cloth_sim_ros.physics.integrators.control import Memory
from cloth_sim_ros.physics.integrators.fixed import steps_for
from cloth_sim_ros.physics.integrators.stage_matrix import stage_matrix
from cloth_sim_ros.physics.kernels.leapfrog import all_finite, largest_distance
from cloth_sim_ros.physics.state import State
from cloth_sim_ros.physics.terms.base import Array

if TYPE_CHECKING:
    from cloth_sim_ros.physics.integrators.implicit import Implicit

#: Share of the tolerance that the estimates may add up to in one second, and the part of it that steps aim at.
SHARE_PER_SECOND, AIM = 0.7, 0.7
#: Newton's iteration ends when a correction moves no particle by more than this share of a step's budget.
CONVERGED = 0.2
#: The predicted next correction has to be this much smaller still: the prediction is one of order of magnitude.
_MARGIN = 0.1
#: Iterations before corrections are shortened where a whole one overshoots, and the least part of one that is tried.
_PATIENCE, _LEAST_SHARE = 4, 1e-3
#: Attempts after which an advance is given up.
_ATTEMPTS = 12
#: Without a tolerance: that distance [m].
CONVERGED_DISTANCE = 1e-9
#: A stage that takes more iterations is given up, and the step made smaller.
MOST_ITERATIONS = 30
#: Steps of a frame beyond which errors, and stages that do not converge, are accepted, flagged and counted.
MOST_STEPS = 32


class ImplicitAdvance:
    """Advances a state by one duration; made anew for each."""

    def __init__(
        self,
        integrator: Implicit,
        dynamics: Dynamics,
        state: State,
        t: float,
        duration: float,
        observer: Observer | None,
    ) -> None:
        self._integrator, self._dynamics, self._state, self._observer = integrator, dynamics, state, observer
        self._t, self._duration = t, duration
        tolerance = integrator.tolerance
        self._budget = math.inf if tolerance is None else SHARE_PER_SECOND * duration * tolerance
        self._memory = Memory.of(state)
        self._matrix = stage_matrix(dynamics)
        self._evaluations = 0

    def run(self) -> Advance:
        """Do it."""
        state, memory, integrator = self._state, self._memory, self._integrator
        if integrator.step is not None:
            steps = steps_for(self._duration, integrator.step)
        elif integrator.tolerance is not None and memory.stretch > 0.0:
            steps = steps_for(self._duration, memory.stretch)
        else:
            steps = 1
        least = steps if integrator.step is not None else 1
        start, rejected = state.copy(), 0
        while True:
            if self._observer is not None:
                self._observer.restart()
            self._last_resort = steps >= MOST_STEPS
            error = self._steps(steps)
            if error is not None and (error <= self._budget or steps >= MOST_STEPS):
                break
            state.restore(start)
            rejected += 1
            if rejected > _ATTEMPTS:
                raise UnstableError(f"implicit: steps of {self._duration / steps:.3g} s did not stay finite")
            grow = 2.0 if error is None else math.sqrt(error / (AIM * self._budget))
            finer = max(steps + 1, math.ceil(steps * min(grow, 8.0)))
            steps = min(finer, MOST_STEPS) if error is not None or steps < MOST_STEPS else 2 * steps
        flagged = int(error > self._budget) + self._unsolved
        h = self._duration / steps
        if integrator.tolerance is not None:
            wanted = steps * math.sqrt(max(error, 1e-30) / (AIM * self._budget))
            fewer = max(1, min(steps, math.ceil(max(wanted, 0.5 * steps))))
            memory.stretch = self._duration / (fewer if wanted < steps else math.ceil(wanted))
            memory.store(state)
        return Advance(
            steps=steps,
            evaluations=self._evaluations,
            step=h,
            limit=math.inf,
            rejected=rejected,
            integrator=integrator.name,
            binds="step" if integrator.step is not None else ("frame" if steps == least else "accuracy"),
            error=error,
            flagged=flagged,
            reason=self._reason(h, steps),
        )

    def _reason(self, h: float, steps: int) -> str:
        tolerance = self._integrator.tolerance
        if self._integrator.step is not None or tolerance is None:
            return f"implicit: order 2, step {h:.3g} s, no tolerance"
        if steps == 1:
            return f"implicit: order 2, one step a frame; it holds the tolerance {tolerance:g} m"
        return f"implicit: order 2, step {h:.3g} s set by the tolerance {tolerance:g} m"

    def _steps(self, steps: int) -> float | None:
        """Take equal steps; return the sum of their errors, or None if a stage did not converge."""
        from cloth_sim_ros.physics.integrators.implicit import GAMMA, error_constant

        state, h = self._state, self._duration / steps
        d = GAMMA * h
        self._close = CONVERGED * self._budget / steps if math.isfinite(self._budget) else CONVERGED_DISTANCE
        self._curvature, self._unsolved = math.inf, 0
        total = 0.0
        x, v = state.x, state.v
        a = np.empty_like(x)
        self._dynamics.acceleration(self._t, x, v, a)
        guess = a.copy()
        for k in range(steps):
            t = self._t + k * h
            first = self._stage(t + d, x, v, d, guess)
            if first is None:
                return None
            k1x, k1v = first
            # The second stage starts from where the first one's slopes lead.
            base_x, base_v = x + (h - d) * k1x, v + (h - d) * k1v
            second = self._stage(t + h, base_x, base_v, d, k1v)
            if second is None:
                return None
            k2x, k2v = second
            if self._observer is not None:
                self._observer.observe(t + d, x + d * k1x, k1x, h - d)
                self._observer.observe(t + h, base_x + d * k2x, k2x, d)
            x += (h - d) * k1x + d * k2x
            v += (h - d) * k1v + d * k2v
            guess = k2v
            total += error_constant() * h * h / (1.0 - GAMMA) * float(largest_distance(k1v, k2v))
        return total if all_finite(x, v) else None

    def _stage(self, t: float, x: Array, v: Array, d: float, guess: Array) -> tuple[Array, Array] | None:
        """Solve a = a(t, x + d u, u), u = v + d a; return u and a, or None if it does not converge."""
        masses = self._dynamics.model.masses
        moving = self._dynamics.model.inverse_masses > 0.0
        u = v + d * guess * moving
        a = np.empty_like(x)
        last = math.inf
        for iteration in range(MOST_ITERATIONS):
            place = x + d * u
            self._dynamics.acceleration(t, place, u, a)
            self._evaluations += 1
            correction = masses * (v + d * a - u) * moving
            self._matrix.update(place, d)
            self._matrix.solve(correction)
            if iteration >= _PATIENCE:
                correction *= self._share(t, x, v, d, u, correction)
            u += correction
            size = d * float(np.sqrt((correction * correction).sum(axis=0).max()))
            if not math.isfinite(size):
                return None
            if last < math.inf:
                self._curvature = max(0.5 * self._curvature if self._curvature < math.inf else 0.0, size / last**2)
            # Newton's iteration converges quadratically: the next correction would be about curvature * size^2.
            if size <= self._close or self._curvature * size * size <= _MARGIN * self._close:
                return u, (u - v) / d
            last = size
        if not self._last_resort:
            return None
        # Better unsolved than unstable: no more energy than there is, if need be by stopping.
        self._unsolved += 1
        if not self._merit(t, x, v, d, u) <= self._merit(t, x, v, d, np.zeros_like(u)):
            u = np.zeros_like(u)
        return u, (u - v) / d

    def _share(self, t: float, x: Array, v: Array, d: float, u: Array, correction: Array) -> float:
        """Return how much of a correction to take: the largest power of 1/2 that lowers what the stage minimises.

        That is ``1/2 |u - v|^2_M + E(x + d u) + d/2 u'D u`` while the damping matrix D is nearly constant.
        """
        share, before = 1.0, self._merit(t, x, v, d, u)
        while share > _LEAST_SHARE and not self._merit(t, x, v, d, u + share * correction) <= before:
            share *= 0.5
        return share

    def _merit(self, t: float, x: Array, v: Array, d: float, u: Array) -> float:
        place = x + d * u
        slip = self._dynamics.dissipation(t, place, u)
        return self._dynamics.energy(t, place, u - v) + 0.5 * d * slip
