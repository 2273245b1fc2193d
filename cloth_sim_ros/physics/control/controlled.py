# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One advance of the extrapolated leapfrog, attempted until it is stable and accurate."""

from __future__ import annotations

import math

from cloth_sim_ros.physics.book import Book
from cloth_sim_ros.physics.control.choice import Choice, Options, binds, reason
from cloth_sim_ros.physics.control.control import (
    AIM,
    ALTERNATE_SHARE,
    COSTLY,
    FAR,
    FINEST,
    HOPELESS,
    LEAST_REFINED,
    LONGEST_WAIT,
    MANY_STEPS,
    MOST_COLUMNS,
    QUICK,
    SHARE_PER_SECOND,
    STALLED,
    STIFFENED,
    UNDAMPED,
    UNRESOLVED,
    Memory,
    cheapest,
    hopeless,
)
from cloth_sim_ros.physics.control.economies import Economies
from cloth_sim_ros.physics.control.economy import THOROUGH, Economy
from cloth_sim_ros.physics.control.energy_guard import EnergyGuard
from cloth_sim_ros.physics.control.last_resort import last_resort, within_reach
from cloth_sim_ros.physics.forces.drag import Drag
from cloth_sim_ros.physics.forces.grips import Grips
from cloth_sim_ros.physics.integrators.base import MEMORY, Advance, UnstableError, refuse_unstable
from cloth_sim_ros.physics.integrators.columns import Columns, amplification, step_counts
from cloth_sim_ros.physics.integrators.fixed import SAFETY, steps_for
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.powers import power
from cloth_sim_ros.physics.state import State

#: Longest stretch that is extrapolated at once [s]: over longer ones the columns part too far for their combination.
LONGEST_STRETCH = 0.04
_ATTEMPTS = 40


class ControlledAdvance:
    """Advances a state by one duration; made anew for each."""

    def __init__(
        self,
        options: Options,
        plan: Plan,
        state: State,
        t: float,
        duration: float,
        book: Book | None,
    ) -> None:
        self._options, self._plan, self._state, self._book = options, plan, state, book
        self._t, self._duration = t, duration
        # What is not extrapolated need not be cut.
        single = options.columns == 1 and options.tolerance is None
        self._parts = 1 if single else steps_for(duration, LONGEST_STRETCH)
        self._stretch = duration / self._parts
        controlled = options.tolerance is not None
        self._budget = SHARE_PER_SECOND * self._stretch * options.tolerance if options.tolerance else math.inf
        memory = Memory.of(state)
        if abs(memory.stretch - self._stretch) > 1e-6 * self._stretch:
            memory.stretch, memory.wait, memory.rounding, memory.alternating = self._stretch, 0, -1.0, -1.0
        self._memory = memory
        self._economies = Economies(plan, memory, self._stretch, self._budget)
        columns = min(memory.columns, options.columns) if controlled else options.columns
        if not controlled and memory.wait <= 0:
            # What the guard asked for is tried with larger steps from time to time.
            memory.refine = max(1.0, 0.5 * memory.refine)
        self._choice = Choice(columns, memory.refine, controlled and memory.wait <= 0)
        self._evaluations = self._steps = self._first = self._flagged = 0
        self._kept: Columns | None = None
        self._saved = THOROUGH
        #: Least refinement that this advance's energy allows; whether none does.
        self._least, self._lost = 1.0, False
        #: Whether no advance was before this one since the last restart.
        self._begins = memory.softest < 0.0
        #: Whether a motion that no bound of its stiffness foretells may be kicked.
        self._boundless = any(force.boundless for force in plan.model.forces)

    def run(self) -> Advance:
        """Do it."""
        options, state, memory = self._options, self._state, self._memory
        if memory.omega2 < 0.0:
            memory.omega2, memory.damping = self._plan.rates(state.x)
        limit = options.step_limit(memory.omega2, memory.damping)
        self._lost = self._out_of_reach(limit)
        if options.step is not None and options.step > limit and not self._lost and MEMORY not in state.memory:
            refuse_unstable(options.step, limit, options.name)
        self._limit = limit
        if self._choice.judge:
            self._economies.prepare(self._t, state, limit)
        start, begun = state.share(), (memory.omega2, memory.damping)
        rejected = 0
        while True:
            if self._book is not None:
                self._book.restart()
            if self._lost:
                return self._last_resort(rejected)
            self._flagged = self._steps = 0
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
            self._lost = self._lost or (rejected == _ATTEMPTS and within_reach(self._plan))
            if rejected >= _ATTEMPTS and not self._lost:
                raise UnstableError(
                    f"{options.name}: no step down to {self._stretch / self._first:.3g} s "
                    "kept the motion finite and within its stability limit"
                )
        memory.store(state)
        controlled, h = options.tolerance is not None, self._stretch / self._first
        return Advance(
            steps=self._steps,
            evaluations=self._evaluations,
            step=h,
            limit=limit,
            rejected=rejected,
            integrator=options.name,
            binds=binds(options, self._choice, self._first, h),
            error=error if controlled else None,
            flagged=self._flagged,
            reason=reason(options, self._choice, self._first, h) + self._saved.words,
        )

    def _last_resort(self, rejected: int) -> Advance:
        self._memory.store(self._state)
        done = last_resort(self._plan, self._state, self._t, self._duration, self._book, instead_of=self._options.name)
        return done._replace(
            evaluations=self._evaluations + done.evaluations,
            limit=self._limit,
            rejected=rejected,
            binds="stability",
            error=done.error if self._options.tolerance is not None else None,
        )

    def _attempt(self, start: State) -> float | None:
        """Run all stretches; return the sum of their errors, or None if another choice has to be tried from the
        start.
        """
        total = 0.0
        for part in range(self._parts):
            error = self._part(part, start)
            if error is None:
                return None
            total += error
        if self._choice.judge:
            self._choice = Choice(self._choice.columns, self._choice.refine, False)
        else:
            # Without a tolerance nothing is judged, and nothing counted below zero.
            self._memory.wait = max(0, self._memory.wait - 1)
        return total

    def _part(self, part: int, start: State) -> float | None:
        state, choice = self._state, self._choice
        t = self._t + part * self._stretch
        # A stretch that stability would take in one step is refined from there.
        economy = self._economy()
        longest = min(self._economies.share(economy, SAFETY) * self._limit, self._stretch)
        if self._options.step is not None:
            longest = self._options.step if self._options.step <= self._limit else min(self._options.step, longest)
        self._first = steps_for(self._stretch, longest / choice.refine)
        if economy.alternate:
            self._first |= 1
        columns = self._columns(part, t, start, economy)
        self._saved = economy
        before = columns.evaluations
        told = columns.told(choice.columns)
        if not told.finite:
            self._evaluations += columns.evaluations - before
            if choice.refine >= FINEST and not within_reach(self._plan):
                raise UnstableError(
                    f"{self._options.name}: not finite even by steps of {self._stretch / self._first:.3g} s"
                )
            self._lost = choice.refine >= FINEST
            self._retry(choice.columns, 2.0 * choice.refine)
            return None
        error: float | None = 0.0
        if self._options.tolerance is not None:
            error = self._error(columns, told.activity)
        self._evaluations += columns.evaluations - before
        if error is None:
            return None
        x, v = columns.combine(choice.columns)
        omega2, damping = told.omega2, told.damping
        limit = self._options.step_limit(omega2, damping)
        h = self._stretch / self._first
        self._lost = self._out_of_reach(limit)
        if self._lost or not h <= limit:
            self._limit = limit
            self._retry(choice.columns, choice.refine)
            return None
        if self._watches_energy(omega2):
            guard, before = EnergyGuard(self._plan, t, state.x, state.v), columns.evaluations
            finest = choice.refine >= FINEST
            # What is left of many small gains is no reason to give up.
            known = 0.0 if finest else self._memory.made
            work, begins = columns.work_of_grippers(choice.columns), self._begins and part == 0 and not finest
            self._evaluations += columns.evaluations - before
            made, too_much = guard.made(t + self._stretch, x, v, h, known, work=work, begins=begins)
            if too_much:
                self._lost = finest
                self._refine_for_energy()
                return None
            self._memory.made = made
        self._limit = min(self._limit, limit) if part + 1 < self._parts else self._limit
        self._memory.omega2, self._memory.damping = omega2, damping
        if self._book is not None:
            columns.note(choice.columns, self._book)
        self._steps += sum(columns.counts[: choice.columns])
        state.x, state.v = x, v
        return error

    def _out_of_reach(self, limit: float) -> bool:
        """Whether a step limit [s] is far below what it was once: an explicit method would never come to an end."""
        options, memory = self._options, self._memory
        known = MEMORY in self._state.memory
        # A fixed step that goes on was stable once.
        once = options.step if options.step is not None and known else 0.0
        memory.longest = max(memory.longest, min(max(limit, once), self._stretch))
        return limit < memory.longest / FINEST and within_reach(self._plan)

    def _watches_energy(self, omega2: float) -> bool:
        """Whether a result's energy has to be looked at.

        Combined runs let waves that they don't resolve grow, unless those are damped; the plain leapfrog's energy can
        grow where stiffness changes, or where the error is beyond all help.
        """
        memory, choice = self._memory, self._choice
        if choice.refine >= FINEST and not within_reach(self._plan):
            return False
        if choice.columns > 1:
            return self._undamped()
        if self._options.tolerance is not None:
            return self._flagged > 0
        least, most = min(memory.omega2, omega2), max(memory.omega2, omega2)
        memory.softest = least if memory.softest < 0.0 else min(memory.softest, least)
        # A start may be bent upon it already.
        return self._begins or self._boundless or most > STIFFENED * memory.softest or choice.refine > 1.0

    def _undamped(self) -> bool:
        """Whether fast waves last for a stretch. Grips damp what they hold alone; air damps all waves a little."""
        springs = (force for force in self._plan.model.forces if not isinstance(force, Grips | Drag))
        return self._memory.damping * self._stretch < UNDAMPED or not any(force.damped for force in springs)

    def _refine_for_energy(self) -> None:
        memory = self._memory
        memory.refine = min(FINEST, (2.0 if self._choice.columns == 1 else 1.5) * self._choice.refine)
        self._least = memory.refine
        memory.wait = memory.interval = min(LONGEST_WAIT, 2 * memory.interval)
        self._retry(self._choice.columns, memory.refine)

    def _columns(self, part: int, t: float, start: State, economy: Economy) -> Columns:
        """The runs of a stretch; those of the first are kept over attempts with the same steps."""
        counts = step_counts(self._first, MOST_COLUMNS + 1)
        kept = self._kept
        if part == 0 and kept is not None and kept.counts == counts and kept.economy == economy:
            return kept
        columns = Columns(
            self._plan,
            start if part == 0 else self._state,
            t,
            self._stretch,
            counts,
            powers=self._book is not None and self._book.powers,
            economy=economy,
        )
        if part == 0:
            self._kept = columns
        return columns

    def _economy(self) -> Economy:
        """What the runs of the next attempt save on."""
        choice = self._choice
        if choice.columns > 1 and self._options.tolerance is not None:
            # A judgement looks at combinations of two runs more.
            most = min(choice.columns + 2, MOST_COLUMNS + 1) if choice.judge else choice.columns
            return self._economies.of_combined(self._state, amplification(most))
        # A thorough judgement alone makes steps larger again.
        refined = choice.judge and choice.refine > 1.0
        if choice.columns > 1 or choice.thorough or refined or self._options.tolerance is None:
            return THOROUGH
        return self._economies.of(self._state)

    def _retry(self, columns: int, refine: float) -> None:
        self._choice = Choice(columns, refine, self._choice.judge)

    def _error(self, columns: Columns, activity: float) -> float | None:
        """Return the stretch's estimated error [m], or None after choosing what to try next."""
        memory, choice = self._memory, self._choice
        if not choice.judge:
            if choice.columns == 1:
                estimate = self._economies.estimate(columns.economy, activity)
            else:
                fewer = columns.difference(choice.columns - 1)
                estimate = fewer * memory.ratio
                if fewer <= AIM * self._budget and not self._undamped():
                    # One column fewer would do.
                    memory.wait = 0
            if estimate <= self._budget:
                return estimate
            if choice.columns == 1 and memory.wait > 0 and hopeless(memory.error, choice.refine, self._budget):
                self._flagged += 1
                return estimate
        if choice.columns == 1 and columns.economy != THOROUGH:
            return self._judge_economy(columns, activity)
        errors = [columns.difference(k) for k in range(1, choice.columns + 1)]
        error = errors[-1]
        accepted = error <= self._budget
        most = self._options.columns
        lost = choice.columns == 1 and choice.refine >= HOPELESS and hopeless(error, choice.refine, self._budget)
        if (not accepted or choice.refine > COSTLY) and not lost:
            while len(errors) < most and errors[-1] > AIM * self._budget and not self._unresolved(errors, activity):
                errors.append(columns.difference(len(errors) + 1))
        if not accepted and (lost or (choice.refine >= FINEST and choice.columns == 1)):
            self._flagged += 1
            accepted = True
        if not accepted and choice.refine < HOPELESS and self._unresolved(errors, activity):
            # What these errors say of smaller steps is nothing to go by.
            self._remember(errors, 1, HOPELESS, activity, error)
            self._choice = Choice(1, HOPELESS, True)
            return None
        wanted, refine = cheapest(errors, choice.refine, self._budget, most)
        if wanted > 1 and self._undamped() and self._first / choice.refine > MANY_STEPS:
            # Fast waves would grow in combined runs: plain ones if smaller steps do, else smaller steps at least.
            plain = cheapest(errors[:1], choice.refine, self._budget, 1)
            wanted, refine = plain if plain[1] < 0.5 * FINEST else (wanted, max(refine, LEAST_REFINED))
        if refine >= FINEST:
            # Nothing converges here: the plain leapfrog at the smallest step at least makes no energy.
            wanted, refine = 1, HOPELESS if hopeless(errors[0], choice.refine, self._budget) else FINEST
        if not accepted and wanted == choice.columns and refine < FINEST:
            refine = max(refine, min(FINEST, 1.1 * choice.refine))
        refine = max(refine, 0.5 * choice.refine, self._least)
        self._remember(errors, wanted, refine, activity, error)
        if accepted:
            return error
        self._choice = Choice(wanted, refine, False)
        return None

    def _judge_economy(self, columns: Columns, activity: float) -> float | None:
        """As `_error`, of a run that saves on something, by one that saves on nothing but precision."""
        memory, choice = self._memory, self._choice
        error = columns.check()
        lost = error + (memory.rounding if columns.economy.narrow else 0.0)
        memory.error = error
        if columns.economy.alternate:
            memory.alternating = lost
        if lost > ALTERNATE_SHARE * self._budget:
            # Without leaving out springs, if they were; else all is found out anew.
            self._choice = Choice(choice.columns, choice.refine, True, thorough=not columns.economy.alternate)
            return None
        memory.activity = activity
        self._wait_longer(calm=True, quickly=columns.economy.alternate and lost <= QUICK * self._budget)
        return lost

    def _unresolved(self, errors: list[float], activity: float) -> bool:
        """Whether an error is not small beside the motion itself, and a column more does not even halve it."""
        last = errors[-1]
        return len(errors) > 1 and last > STALLED * errors[-2] and last > UNRESOLVED * activity * self._stretch

    def _remember(self, errors: list[float], columns: int, refine: float, activity: float, error: float) -> None:
        """Keep the judgement, scaled to the choice that follows from it."""
        memory = self._memory
        finer = self._choice.refine / refine
        memory.columns, memory.refine, memory.activity = columns, refine, activity
        memory.error = errors[columns - 1] * power(finer, columns + 1)
        if columns > 1:
            memory.ratio = min(1.0, errors[columns - 1] / errors[columns - 2] * finer) if errors[columns - 2] else 1.0
        calm = memory.error <= AIM * self._budget * 1.01 and error <= self._budget
        # Nor is there much to judge where nothing is within reach.
        calm = calm or (self._flagged > 0 and columns == 1)
        self._wait_longer(calm=calm)

    def _wait_longer(self, *, calm: bool, quickly: bool = False) -> None:
        """Put off the next judgement."""
        memory = self._memory
        if memory.error <= FAR * self._budget and memory.refine <= 1.0:
            memory.interval = min(4 * LONGEST_WAIT, 4 * memory.interval)
        else:
            memory.interval = min(LONGEST_WAIT, (4 if quickly else 2) * memory.interval) if calm else 1
        memory.wait = memory.interval
