# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One advance by explicit steps within the work limit of a frame, with a fallback."""

from __future__ import annotations

import math

from cloth_sim_ros.physics.book import Book
from cloth_sim_ros.physics.constants import CONSTANTS
from cloth_sim_ros.physics.control import calm
from cloth_sim_ros.physics.control.choice import Choice, Options, asides, binds, reason
from cloth_sim_ros.physics.control.effort import Effort
from cloth_sim_ros.physics.control.energy import EnergyRule
from cloth_sim_ros.physics.control.error import ErrorRule, is_of
from cloth_sim_ros.physics.control.fallback import finish, part_cost, whole_work, within_reach, work_cap
from cloth_sim_ros.physics.control.hinges import HingeRule
from cloth_sim_ros.physics.control.precision import PrecisionRule
from cloth_sim_ros.physics.control.stability import StabilityRule
from cloth_sim_ros.physics.control.stretch import Stretch
from cloth_sim_ros.physics.control.touch import TouchRule
from cloth_sim_ros.physics.integrators.base import (
    Advance,
    NoRoomError,
    UnstableError,
    refuse_boundless,
    refuse_unstable,
)
from cloth_sim_ros.physics.integrators.columns import SUMS, Ran
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.remembered import Energy, Error, Fallback, Hinges, Noise, Precision, Stability, Touch
from cloth_sim_ros.physics.state import State


def advance(options: Options, plan: Plan, state: State, t: float, duration: float, book: Book | None) -> Advance:
    """Advance a state by a duration: by the fast path, else by `ExplicitAdvance`."""
    done = calm.attempt(options, plan, state, t, duration, book)
    if isinstance(done, Advance):
        return done
    return ExplicitAdvance(options, plan, state, t, duration, book, done).run()


class ExplicitAdvance:
    """One advance of a state by a duration.

    Args:
        options: settings of the integrator.
        plan: equations of motion.
        state: advanced in place.
        t: time at the start [s].
        duration: time to advance [s].
        book: work accumulator; None for none.
        ran: run of a rejected fast path; None for none.
    """

    def __init__(
        self,
        options: Options,
        plan: Plan,
        state: State,
        t: float,
        duration: float,
        book: Book | None,
        ran: Ran | None = None,
    ) -> None:
        self._options, self._plan, self._state, self._book = options, plan, state, book
        self._t, self._duration = t, duration
        self._known = Stability.key in state.memory
        self._memory = memory = Stability.of(state)
        stability = StabilityRule(plan, memory, state, duration)
        refuse_boundless(memory.omega2, memory.damping)
        #: Longest stable step without contact [s].
        self._bare = limit = options.step_limit(memory.omega2, memory.damping)
        error, precision, noise = Error.of(state), Precision.of(state), Noise.of(state)
        if not is_of(error, duration):
            # The recorded errors belong to frames of another length.
            error = Error(columns=error.columns, refine=error.refine, part=duration)
            precision, noise = Precision(), Noise()
        columns, settled = options.columns, 0.0
        if options.tolerance is not None:
            columns = min(int(error.columns), columns)
        elif error.wait <= 0.0:
            # Larger steps than the energy rule required are tried periodically.
            settled, error.refine = error.refine, max(1.0, 0.5 * error.refine)
        judge = options.tolerance is not None and error.wait <= 0.0
        budget = math.inf if options.tolerance is None else CONSTANTS.share * duration * options.tolerance
        # A fixed step of a running simulation was stable at its start.
        once = options.step if options.step is not None and self._known else 0.0
        memory.longest = max(memory.longest, min(max(limit, once), duration))
        self._fallen = Fallback.of(state).fallen
        allowed = options.tolerance is not None and stability.damped
        touch = TouchRule(options, plan, Touch() if plan.contact is None else Touch.of(state), memory)
        met = touch.look_ahead(t, duration, state)
        # Waves of contact may have any frequency, without damping.
        hinges = HingeRule(plan, Hinges.of(state), allowed=allowed and not met > 0.0)
        longest = min(CONSTANTS.safety * limit, duration)
        if judge:
            hinges.choose(state.x, longest, duration, columns)
        else:
            hinges.keep(longest, duration)
        # The recorded error is valid for the same multirate ratio only.
        judge = judge or (options.tolerance is not None and hinges.every != hinges.memory.every)
        self._effort = Effort(
            options=options,
            plan=plan,
            state=state,
            book=book,
            stability=memory,
            energy=EnergyRule(plan, Energy.of(state), settled),
            precision=PrecisionRule(plan, precision, noise, duration, budget),
            hinges=hinges,
            touch=touch,
            duration=duration,
            cap=math.inf,
            part_cost=part_cost(plan, met),
            touches=met > 0.0,
            ran=ran,
        )
        rule = ErrorRule(error, stability, budget, options.columns, state)
        self._stability = stability
        self._whole = Stretch(self._effort, t, duration, Choice(columns, error.refine, judge), rule, stability)
        self._limit = self._whole.limit
        #: Limit of force evaluations of the frame.
        self._most = whole_work(plan, options.work, duration, met, hinges.every)
        work, self._left_over = work_cap(plan, self._most, duration, memory.longest, self._fallen, met, self._limit)
        self._allow(work)

    def _allow(self, work: float) -> None:
        """Grant the interval further work, in force evaluations."""
        effort = self._effort
        effort.cap = effort.evaluations + effort.calls + work
        if self._options.tolerance is not None:
            # An attempt with an error estimate must fit.
            self._whole.most = work / SUMS[2]

    def run(self) -> Advance:
        """Advance the state and return the result.

        Raises:
            UnstableError: if no step within the work limit is stable.
            StepLimitError: if a fixed step exceeds the limit at the start.
        """
        options, state, effort, whole = self._options, self._state, self._effort, self._whole
        if options.step is not None and options.step > self._limit and not self._known:
            refuse_unstable(options.step, self._limit, options.name)
        # Even the longest stable steps may exceed the work limit of the frame.
        effort.lost = self._duration / self._bare > effort.cap and effort.gives_way
        fits = whole.affords(whole.choice.columns, whole.choice.refine)
        if options.tolerance is not None and not fits:
            # The previous choice exceeds the limit: the attempt has as many runs as fit, and steps that leave work for
            # a second attempt.
            columns = whole.choice.columns
            while columns > 1 and not whole.affords(columns, 1.0):
                columns -= 1
            most = effort.cap / whole.work(columns, 1.0) / CONSTANTS.finer
            whole.choice = Choice(columns, max(1.0, min(whole.choice.refine, most)), True)
        if whole.choice.judge and not effort.lost:
            if fits:
                effort.evaluations += effort.precision.measure(self._t, state, whole.longest, whole.choice)
                whole.choice = effort.fitted(whole.choice, whole.work, 0.0)
            effort.precision.look(state)
        error = self._cover()
        if error is None and effort.may_finish:
            error = self._cover_anyhow()
        if error is None:
            return self._finish()
        whole = self._whole
        if whole.pieces > 1:
            whole.rule.halved(whole.choice.columns, self._mean_refinement())
        for memory in (self._memory, whole.rule.memory, effort.precision.memory, effort.energy.memory):
            memory.store(state)
        if self._plan.bends:
            effort.hinges.memory.every = float(effort.hinges.every)
            effort.hinges.memory.store(state)
        if effort.precision.noise.power >= 0.0 or Noise.key in state.memory:
            effort.precision.noise.store(state)
        effort.touch.store(state, judged=whole.choice.judge or whole.pieces > 1)
        if self._fallen or effort.finishing:
            Fallback(min(64.0, self._fallen + 1.0) if effort.finishing else 0.0).store(state)
        flagged = int(options.tolerance is not None and error > whole.rule.budget)
        return Advance(
            steps=whole.steps,
            evaluations=effort.evaluations,
            step=whole.finest,
            limit=self._limit,
            rejected=effort.rejected,
            integrator=options.name,
            binds="work" if effort.spent else binds(options, whole.choice, whole.first, whole.finest),
            error=error if options.tolerance is not None else None,
            flagged=flagged,
            reason=self._reason(flagged),
        )

    def _cover(self) -> float | None:
        """Integrate the interval.

        Returns:
            The error [m]; None if explicit steps are abandoned. The state is then that of the start.
        """
        whole = self._whole
        if self._book is not None:
            self._book.restart()
        try:
            error = whole.cover()
        except NoRoomError:
            # Moving bodies left the cloth no space within the frame: no step is short enough.
            self._state.go_back(whole.start)
            if not within_reach(self._plan):
                raise
            return None
        except UnstableError:
            self._state.go_back(whole.start)
            raise
        if error is None:
            self._state.go_back(whole.start)
        return error

    def _cover_anyhow(self) -> float | None:
        """Integrate by a single run of the longest stable steps, within the reserve; see `_integrate`."""
        effort = self._effort
        effort.finishing, effort.spent, effort.lost = True, True, False
        self._whole = Stretch(effort, self._t, self._duration, Choice(1, 1.0, True), self._whole.rule, self._stability)
        self._allow(self._left_over)
        return self._cover()

    def _mean_refinement(self) -> float:
        """Return the number of steps of the first runs relative to the number that stability requires."""
        return max(1.0, self._whole.first * self._whole.longest / self._duration)

    def _reason(self, flagged: int) -> str:
        """Return the choice in words."""
        whole, effort = self._whole, self._effort
        words = reason(self._options, whole.choice, whole.first, whole.finest)
        if whole.pieces > 1:
            words += f" in the finest of {whole.pieces} stretches"
        words += asides(whole.every, effort.narrow)
        if flagged and effort.spent:
            words += f"; the tolerance was missed within the frame's work limit of {self._options.work:g}"
        elif flagged:
            words += "; the tolerance is finer than rounding of the coordinates allows"
        return words

    def _finish(self) -> Advance:
        """Finish the frame by implicit steps."""
        effort = self._effort
        # The key of the state must stay, see `reset_step_control`.
        self._memory.store(self._state)
        if self._book is not None:
            self._book.restart()
        done = finish(
            self._plan,
            self._state,
            self._t,
            self._duration,
            self._book,
            instead_of=self._options.name,
            most=self._most - effort.evaluations - effort.calls,
        )
        return done._replace(
            evaluations=effort.evaluations + done.evaluations,
            limit=self._limit,
            rejected=effort.rejected,
            binds="work",
            error=done.error if self._options.tolerance is not None else None,
        )
