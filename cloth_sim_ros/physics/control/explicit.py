# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One advance by explicit steps: attempted until the rules of stability, error and energy all hold, or the cap of a
frame's work is reached.
"""

from __future__ import annotations

import math

from cloth_sim_ros.physics.book import Book
from cloth_sim_ros.physics.constants import CONSTANTS
from cloth_sim_ros.physics.control.choice import Choice, Options, binds, reason
from cloth_sim_ros.physics.control.energy import EnergyRule
from cloth_sim_ros.physics.control.error import ErrorRule, Sums
from cloth_sim_ros.physics.control.fallback import finish, part_cost, within_reach, work_cap
from cloth_sim_ros.physics.control.precision import PrecisionRule
from cloth_sim_ros.physics.control.stability import StabilityRule
from cloth_sim_ros.physics.integrators.base import Advance, UnstableError, refuse_unstable
from cloth_sim_ros.physics.integrators.columns import RATIOS, Columns, amplification, step_counts
from cloth_sim_ros.physics.integrators.fixed import steps_for
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.remembered import Energy, Error, Fallback, Precision, Stability
from cloth_sim_ros.physics.state import State


class ExplicitAdvance:
    """Advances a state by one duration; made anew for each.

    Args:
        options: what is asked for.
        plan: equations of motion.
        state: advanced in place.
        t: time at the start [s].
        duration: time to advance [s].
        book: notes the motion.
    """

    def __init__(
        self, options: Options, plan: Plan, state: State, t: float, duration: float, book: Book | None
    ) -> None:
        self._options, self._plan, self._state, self._book = options, plan, state, book
        self._t, self._duration = t, duration
        self._known = Stability.key in state.memory
        self._memory = Stability.of(state)
        self._stability = StabilityRule(plan, self._memory, state, duration)
        self._limit = options.step_limit(self._memory.omega2, self._memory.damping)
        error, precision = Error.of(state), Precision.of(state)
        if abs(error.part - duration) > 1e-6 * duration:
            # What was known is of frames of another length.
            error, precision = Error(columns=error.columns, refine=error.refine, part=duration), Precision()
        columns = options.columns
        if options.tolerance is not None:
            columns = min(int(error.columns), columns)
        elif error.wait <= 0.0:
            # What the energy asked for is tried with larger steps from time to time.
            error.refine = max(1.0, 0.5 * error.refine)
        judge = options.tolerance is not None and error.wait <= 0.0
        self._choice = Choice(columns, error.refine, judge)
        budget = math.inf if options.tolerance is None else CONSTANTS.share * duration * options.tolerance
        self._error = ErrorRule(error, self._stability, budget, options.columns, state)
        self._precision = PrecisionRule(plan, precision, duration, budget)
        self._energy = EnergyRule(plan, Energy.of(state))
        self._evaluations = self._steps = self._first = self._flagged = 0
        self._finest = math.inf
        #: What the calls of all parts cost, in force evaluations.
        self._calls = 0.0
        self._kept: Columns | None = None
        self._sums = Sums()
        self._narrow = False
        #: Whether nothing finer is tried any more, and whether explicit steps are given up.
        self._spent = self._lost = False

    def run(self) -> Advance:
        """Do it."""
        options, state = self._options, self._state
        if options.step is not None and options.step > self._limit and not self._known:
            refuse_unstable(options.step, self._limit, options.name)
        memory, limit = self._memory, self._limit
        # A fixed step that goes on was stable once.
        once = options.step if options.step is not None and self._known else 0.0
        memory.longest = max(memory.longest, min(max(limit, once), self._duration))
        fallen = Fallback.of(state).fallen
        self._cap = work_cap(self._plan, options.work, self._duration, memory.longest, fallen)
        self._part_cost = part_cost(self._plan)
        self._lost = self._gives_up(limit)
        if options.tolerance is not None and not self._affords(self._choice.columns, self._choice.refine):
            # What the last frame would have needed is beyond the cap: no more is tried than leaves room for a retry.
            most = self._cap / self._work(self._choice.columns, 1.0) / CONSTANTS.finer
            self._choice = Choice(self._choice.columns, max(1.0, min(self._choice.refine, most)), True)
        if self._choice.judge and not self._lost:
            self._evaluations += self._precision.measure(self._t, state, CONSTANTS.safety * limit, self._choice)
        start, begun, rejected = state.share(), (memory.omega2, memory.damping), 0
        while True:
            if self._book is not None:
                self._book.restart()
            if self._lost:
                return self._finish(rejected, limit)
            try:
                error = self._attempt(start)
            except UnstableError:
                state.x, state.v = start.x, start.v
                raise
            if error is not None:
                break
            state.x, state.v = start.x, start.v
            memory.omega2, memory.damping = begun
            rejected += 1
        for rule in (memory, self._error.memory, self._precision.memory, self._energy.memory):
            rule.store(state)
        if fallen:
            Fallback().store(state)
        h = self._finest
        return Advance(
            steps=self._steps,
            evaluations=self._evaluations,
            step=h,
            limit=limit,
            rejected=rejected,
            integrator=options.name,
            binds="work" if self._spent else binds(options, self._choice, self._first, h),
            error=error if options.tolerance is not None else None,
            flagged=self._flagged,
            reason=self._reason(),
        )

    def _reason(self) -> str:
        """The choice in words."""
        words = reason(self._options, self._choice, self._first, self._finest)
        if self._narrow:
            words += "; in single precision"
        if self._flagged and self._spent:
            words += f"; the tolerance was missed within the frame's work limit of {self._options.work:g}"
        elif self._flagged:
            words += "; the tolerance is finer than rounding of the coordinates allows"
        return words

    def _finish(self, rejected: int, limit: float) -> Advance:
        """Let implicit steps finish the frame."""
        # That something was known stays, see `restart`.
        self._memory.store(self._state)
        done = finish(self._plan, self._state, self._t, self._duration, self._book, instead_of=self._options.name)
        return done._replace(
            evaluations=self._evaluations + done.evaluations,
            limit=limit,
            rejected=rejected,
            binds="work",
            error=done.error if self._options.tolerance is not None else None,
        )

    def _gives_up(self, limit: float) -> bool:
        """Whether even the longest stable steps [s] would exceed the frame's work."""
        return self._duration / limit > self._cap and within_reach(self._plan)

    def _attempt(self, start: State) -> float | None:
        """Run all parts; return the sum of their errors, or None if another choice has to be tried from the start."""
        options, choice = self._options, self._choice
        longest = min(CONSTANTS.safety * self._limit, self._duration)
        if options.step is not None:
            longest = options.step if options.step <= self._limit else min(options.step, longest)
        least = 1.0 if options.tolerance is None else self._stability.least(choice.columns)
        steps = steps_for(self._duration, longest / max(choice.refine, least))
        parts = self._parts(choice.columns, steps)
        self._first = max(1, math.ceil(steps / parts))
        length = self._duration / parts
        self._finest = length / self._first
        self._steps = self._flagged = 0
        self._sums = Sums()
        for part in range(parts):
            if not self._part(part, length, start):
                return None
        if choice.judge:
            self._flagged = int(self._sums.error > self._error.budget)
            self._error.judged(self._choice.columns, max(choice.refine, least), self._sums)
        else:
            self._error.passed(choice.columns, self._sums)
        return self._sums.error

    def _parts(self, columns: int, steps: int) -> int:
        """Into how many parts the frame is cut."""
        if columns == 1 and self._options.tolerance is None:
            return 1
        return self._stability.parts(columns, steps, self._duration)

    def _part(self, part: int, length: float, start: State) -> bool:
        """Run one part; return whether it holds."""
        state, choice, options = self._state, self._choice, self._options
        t = self._t + part * length
        columns = self._columns(part, t, length, start)
        before = columns.evaluations
        told = columns.told(choice.columns)
        self._evaluations += columns.evaluations - before
        self._calls += self._part_cost
        accepted = True
        if told.finite and options.tolerance is not None:
            accepted = self._judge(columns, told.activity, (part + 1) * length / self._duration)
        if not told.finite:
            return self._instead(2.0, "not finite")
        if not accepted:
            return False
        told = columns.told(self._choice.columns)
        limit = options.step_limit(told.omega2, told.damping)
        if not self._finest <= limit:
            # The motion stiffened.
            self._limit = min(self._limit, limit)
            return self._instead(1.0, "not within their stability limit")
        choice = self._choice
        x, v = columns.combine(choice.columns)
        if self._unknown() and self._energy.looks(self._memory.omega2, told.omega2, combined=choice.columns > 1):
            ends = (t, state.x, state.v), (t + length, x, v)
            # A combination's energy does not swing.
            step = self._finest if choice.columns == 1 else 0.0
            if self._energy.exceeds(*ends, step, self._put_in(columns, t, choice.columns)):
                return self._instead(2.0, "making energy from nowhere")
        self._memory.omega2, self._memory.damping = told.omega2, told.damping
        if self._book is not None:
            columns.note(choice.columns, self._book)
        self._steps += sum(columns.counts[: choice.columns])
        state.x, state.v = x, v
        return True

    def _unknown(self) -> bool:
        """Whether the error vouches for nothing: then energy might come from nowhere."""
        return self._options.tolerance is None or self._sums.error > self._error.budget

    def _put_in(self, columns: Columns, t: float, count: int) -> float:
        """Return the work [J] that grippers and moving air did over a part that begins at t [s]."""
        x, v = columns.combine(count)
        if not (self._plan.supply(t, self._state.x, self._state.v) or self._plan.supply(t, x, v)):
            return columns.work(count)
        # The work of air is noted on demand alone.
        noted = Columns(self._plan, self._state, t, columns.duration, columns.counts, powers=True, narrow=self._narrow)
        work = noted.work(count)
        self._evaluations += noted.evaluations
        return work

    def _columns(self, part: int, t: float, length: float, start: State) -> Columns:
        """The runs of a part; those of the first are kept over attempts with the same steps."""
        counts = step_counts(self._first, len(RATIOS))
        kept = self._kept
        if part == 0 and kept is not None and kept.counts == counts and kept.duration == length:
            return kept
        if self._options.tolerance is not None:
            # A judgement looks at one combination more.
            self._narrow = self._precision.narrows(
                self._state, amplification(self._choice.columns + self._choice.judge)
            )
        columns = Columns(
            self._plan,
            start if part == 0 else self._state,
            t,
            length,
            counts,
            powers=self._book is not None and self._book.powers,
            narrow=self._narrow,
            omega=max(self._stability.omega, 1.0 / self._duration),
        )
        if part == 0:
            self._kept = columns
        return columns

    def _judge(self, columns: Columns, activity: float, passed: float) -> bool:
        """Add a part's error to the frame's; return whether it still fits, or choose what to try next.

        Args:
            columns: runs of the part.
            activity: largest change of a velocity over it [m/s].
            passed: share of the frame that has passed at its end.
        """
        choice, rule, sums = self._choice, self._error, self._sums
        difference = columns.difference(choice.columns - 1) if choice.columns > 1 else 0.0
        predicted = rule.predicted(choice.columns, difference, activity)
        if not choice.judge:
            sums.error += predicted
            sums.before += difference
            if sums.error <= rule.budget:
                return True
            # All parts are judged then: one choice holds for the whole of a frame.
            self._choice = Choice(choice.columns, choice.refine, True)
            return False
        errors = [self._difference(columns, k) for k in range(1, choice.columns + 1)]
        accepted = sums.error + errors[-1] <= rule.budget or self._spent
        if not accepted or choice.refine > 1.0:
            aim = CONSTANTS.aim * rule.budget * passed
            while len(errors) < self._options.columns and sums.error + errors[-1] > aim:
                if self._evaluations + self._calls + columns.counts[len(errors) + 1] > self._cap:
                    break
                errors.append(self._difference(columns, len(errors) + 1))
        if not accepted:
            # A combination of more runs that are there already may do.
            enough = [k for k, error in enumerate(errors, start=1) if sums.error + error <= rule.budget]
            if enough:
                self._choice = choice = Choice(enough[0], choice.refine, True)
                accepted = True
        sums.add(errors, choice.columns, predicted, activity)
        if accepted:
            return True
        if sums.error <= rule.floor(choice.columns):
            # No step gets below rounding.
            return True
        wanted, refine = rule.choose([each / passed for each in sums.errors], choice.refine)
        if wanted == choice.columns:
            refine = max(refine, 1.1 * choice.refine)
        refine = min(refine, CONSTANTS.finer * max(choice.refine, self._stability.least(wanted)))
        if self._affords(wanted, refine):
            self._choice = Choice(wanted, refine, True)
            return False
        self._spent = True
        return True

    def _difference(self, columns: Columns, count: int) -> float:
        """Return the error of a combination [m], the run that it takes counted."""
        before = columns.evaluations
        error = columns.difference(count)
        self._evaluations += columns.evaluations - before
        return error

    def _affords(self, columns: int, refine: float) -> bool:
        """Whether one more attempt fits what is left of the frame's work."""
        return self._evaluations + self._calls + self._work(columns, refine) <= self._cap

    def _work(self, columns: int, refine: float) -> float:
        """Force evaluations of an attempt that is judged, the calls that it takes included."""
        steps = self._duration / (CONSTANTS.safety * self._limit) * refine
        parts = self._parts(columns, math.ceil(steps))
        return steps * sum(RATIOS[: columns + 1]) + parts * (columns + 1 + self._part_cost)

    def _instead(self, finer: float, why: str) -> bool:
        """Try finer steps from the start, or give explicit ones up; return False.

        Raises:
            UnstableError: where nothing is left to try.
        """
        choice = self._choice
        refine = finer * choice.refine
        if self._affords(choice.columns, refine):
            self._choice = Choice(choice.columns, refine, choice.judge)
            if self._options.tolerance is None and finer > 1.0:
                self._error.refined(refine)
            return False
        self._lost = within_reach(self._plan)
        if not self._lost:
            raise UnstableError(
                f"{self._options.name}: steps of {self._finest:.3g} s are {why}, and finer ones exceed the frame's "
                f"work limit of {self._options.work:g} times real time; raise 'work_limit' or take a softer cloth"
            )
        return False
