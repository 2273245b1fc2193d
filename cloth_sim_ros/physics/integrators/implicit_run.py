# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One advance of the implicit method: Newton's iteration, step size control, descent steps."""

from __future__ import annotations

import math
from typing import Protocol

import attrs
import numpy as np

from cloth_sim_ros.physics.book import Book
from cloth_sim_ros.physics.constants import CONSTANTS
from cloth_sim_ros.physics.contact_thickness import relative_growth
from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.gripper_path import carried
from cloth_sim_ros.physics.integrators.base import Advance, MissedError, UnstableError
from cloth_sim_ros.physics.integrators.fixed import steps_for
from cloth_sim_ros.physics.integrators.implicit_book import Step, note, work
from cloth_sim_ros.physics.integrators.stage_matrix import iteration_cost, stage_matrix
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.remembered import PINCHED, THICKNESS
from cloth_sim_ros.physics.remembered import Implicit as Memory
from cloth_sim_ros.physics.state import State

#: The diagonal coefficient of Alexander's two-stage method: 1 - 1/sqrt(2).
GAMMA = 1.0 - math.sqrt(0.5)
#: Safety margin of the predicted next correction, because the prediction has the right order of magnitude only.
_MARGIN = 0.1
#: Fraction of a step's error budget at which its iteration ends.
_CONVERGED = 0.2
#: Largest ratio of successive corrections from iteration `_SLOW_FROM` on.
_SLOW = 0.5
#: Iterations with full corrections before the line search begins, and the smallest fraction that it tries.
_PATIENCE, _LEAST_SHARE = 4, 1e-3
#: Maximum number of attempts of an advance.
_ATTEMPTS = 12
#: Maximum number of steps of an advance. Steps that fail at this number are neither repeated nor halved: they are 8 us
#: long in a frame of 60 Hz, in which an obstacle at 120 m/s moves by a millimetre.
_MOST_STEPS = 2048
#: Size of the last correction without a tolerance [m].
CONVERGED_DISTANCE = 1e-9
#: Expected iterations of the first advance: two stages of five.
EXPECTED_ITERATIONS = 10
#: Largest relative growth of a contact thickness in a step. Beyond it corrections below the tolerance may correspond
#: to an arbitrary contact energy.
_GROWTH = 0.1
#: Maximum number of iterations of a stage; beyond it the step becomes smaller.
MOST_ITERATIONS = 30
#: From this iteration on, slow convergence ends a stage too. The matrix omits the negative stiffness of compressed
#: springs, so the iteration may converge linearly or not at all.
_SLOW_FROM = 6
#: Iterations of a descent step: eight of them leave a few thousandths of the possible decrease.
_LAST_ITERATIONS = 8
#: Energy that a step may create, relative to the energy that it moves: the error of a good step has either sign.
_GAIN = 1e-4
#: Rounding of a sum of energies, relative to it.
_ROUNDING = 1e-12


class Options(Protocol):
    """Settings of the implicit method, see `Implicit`."""

    name: str
    step: float | None
    tolerance: float | None
    work: float


class ImplicitAdvance:
    """One advance of a state by a duration."""

    def __init__(
        self,
        integrator: Options,
        plan: Plan,
        state: State,
        t: float,
        duration: float,
        book: Book | None,
        *,
        strict: bool = False,
        most: float = math.inf,
    ) -> None:
        self._integrator, self._plan, self._state, self._book = integrator, plan, state, book
        self._t, self._duration = t, duration
        tolerance = integrator.tolerance
        self._budget = math.inf if tolerance is None else CONSTANTS.share * duration * tolerance
        self._memory = Memory.of(state)
        self._matrix = stage_matrix(plan.model)
        self._evaluations, self._strict = 0, strict
        #: Limit of force evaluations of an advance by safe steps, and the reserve for descents in its remaining steps.
        self._allowed, self._kept = most, 0
        self._most = math.inf
        if integrator.work and integrator.step is None:
            self._most = integrator.work * duration * 1e9 / iteration_cost(plan.model)
        #: Time offset of obstacles while a descent computes velocities [s].
        self._ahead = 0.0
        #: True once the work limit allows no finer steps.
        self._spent = False

    def run(self) -> Advance:
        """Advance the state and return the result.

        Raises:
            UnstableError: if the motion does not stay finite.
            ToleranceMissedError: if strict, with contact, and no solution of a step is found.
        """
        state, memory, integrator = self._state, self._memory, self._integrator
        least = 1 if integrator.step is None else steps_for(self._duration, integrator.step)
        contact = self._plan.contact
        if contact is not None and (after := contact.force.recovery[2]) is not None:
            least = max(least, math.ceil(relative_growth(state.memory[THICKNESS], after) / _GROWTH))
        known = memory.step > 0.0 and self._allowed == math.inf
        steps = max(least, steps_for(self._duration, memory.step)) if known else least
        start, rejected = state.share(), 0
        while True:
            if self._book is not None:
                self._book.restart()
            # If no solution is found at this step size, smaller steps find none either, down to explicit step sizes.
            self._safe = steps >= CONSTANTS.last_steps
            before = self._evaluations
            error = self._steps(steps)
            if error is not None and (error <= self._budget or self._spent or self._unsolved):
                break
            grow = 2.0 if error is None else math.sqrt(error / (CONSTANTS.aim * self._budget))
            finer = max(steps + 1, math.ceil(steps * min(grow, 2.0 * CONSTANTS.finer)))
            self._spent = self._evaluations + (self._evaluations - before) / steps * finer > self._most
            if self._spent and error is not None:
                break
            state.restore(start)
            rejected += 1
            if rejected > _ATTEMPTS or (error is None and (self._divides or steps >= _MOST_STEPS)):
                why = "; do obstacles leave the cloth room?" if self._plan.contact is not None else ""
                h = self._duration / (_MOST_STEPS if self._divides else steps)
                raise self._given_up(UnstableError(f"implicit: steps of {h:.3g} s did not stay finite{why}"))
            steps = max(steps, round(CONSTANTS.last_steps)) if self._spent else finer
        flagged = int(error > self._budget) + self._unsolved
        memory.step = self._duration / self._steps_next(steps, least, error)
        memory.store(state)
        return Advance(
            steps=self._taken,
            evaluations=self._evaluations,
            step=self._finest,
            limit=math.inf,
            rejected=rejected,
            integrator=integrator.name,
            binds=self._binds(steps, least),
            error=error,
            flagged=flagged,
            reason=self._reason(self._finest, steps),
        )

    def _given_up(self, error: UnstableError) -> UnstableError:
        error.evaluations = self._evaluations
        return error

    @property
    def _divides(self) -> bool:
        """True if a step without a result is repeated as two halves."""
        return self._safe and self._plan.contact is not None

    def _binds(self, steps: int, least: int) -> str:
        if self._integrator.step is not None:
            return "step"
        return "work" if self._spent else ("frame" if steps == least else "accuracy")

    def _steps_next(self, steps: int, least: int, error: float) -> int:
        """Return the number of steps of the next advance: at least half of the present one."""
        if self._integrator.tolerance is None:
            return max(least, steps // 2)
        if self._unsolved:
            return steps
        wanted = math.ceil(steps * math.sqrt(max(error, 1e-30) / (CONSTANTS.aim * self._budget)))
        # A violent frame does not increase the number of steps of the next one, which may be quiet.
        return max(1, steps // 2, min(wanted, steps) if self._spent else wanted)

    def _reason(self, h: float, steps: int) -> str:
        tolerance = self._integrator.tolerance
        if self._integrator.step is not None or tolerance is None:
            return f"implicit: order 2, step {h:.3g} s, no tolerance"
        if steps == 1:
            return f"implicit: order 2, one step a frame; it holds the tolerance {tolerance:g} m"
        return f"implicit: order 2, step {h:.3g} s set by the tolerance {tolerance:g} m"

    def _steps(self, steps: int) -> float | None:
        """Take equal steps; return the sum of their errors [m], or None if a step has no result."""
        h = self._duration / steps
        self._close = _CONVERGED * self._budget / steps if math.isfinite(self._budget) else CONVERGED_DISTANCE
        self._curvature, self._unsolved, self._taken, self._finest = math.inf, 0, 0, h
        state, total, contact = self._state, 0.0, self._plan.contact
        guess = np.empty_like(state.x)
        if contact is not None:
            contact.take(state)
        self._plan.accelerations(self._t, state.x, state.v, guess)
        for k in range(steps):
            self._kept = _LAST_ITERATIONS * (steps - k)
            done = self._cover(self._t + k * h, h, guess)
            if done is None:
                return None
            error, guess = done
            total += error
        return total

    def _cover(self, t: float, h: float, guess: Array) -> tuple[float, Array] | None:
        """Take a step; with contact, repeat it as two halves if it has no result.

        Returns:
            Its error [m] and its last acceleration [m/s^2]; None if even the smallest step has no result.
        """
        state, contact = self._state, self._plan.contact
        if contact is not None:
            contact.take(state)
        done, unsolved = self._step(t, h, guess), 0
        if self._safe and (done is None or self._makes_energy(t, h, done)):
            if self._strict and self._divides:
                # Such a step would flag the frame, or be halved. Explicit steps replace it.
                raise self._given_up(MissedError(f"implicit: a step of {h:.3g} s has no solution that can be found"))
            # A descent step is inaccurate, but stable.
            unsolved = 1
            done = self._safe_step(t, h, guess)
        if done is None or not (np.isfinite(done.x).all() and np.isfinite(done.v).all()):
            if not self._divides or h * _MOST_STEPS < 1.5 * self._duration:
                return None
            # If an obstacle moved too far for the cloth to evade, half its displacement may be small enough.
            half = 0.5 * h
            first = self._cover(t, half, guess)
            second = None if first is None else self._cover(t + half, half, first[1])
            return None if first is None or second is None else (first[0] + second[0], second[1])
        if self._book is not None:
            note(self._book, self._plan, t, h, done)
        state.x, state.v = done.x, done.v
        if contact is not None:
            contact.follow(t + h, h, state)
        self._unsolved += unsolved
        self._taken, self._finest = self._taken + 1, min(self._finest, h)
        return done.error, done.a

    def _step(self, t: float, h: float, guess: Array) -> Step | None:
        """Return one step of the Runge-Kutta method; None if a stage does not converge."""
        x, v, d = self._state.x, self._state.v, GAMMA * h
        first = self._stage(t + d, x, v, d, guess)
        if first is None:
            return None
        k1x, k1v = first
        # The second stage starts from the end of the first one's slopes.
        base_x, base_v = x + (h - d) * k1x, v + (h - d) * k1v
        second = self._stage(t + h, base_x, base_v, d, k1v)
        if second is None:
            return None
        k2x, k2v = second
        error = error_constant() * h * h / (1.0 - GAMMA) * _largest(k1v - k2v)
        end = base_x + d * k2x
        if self._crosses(t, h, end):
            return None
        stages = ((t + d, h - d, x + d * k1x, k1x), (t + h, d, end, k2x))
        return Step(end, base_v + d * k2v, k2v, error, stages)

    def _safe_step(self, t: float, h: float, guess: Array) -> Step | None:
        """Return an implicit Euler step that decreases its objective and creates no energy.

        Returns:
            The step; None if an obstacle intersects the cloth for every result.
        """
        x, v = self._state.x, self._state.v
        # Grippers are at their middle position: with the end position the cloth would gain more than their work.
        u = self._descend(t + 0.5 * h, x, v, h, guess)
        end = x + h * u
        if self._crosses(t, h, end):
            return None
        error = 0.5 * h * _largest(u - (v + h * guess))
        # Simpson's rule along the straight path of the step: a gripper may reverse within it.
        sixth = h / 6.0
        stages = ((t, sixth, x, u), (t + 0.5 * h, 4.0 * sixth, x + 0.5 * h * u, u), (t + h, sixth, end, u))
        moved = Step(end, u, (u - v) / h, error, stages, whole=self._plan.contact is not None)
        gain, kinetic = self._gain(t, h, moved)
        if gain > 0.0:
            # The minimisation bounds the potential energy by the total energy before: a lower speed suffices.
            slower = math.sqrt(max(0.0, 1.0 - gain / kinetic)) if kinetic > 0.0 else 0.0
            moved = attrs.evolve(moved, v=slower * u, a=(slower * u - v) / h)
        return moved

    def _crosses(self, t: float, h: float, end: Array) -> bool:
        """True if a step causes an intersection, or ends too close for a later step to exclude one."""
        contact = self._plan.contact
        if contact is None:
            return False
        return contact.crosses(t, h, self._state.x, end) or contact.crosses(t + h, 0.0, end, end)

    def _makes_energy(self, t: float, h: float, done: Step) -> bool:
        gain, kinetic = self._gain(t, h, done)
        return not gain <= _GAIN * (kinetic + abs(work(self._plan, t, h, done)))

    def _gain(self, t: float, h: float, done: Step) -> tuple[float, float]:
        """Return the energy that a step created, external work subtracted, and the kinetic energy at its end [J]."""
        before = self._plan.energy(t, self._state.x, self._state.v)
        after = self._plan.energy(t + h, done.x, done.v)
        kinetic = self._plan.energies(t + h, done.x, done.v)[0]
        return after - before - work(self._plan, t, h, done) - _ROUNDING * abs(before), kinetic

    def _stage(self, t: float, x: Array, v: Array, d: float, guess: Array) -> tuple[Array, Array] | None:
        """Solve a = a(t, x + d u, u), u = v + d a; return u [m/s] and a [m/s^2], or None without convergence."""
        moving = self._plan.model.inverse_masses > 0.0
        u = v + d * guess * moving
        last = math.inf
        for iteration in range(MOST_ITERATIONS):
            if self._safe and self._evaluations + 1 + self._kept > self._allowed:
                return None
            correction = self._correction(t, x, v, d, u)
            if iteration >= _PATIENCE:
                correction *= self._share(t, x, v, d, u, correction)
            u += correction
            size = d * _largest(correction)
            if not math.isfinite(size) or (iteration >= _SLOW_FROM and size > _SLOW * last):
                return None
            if last < math.inf:
                self._curvature = max(
                    0.5 * self._curvature if self._curvature < math.inf else 0.0, size / (last * last)
                )
            # Newton's iteration converges quadratically: the next correction is about curvature * size^2.
            if size <= self._close or self._curvature * size * size <= _MARGIN * self._close:
                return u, (u - v) / d
            last = size
        return None

    def _descend(self, t: float, x: Array, v: Array, d: float, guess: Array) -> Array:
        """Return velocities u [m/s] of a stage that decrease its objective, with obstacles at their end positions.

        The cloth must be clear of obstacles there.
        """
        contact = self._plan.contact
        if contact is None:
            return self._descended(t, x, v, d, guess)
        self._ahead = 0.5 * d
        contact.place_ahead(self._ahead)
        try:
            return self._descended(t, x, v, d, guess)
        finally:
            self._ahead = 0.0
            contact.place_ahead(0.0)

    def _descended(self, t: float, x: Array, v: Array, d: float, guess: Array) -> Array:
        """Return velocities that decrease the objective, from the best of several starts.

        Starts are the extrapolated motion, the present velocities, rest, and motions with each moving obstacle, which
        keep their distance from it.
        """
        moving = self._plan.model.inverse_masses > 0.0
        starts = [v + d * guess * moving, v.copy(), np.zeros_like(v)]
        if self._plan.contact is not None:
            paths = self._plan.contact.force.paths
            going = [row for row in paths if row[4:13].any() or row[17:26].any()]
            starts += [carried(row, t - 0.5 * d, d, x) * moving for row in going]
        merits = [self._merit(t, x, v, d, start) for start in starts]
        best = min(range(len(starts)), key=lambda i: merits[i] if math.isfinite(merits[i]) else math.inf)
        u = starts[best]
        for _ in range(_LAST_ITERATIONS):
            correction = self._correction(t, x, v, d, u)
            share = self._share(t, x, v, d, u, correction)
            if share <= _LEAST_SHARE:
                break
            u += share * correction
        return u

    def _correction(self, t: float, x: Array, v: Array, d: float, u: Array) -> Array:
        """Return Newton's correction of a stage's velocities [m/s], shape (3, n)."""
        masses = self._plan.model.masses
        place, a = x + d * u, np.empty_like(x)
        self._plan.accelerations(t, place, u, a)
        self._evaluations += 1
        thickness = None
        if self._plan.contact is not None:
            thickness = self._plan.contact.thickness
            if not np.isfinite(a).all():
                # Inside an obstacle there is no correction.
                return np.full_like(a, np.nan)
        correction = masses * (v + d * a - u) * (self._plan.model.inverse_masses > 0.0)
        self._matrix.update(t, place, d, self._state.memory.get(PINCHED), thickness)
        self._matrix.solve(correction)
        return correction

    def _share(self, t: float, x: Array, v: Array, d: float, u: Array, correction: Array) -> float:
        """Return the fraction of a correction to take: the largest power of 1/2 that decreases the stage's objective.

        The objective is ``1/2 |u - v|^2_M + E(x + d u) + d/2 u'D u`` while the damping matrix D is nearly constant.
        """
        share, before = 1.0, self._merit(t, x, v, d, u)
        before += _ROUNDING * abs(before)
        while share > _LEAST_SHARE and not self._merit(t, x, v, d, u + share * correction) <= before:
            share *= 0.5
        return share

    def _merit(self, t: float, x: Array, v: Array, d: float, u: Array) -> float:
        place = x + d * u
        if self._safe and self._crosses(t - 0.5 * d - self._ahead, d, place):
            return math.inf
        # The force of moving air is nearly constant and has no potential.
        slip = 0.5 * self._plan.dissipation(t, place, u) - self._plan.supply(t, place, u)
        return self._plan.energy(t, place, u - v) + d * slip


def _largest(vectors: Array) -> float:
    """Return the largest length of vectors (3, n); infinite if any is not finite."""
    x, y, z = vectors
    square = float((x * x + y * y + z * z).max())
    return math.sqrt(square) if math.isfinite(square) else math.inf


def error_constant() -> float:
    """Return the coefficient of h^3 in the difference of the method's stability function from the exponential."""
    # R(z) = (1 + (1 - 2 g) z) / (1 - g z)^2 = 1 + z + z^2 / 2 + (4 g^3 + 3 g^2 (1 - 2 g)) z^3 + ...
    third = GAMMA * GAMMA * (4.0 * GAMMA + 3.0 * (1.0 - 2.0 * GAMMA))
    return abs(third - 1.0 / 6.0)
