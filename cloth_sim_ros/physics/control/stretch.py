# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Adaptive interval: attempts by explicit steps until stability, error and energy rules hold.

One choice of runs and steps applies to the whole interval. If a refinement reduces the error less than its order
predicts, the motion is not smooth: a spring turned over, or a force changed suddenly. Then the interval is halved, so
that fine steps are limited to that moment.
"""

from __future__ import annotations

import math

from cloth_sim_ros.physics.constants import CONSTANTS
from cloth_sim_ros.physics.control.choice import Choice
from cloth_sim_ros.physics.control.effort import Effort
from cloth_sim_ros.physics.control.ending import EVALUATIONS, missed_velocity
from cloth_sim_ros.physics.control.error import ErrorRule, Sums
from cloth_sim_ros.physics.control.stability import UNDAMPED_STEPS, StabilityRule
from cloth_sim_ros.physics.integrators.base import UnstableError
from cloth_sim_ros.physics.integrators.columns import RATIOS, SUMS, Columns, step_counts
from cloth_sim_ros.physics.integrators.fixed import steps_for
from cloth_sim_ros.physics.powers import root
from cloth_sim_ros.physics.remembered import Error
from cloth_sim_ros.physics.state import State

#: Minimum steps of the first run for halving; with fewer steps the runs of a half would not differ enough.
_FEWEST_HALVED = 2 * UNDAMPED_STEPS
#: Maximum halvings of an advance; the shortest interval of a frame is then below a nanosecond.
_MOST_HALVINGS = 24


class Stretch:
    """Advances the state of a context over one interval.

    Args:
        effort: context of the advance.
        t: time at the start [s].
        duration: length [s].
        choice: first choice of runs and refinement.
        rule: error rule with the budget of this interval.
        stability: stability rule for this length.
        ahead: force evaluations reserved for the rest of the advance.
        halvings: number of halvings that led to this interval.
        most: maximum steps of the first run. If it needs more, the interval is halved before the first attempt, because
            short steps are rarely necessary for long.
    """

    def __init__(
        self,
        effort: Effort,
        t: float,
        duration: float,
        choice: Choice,
        rule: ErrorRule,
        stability: StabilityRule,
        *,
        ahead: float = 0.0,
        halvings: int = 0,
        most: float = math.inf,
    ) -> None:
        self._effort, self._t, self._duration = effort, t, duration
        self.choice, self.rule = choice, rule
        self._stability, self._ahead, self._halvings, self.most = stability, ahead, halvings, most
        self.limit, self.start = effort.touch.limit_ahead(t, duration, effort.state), effort.state
        #: Steps of the runs that make up the result, those of the first run, the smallest step [s], and the number of
        #: intervals after halving.
        self.steps, self.first, self.finest, self.pieces = 0, 0, math.inf, 1
        #: Rejected attempts; True if the interval must be halved next.
        self._rejected, self._halve = 0, False
        self._kept: Columns | None = None
        self._sums, self._counts_first, self._held = Sums(), 0, 0.0
        #: Multirate ratio.
        self.every, self._stability.impulses = effort.hinges.within(self.longest, duration)

    @property
    def longest(self) -> float:
        """Largest step that stability allows [s]."""
        return min(CONSTANTS.safety * self.limit, self._duration)

    def cover(self) -> float | None:
        """Integrate the interval.

        Returns:
            The sum of its errors [m]; None if explicit steps are abandoned.

        Raises:
            UnstableError: if no choice is left.
        """
        effort = self._effort
        state, memory, book = effort.state, effort.stability, effort.book
        self.start = start = state.share()
        begun = memory.omega2, memory.damping, effort.hinges.told
        noted = None if book is None else book.noted()
        longest = self.longest
        if self._duration * self.choice.refine > self.most * longest:
            if self._halvings < _MOST_HALVINGS and effort.affords(self._ahead):
                return self._halves()
            effort.spent, self.choice = True, Choice(self.choice.columns, 1.0, True)
            effort.lost = self._duration > self.most * longest and effort.gives_way
        if effort.touch.is_brief(longest, self._duration) and self._halvings < _MOST_HALVINGS:
            return self._halves(untried=True)
        if self._halvings and not effort.lost:
            self.choice = effort.fitted(self.choice, self.work, self._ahead)
        while not effort.lost:
            error = self._attempt(start)
            if error is not None and self._halvings:
                error = self._to_the_end(error)
            if error is not None:
                return error
            state.go_back(start)
            memory.omega2, memory.damping, effort.hinges.told = begun
            if book is not None and noted is not None:
                book.go_back(noted)
            effort.rejected += 1
            self._rejected += 1
            if self._halve and not effort.lost:
                return self._halves()
        return None

    def _halves(self, *, untried: bool = False) -> float | None:
        """Integrate both halves, each with its own choice; return as `integrate`."""
        effort, half, spent, self.finest = self._effort, 0.5 * self._duration, 0.0, math.inf
        most = min(self.most, self.first) if self.first else self.most
        self.steps = self.first = self.pieces = 0
        for k in range(2):
            # The second half gets the unused budget of the first one.
            budget = max(0.5 * self.rule.budget, (self.rule.budget - spent) * k)
            stability = StabilityRule(effort.plan, effort.stability, effort.state, half)
            rule = self.rule.of_stretch(Error(part=half), budget, effort.state, stability)
            # Reserve of the other half: its steps may be as long as before, but it takes at least as many as this one.
            finer = max(1.0, self.choice.refine * min(1.0, half / self.longest))
            later = finer * max(1.0, half / (CONSTANTS.safety * effort.stability.longest))
            ahead = self._ahead + later * SUMS[self.choice.columns + 1] * (k == 0)
            now, deeper = self._t + k * half, self._halvings + 1
            child = Stretch(effort, now, half, self.choice, rule, stability, ahead=ahead, halvings=deeper, most=most)
            # The half starts with the steps that were too long for the whole.
            longest = min(child.longest, self.longest) if untried else child.longest
            child.choice = Choice(self.choice.columns, max(1.0, self.choice.refine * longest / self.longest), True)
            error = child.cover()
            if error is None:
                return None
            spent += error
            self.steps, self.first = self.steps + child.steps, self.first + child.first
            self.pieces, self.finest = self.pieces + child.pieces, min(self.finest, child.finest)
        return spent

    def _attempt(self, start: State) -> float | None:
        """Run all parts; return the sum of their errors [m], or None for a further attempt from the start."""
        options, choice, rule = self._effort.options, self.choice, self.rule
        longest = self.longest
        self.every, self._stability.impulses = self._effort.hinges.within(longest, self._duration)
        if options.step is not None:
            longest = options.step if options.step <= self.limit else min(options.step, longest)
        least = 1.0 if options.tolerance is None else self._stability.asks(choice.columns)
        steps = steps_for(self._duration, longest / max(choice.refine, least))
        parts = self._parts(choice.columns, steps)
        length = self._duration / parts
        self._counts_first = max(1, math.ceil(steps / parts / self.every)) * self.every
        self.finest = length / self._counts_first
        self.first, self.steps = parts * self._counts_first, 0
        self._sums, self._halve, self._held = Sums(), False, 0.0
        for part in range(parts):
            if not self._part(part, length, start):
                return None
        if choice.judge:
            rule.judged(self.choice.columns, max(choice.refine, least), self._sums)
        else:
            rule.passed(choice.columns, self._sums)
        self._effort.touch.held = max(self._effort.touch.held, self._held)
        return self._sums.error

    def _parts(self, columns: int, steps: int) -> int:
        """Return the number of parts of the interval."""
        alone = columns == 1 and self._effort.options.tolerance is None
        return 1 if alone else self._stability.parts(columns, steps, self._duration)

    def _part(self, part: int, length: float, start: State) -> bool:
        """Run one part; return True if all rules hold."""
        effort, choice = self._effort, self.choice
        state, options, memory = effort.state, effort.options, effort.stability
        t = self._t + part * length
        columns = self._columns(part, t, length, start)
        before = columns.evaluations
        finite = (told := columns.told(choice.columns)).finite
        effort.evaluations += columns.evaluations - before
        effort.calls += effort.part_cost
        # If contact is too stiff for the steps, an error estimate is a waste.
        if finite and effort.touch.acts(columns, choice.columns) and not self._within(columns):
            return False
        accepted = True
        if finite and options.tolerance is not None:
            accepted = self._judge(columns, told.activity, (part + 1) * length / self._duration)
        if not finite:
            # Contact did not stop a particle; with finer steps it would not have got that far. If the run ended on a
            # surface, the limit is zero, and the steps were too long.
            reached, own = columns.reached(self.choice.columns), columns.own(self.choice.columns)
            limit = effort.touch.limit(reached, own) or 0.5 * self.finest
            finer, self.limit = 2.0 if self.finest <= limit else 1.0, min(self.limit, limit)
            return self._instead(finer, "not finite")
        if not (accepted and self._within(columns)):
            return False
        choice, told = self.choice, columns.told(self.choice.columns)
        after = math.inf if effort.touch.acts(columns, choice.columns) else told.omega2
        # Without a reliable error estimate the steps may create energy.
        unknown = options.tolerance is None or self._sums.error > self.rule.budget
        varied = choice.columns > 1 or self._halvings > 0
        if unknown and effort.energy.looks(memory.omega2, after, varied=varied, refine=choice.refine):
            # The energy of a combination does not oscillate; a change of step size makes the deviation permanent.
            step = 0.0 if varied else self.finest
            if effort.makes_energy(columns, choice, (t, t + length), step):
                return self._instead(2.0, "making energy from nowhere")
        memory.omega2, memory.damping, bent = told.omega2, told.damping, told.hinges
        effort.hinges.told = bent if self.every > 1 else effort.hinges.told
        if effort.book is not None:
            columns.note(choice.columns, effort.book)
        self.steps += sum(columns.counts[: choice.columns])
        columns.pass_on(choice.columns, state)
        return True

    def _within(self, columns: Columns) -> bool:
        """Return True if the steps of a part are within the limit that the motion encountered; else choose a retry."""
        limit = self._effort.touch.limit_met(columns, self.choice.columns) or 0.5 * self.finest
        exceed, told = self._effort.hinges.exceed, columns.told(self.choice.columns)
        if self.finest <= limit and (self.every == 1 or not exceed(self.every * self.finest, told)):
            return True
        self.limit = min(self.limit, limit)
        return self._instead(1.0, "not within their stability limit")

    def _columns(self, part: int, t: float, length: float, start: State) -> Columns:
        """Return the tableau of a part; that of the first part is reused by attempts with the same steps."""
        effort, kept = self._effort, self._kept
        counts = step_counts(self._counts_first, len(RATIOS), self.every)
        missed = self._rejected + self._halvings > 0 and effort.plan.threads(self.every) == 1
        if effort.options.tolerance is not None:
            # The measured effect belongs to a whole advance, and does not decrease with the interval.
            effort.narrow = self._halvings == 0 and effort.precision.narrows(effort.state, self.choice)
        same = kept is not None and (kept.counts, kept.duration, kept.every) == (counts, length, self.every)
        if same and part == 0 and kept is not None and effort.narrow >= kept.narrow:
            effort.narrow = kept.narrow
            return kept
        columns = Columns(
            effort.plan,
            start if part == 0 else effort.state,
            t,
            length,
            counts,
            powers=effort.book is not None and effort.book.powers,
            touches=effort.book is not None and effort.book.obstacle_count > 0,
            narrow=effort.narrow,
            omega=self._slowest,
            touched=1.0 / effort.duration,
            ran=effort.ran,
            every=self.every,
            likely=self.choice.likely(effort.options.tolerance, missed=missed),
        )
        self._kept = columns if part == 0 else kept
        return columns

    def _judge(self, columns: Columns, activity: float, passed: float) -> bool:
        """Add the error of a part to that of the interval; return True if it fits, else choose a retry.

        Args:
            columns: tableau of the part.
            activity: largest velocity change over it [m/s].
            passed: elapsed fraction of the interval at its end.
        """
        effort, choice, rule, sums = self._effort, self.choice, self.rule, self._sums
        difference = columns.difference(choice.columns - 1) if choice.columns > 1 else 0.0
        predicted = rule.predicted(choice.columns, difference, activity)
        held = columns.held(choice.columns)
        self._held = max(self._held, held)
        if effort.touch.is_harder(held):
            # The contact is harder than in the frame of the last estimate, or the first one.
            predicted = math.inf
        if not choice.judge:
            sums.error += predicted
            sums.before += difference
            if sums.error <= rule.budget:
                return True
            # All parts need an estimate, because one choice applies to the whole interval. Existing runs are reused.
            kept = columns.evaluations if columns is self._kept else 0
            self.choice = effort.fitted(Choice(choice.columns, choice.refine, True), self.work, self._ahead, kept)
            return False
        errors = [self._difference(columns, k) for k in range(1, choice.columns + 1)]
        accepted = sums.error + errors[-1] <= rule.budget or effort.spent
        if not accepted or choice.refine > 1.0:
            aim = CONSTANTS.aim * rule.budget * passed
            ahead = self._ahead + (1.0 - passed) * self.work(choice.columns, choice.refine)
            while len(errors) < effort.options.columns and sums.error + errors[-1] > aim:
                fits = effort.affords(ahead + columns.counts[len(errors) + 1])
                # If runs do not gain on one another, as at a force jump, a further run does not either.
                vain = len(errors) > 1 and errors[-1] > errors[-2]
                if not fits or vain or (columns.narrow and not effort.precision.tells(len(errors) + 2)):
                    break
                errors.append(self._difference(columns, len(errors) + 1))
        if not accepted:
            # A combination of more existing runs may suffice. If the motion is not smooth, all further estimates must
            # confirm it, because one of them may be small by chance.
            within = [sums.error + error <= rule.budget for error in errors]
            beyond = len(errors) if self._halvings else 0
            enough = [k for k, fit in enumerate(within, start=1) if fit and all(within[k - 1 : beyond])]
            if enough:
                self.choice = choice = Choice(enough[0], choice.refine, True)
                accepted = True
        sums.add(errors, choice.columns, predicted, activity)
        if accepted or sums.error <= CONSTANTS.trust * sums.parts * rule.floor(choice.columns):
            return True  # no step reduces the error below rounding
        taken = max(choice.refine, self._stability.impulses)
        wanted, refine = rule.choose([each / passed for each in sums.errors], taken)
        # A single estimate does not show whether the motion is smooth.
        gained = len(sums.errors) == 1 or CONSTANTS.trust * min(sums.errors) < sums.errors[0]
        return not self._seek(wanted, refine, smooth=gained)

    def _to_the_end(self, error: float) -> float | None:
        """Return the error of an interval [m] including its last half step; None for a further attempt."""
        effort = self._effort
        end = self._t + self._duration
        missed = missed_velocity(effort.plan, effort.state, end, 0.5 * self.finest) / self._slowest
        effort.evaluations += EVALUATIONS
        error += missed
        if error <= self.rule.budget or effort.spent or error <= self.rule.floor(self.choice.columns):
            return error
        refine = self.choice.refine * root(error / (CONSTANTS.aim * self.rule.budget), 3)
        return None if self._seek(self.choice.columns, refine, smooth=False) else error

    def _seek(self, columns: int, refine: float, *, smooth: bool) -> bool:
        """Choose runs and refinement of the next attempt; return False if none fits the work limit.

        Args:
            columns: wanted number of runs.
            refine: wanted refinement.
            smooth: True if combinations gained on one another, as in a smooth motion.
        """
        self._effort.precision.missed += 1
        finer = min(refine, CONSTANTS.finer * max(self.choice.refine, self._stability.asks(columns)))
        affordable = self.affords(columns, finer)
        if not smooth and (not affordable or self._beyond_order(refine)) and self._can_halve():
            self._halve = True
            return True
        if affordable:
            self.choice = Choice(columns, finer, True)
            return True
        self._effort.spent = True
        return False

    @property
    def _slowest(self) -> float:
        """Angular frequency [1/s] that converts an error of velocity into one of position.

        Over a whole advance the velocity errors of slow waves have become position errors, so the fastest wave counts.
        An interval after halving is too short for that; there each velocity error lasts for the whole advance.
        """
        slowest = 1.0 / self._effort.duration
        return slowest if self._halvings else max(self._stability.omega, slowest)

    def _beyond_order(self, refine: float) -> bool:
        """Return True if the last refinement reduced the error less than its order predicts."""
        return bool(self._halvings + self._rejected) and refine > CONSTANTS.trust * self.choice.refine

    def _can_halve(self) -> bool:
        """Return True if the interval has enough steps for halving, and its halves fit the work limit."""
        enough = self.first >= _FEWEST_HALVED and self._halvings < _MOST_HALVINGS
        return enough and self.affords(self.choice.columns, self.choice.refine)

    def _difference(self, columns: Columns, count: int) -> float:
        """Return the error estimate of a combination [m], and count its further run."""
        before, error = columns.evaluations, columns.difference(count)
        self._effort.evaluations += columns.evaluations - before
        return error

    def affords(self, columns: int, refine: float) -> bool:
        """Return True if a further attempt fits the remaining work of the frame."""
        return self._effort.affords(self._ahead + self.work(columns, refine))

    def work(self, columns: int, refine: float) -> float:
        """Return the work of an attempt with an error estimate, in force evaluations, engine calls included."""
        steps = steps_for(self._duration, self.longest / max(refine, self._stability.asks(columns)))
        calls = self._parts(columns, steps) * (columns + 1 + self._effort.part_cost)
        return steps * SUMS[columns + 1] + calls

    def _instead(self, finer: float, why: str) -> bool:
        """Choose finer steps for a retry from the start, or abandon explicit steps; return False.

        Args:
            finer: factor on the refinement.
            why: failure of the present steps, for the error message.

        Raises:
            UnstableError: if no choice is left.
        """
        effort, choice, options = self._effort, self.choice, self._effort.options
        refine = finer * choice.refine
        if options.tolerance is not None and finer > 1.0 and self._beyond_order(2.0 * refine) and self._can_halve():
            self._halve = True
            return False
        columns = effort.fewer(choice.columns, lambda count: self._ahead + self.work(count, refine))
        if self.affords(columns, refine):
            # The recorded error is valid for the same multirate ratio. Without a tolerance there is no error estimate.
            changed = choice.judge or columns < choice.columns or self.every != effort.hinges.every
            self.choice = Choice(columns, refine, changed and options.tolerance is not None)
            if options.tolerance is None and finer > 1.0:
                self.rule.refined(refine)
            return False
        effort.lost = effort.gives_way
        if not effort.lost:
            raise UnstableError(
                f"{options.name}: steps of {self.finest:.3g} s are {why}, and finer ones exceed the frame's "
                f"work limit of {options.work:g} times real time; raise 'work_limit' or reduce the cloth's stiffness"
            )
        return False
