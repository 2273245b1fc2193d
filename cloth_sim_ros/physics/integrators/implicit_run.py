# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One advance of the implicit method, attempted until its stages converge and its error is small enough."""

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
#: The predicted next correction has to be this much smaller still: the prediction is one of order of magnitude.
_MARGIN = 0.1
#: Part of a step's budget at which its iteration ends.
_CONVERGED = 0.2
#: Part of a correction that the next one may be from `_SLOW_FROM` on.
_SLOW = 0.5
#: Iterations before corrections are shortened where a whole one overshoots, and the least part of one that is tried.
_PATIENCE, _LEAST_SHARE = 4, 1e-3
#: Attempts after which an advance is given up.
_ATTEMPTS = 12
#: Steps of an advance from which one that has no result is neither tried again nor halved: 8 us in a frame of 60 Hz,
#: in which an obstacle comes nearer by a millimetre at 120 m/s.
_MOST_STEPS = 2048
#: Without a tolerance: that distance [m].
CONVERGED_DISTANCE = 1e-9
#: Iterations of an advance, until one was run: two stages of five.
EXPECTED_ITERATIONS = 10
#: Most relative growth of a contact in a step: by more, corrections below the tolerance may leave the cloth
#: where contact holds any energy.
_GROWTH = 0.1
#: A stage that takes more iterations is given up, and the step made smaller.
MOST_ITERATIONS = 30
#: So is one whose corrections shrink slowly from this iteration on: compression's negative stiffness,
#: which the matrix leaves out, makes the iteration converge linearly at best.
_SLOW_FROM = 6
#: Iterations of a last resort: eight of them take all but a few thousandths of what can be lowered.
_LAST_ITERATIONS = 8
#: Energy that a step may make, relative to what it moves: the error of a good one is of either sign.
_GAIN = 1e-4
#: Rounding of a sum of energies, relative to it.
_ROUNDING = 1e-12


class Options(Protocol):
    """What is asked of the method, see `Implicit`."""

    name: str
    step: float | None
    tolerance: float | None
    work: float


class ImplicitAdvance:
    """Advances a state by one duration; made anew for each."""

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
        #: Force evaluations of a safe advance, and of what is kept for the last resorts of the steps that are left.
        self._allowed, self._kept = most, 0
        self._most = math.inf
        if integrator.work and integrator.step is None:
            self._most = integrator.work * duration * 1e9 / iteration_cost(plan.model)
        #: By how much obstacles are later than time says where velocities are sought [s].
        self._ahead = 0.0
        #: Whether nothing finer is tried any more.
        self._spent = False

    def run(self) -> Advance:
        """Do it."""
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
            # What has no solution within reach has none for smaller steps either, down to those of an explicit method.
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
        """Whether a step that has no result is taken in halves."""
        return self._safe and self._plan.contact is not None

    def _binds(self, steps: int, least: int) -> str:
        if self._integrator.step is not None:
            return "step"
        return "work" if self._spent else ("frame" if steps == least else "accuracy")

    def _steps_next(self, steps: int, least: int, error: float) -> int:
        """Steps for the next advance, after one with so many: half as many at least."""
        if self._integrator.tolerance is None:
            return max(least, steps // 2)
        if self._unsolved:
            return steps
        wanted = math.ceil(steps * math.sqrt(max(error, 1e-30) / (CONSTANTS.aim * self._budget)))
        # What no step can hold is not remembered: the motion may be calm again in the next frame.
        return max(1, steps // 2, min(wanted, steps) if self._spent else wanted)

    def _reason(self, h: float, steps: int) -> str:
        tolerance = self._integrator.tolerance
        if self._integrator.step is not None or tolerance is None:
            return f"implicit: order 2, step {h:.3g} s, no tolerance"
        if steps == 1:
            return f"implicit: order 2, one step a frame; it holds the tolerance {tolerance:g} m"
        return f"implicit: order 2, step {h:.3g} s set by the tolerance {tolerance:g} m"

    def _steps(self, steps: int) -> float | None:
        """Take equal steps; return the sum of their errors, or None if a stage did not converge."""
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
        """Take a step, with obstacles in two halves where it has no result; return its error [m] and its last
        acceleration, None where none of the smallest has one.
        """
        state, contact = self._state, self._plan.contact
        if contact is not None:
            contact.take(state)
        done, unsolved = self._step(t, h, guess), 0
        if self._safe and (done is None or self._makes_energy(t, h, done)):
            if self._strict and self._divides:
                # Such a step flags the frame, or has no result and is halved: explicit steps do instead.
                raise self._given_up(MissedError(f"implicit: a step of {h:.3g} s has no solution that can be found"))
            # Better unsolved than unstable.
            unsolved = 1
            done = self._safe_step(t, h, guess)
        if done is None or not (np.isfinite(done.x).all() and np.isfinite(done.v).all()):
            if not self._divides or h * _MOST_STEPS < 1.5 * self._duration:
                return None
            # Where an obstacle went further than the cloth had room, half the way may leave it some.
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
        """Take one step of the method; None if a stage does not converge."""
        x, v, d = self._state.x, self._state.v, GAMMA * h
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
        error = error_constant() * h * h / (1.0 - GAMMA) * _largest(k1v - k2v)
        end = base_x + d * k2x
        if self._crosses(t, h, end):
            return None
        stages = ((t + d, h - d, x + d * k1x, k1x), (t + h, d, end, k2x))
        return Step(end, base_v + d * k2v, k2v, error, stages)

    def _safe_step(self, t: float, h: float, guess: Array) -> Step | None:
        """Take a step by the implicit Euler method that lowers what it minimises, and makes no energy; None where an
        obstacle goes through the cloth, wherever that goes.
        """
        x, v = self._state.x, self._state.v
        # With grippers where they are halfway: pulled from where they end, it would gain more than they put in.
        u = self._descend(t + 0.5 * h, x, v, h, guess)
        end = x + h * u
        if self._crosses(t, h, end):
            return None
        error = 0.5 * h * _largest(u - (v + h * guess))
        # Simpson's rule along the straight way that it goes: a gripper may turn back within such a step.
        sixth = h / 6.0
        stages = ((t, sixth, x, u), (t + 0.5 * h, 4.0 * sixth, x + 0.5 * h * u, u), (t + h, sixth, end, u))
        moved = Step(end, u, (u - v) / h, error, stages, whole=self._plan.contact is not None)
        gain, kinetic = self._gain(t, h, moved)
        if gain > 0.0:
            # What was minimised leaves no more potential energy than there was energy: slower is enough.
            slower = math.sqrt(max(0.0, 1.0 - gain / kinetic)) if kinetic > 0.0 else 0.0
            moved = attrs.evolve(moved, v=slower * u, a=(slower * u - v) / h)
        return moved

    def _crosses(self, t: float, h: float, end: Array) -> bool:
        """Whether a step would take anything through anything, or so near to it that no further step is sure not to."""
        contact = self._plan.contact
        if contact is None:
            return False
        return contact.crosses(t, h, self._state.x, end) or contact.crosses(t + h, 0.0, end, end)

    def _makes_energy(self, t: float, h: float, done: Step) -> bool:
        gain, kinetic = self._gain(t, h, done)
        return not gain <= _GAIN * (kinetic + abs(work(self._plan, t, h, done)))

    def _gain(self, t: float, h: float, done: Step) -> tuple[float, float]:
        """Energy after a step less what there was and what grippers and air put in, and the kinetic energy then [J]."""
        before = self._plan.energy(t, self._state.x, self._state.v)
        after = self._plan.energy(t + h, done.x, done.v)
        kinetic = self._plan.energies(t + h, done.x, done.v)[0]
        return after - before - work(self._plan, t, h, done) - _ROUNDING * abs(before), kinetic

    def _stage(self, t: float, x: Array, v: Array, d: float, guess: Array) -> tuple[Array, Array] | None:
        """Solve a = a(t, x + d u, u), u = v + d a; return u and a, or None if it does not converge."""
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
            # Newton's iteration converges quadratically: the next correction would be about curvature * size^2.
            if size <= self._close or self._curvature * size * size <= _MARGIN * self._close:
                return u, (u - v) / d
            last = size
        return None

    def _descend(self, t: float, x: Array, v: Array, d: float, guess: Array) -> Array:
        """Return velocities u of a stage that lower what it minimises, with obstacles where they end: the cloth has to
        be clear of them there.
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
        """Return the same, from the best of some starts: rest, and those that go along with an obstacle that moves,
        which stays as far away as it is.
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
        """Newton's correction of a stage's velocities."""
        masses = self._plan.model.masses
        place, a = x + d * u, np.empty_like(x)
        self._plan.accelerations(t, place, u, a)
        self._evaluations += 1
        thickness = None
        if self._plan.contact is not None:
            thickness = self._plan.contact.thickness
            if not np.isfinite(a).all():
                # Beyond an obstacle's surface there is no way back.
                return np.full_like(a, np.nan)
        correction = masses * (v + d * a - u) * (self._plan.model.inverse_masses > 0.0)
        self._matrix.update(t, place, d, self._state.memory.get(PINCHED), thickness)
        self._matrix.solve(correction)
        return correction

    def _share(self, t: float, x: Array, v: Array, d: float, u: Array, correction: Array) -> float:
        """Return how much of a correction to take: the largest power of 1/2 that lowers what the stage minimises.

        That is ``1/2 |u - v|^2_M + E(x + d u) + d/2 u'D u`` while the damping matrix D is nearly constant.
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
        # Moving air pushes with a force that is nearly constant, and has no energy of its own.
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
