# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Context of an advance: rules, limits and work counters that its intervals share."""

from __future__ import annotations

from collections.abc import Callable

import attrs

from cloth_sim_ros.physics.book import Book
from cloth_sim_ros.physics.control.choice import Choice, Options
from cloth_sim_ros.physics.control.energy import EnergyRule, put_in
from cloth_sim_ros.physics.control.fallback import FINISHED, within_reach
from cloth_sim_ros.physics.control.hinges import HingeRule
from cloth_sim_ros.physics.control.precision import PrecisionRule
from cloth_sim_ros.physics.control.touch import TouchRule
from cloth_sim_ros.physics.integrators.columns import Columns, Ran
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.remembered import Stability
from cloth_sim_ros.physics.state import State


@attrs.define(kw_only=True, eq=False)
class Effort:
    """Rules, limits and work counters of one advance, shared by its intervals."""

    options: Options
    plan: Plan
    state: State
    book: Book | None
    stability: Stability
    energy: EnergyRule
    precision: PrecisionRule
    hinges: HingeRule
    touch: TouchRule
    #: Length of the advance [s].
    duration: float
    #: Limit of force evaluations, and the cost of the engine calls of one part, in force evaluations.
    cap: float
    part_cost: float
    #: True if contact is possible during the advance.
    touches: bool
    #: Force evaluations; cost of the engine calls of all parts, in force evaluations; rejected attempts.
    evaluations: int = 0
    calls: float = 0.0
    rejected: int = 0
    #: True if the work limit allows no finer steps; if explicit steps are abandoned; if a run used single precision.
    spent: bool = False
    lost: bool = False
    narrow: bool = False
    #: True while the reserve finishes the advance.
    finishing: bool = False
    #: A run that exists at the start of the advance.
    ran: Ran | None = None

    def affords(self, work: float) -> bool:
        """True if further work, in force evaluations, fits the limit."""
        return self.evaluations + self.calls + work <= self.cap

    @property
    def gives_way(self) -> bool:
        """True if a fallback can finish the advance after explicit steps are abandoned."""
        return self.may_finish or within_reach(self.plan)

    @property
    def may_finish(self) -> bool:
        """True if explicit steps within the reserve are the fallback."""
        return self.touches and self.options.tolerance is not None and not self.finishing

    def makes_energy(self, columns: Columns, choice: Choice, times: tuple[float, float], step: float) -> bool:
        """True if a choice of runs creates energy.

        Args:
            columns: runs.
            choice: the runs to combine.
            times: start and end [s].
            step: step size of a single run [s], with which its energy oscillates; 0 for several step sizes.
        """
        state, contact, end = self.state, self.plan.contact, self.state.share()
        columns.pass_on(choice.columns, end)
        work, evaluations = put_in(self.plan, state, columns, times[0], choice.columns)
        self.evaluations += evaluations
        exceeds = self.energy.exceeds((times[0], state), (times[1], end), step, work, refine=choice.refine)
        if contact is not None:
            contact.take(state)
        return exceeds

    def fewer(self, columns: int, needed: Callable[[int], float]) -> int:
        """Return the number of runs to combine.

        With contact it is reduced until the work fits, because fewer runs are cheaper and more accurate than implicit
        steps.
        """
        while self.touches and columns > 1 and not self.affords(needed(columns)):
            columns -= 1
        return columns

    def fitted(self, choice: Choice, work: Callable[[int, float], float], ahead: float, kept: int = 0) -> Choice:
        """Clamp a choice to the remaining work.

        Explicit steps are abandoned if the longest stable ones exceed the limit by more than the cost of implicit steps
        that finish the frame.

        Args:
            choice: wanted runs and refinement.
            work: returns the force evaluations of a number of runs at a refinement.
            ahead: force evaluations reserved for later intervals.
            kept: force evaluations already done, reusable for the same refinement.
        """
        if self.options.tolerance is None:
            # The order is fixed, and there is no error estimate.
            return choice
        columns = self.fewer(choice.columns, lambda count: ahead + work(count, 1.0))
        choice = Choice(columns, choice.refine, choice.judge or columns < choice.columns)
        needed = work(columns, choice.refine)
        if self.affords(ahead + needed - kept):
            return choice
        left = self.cap - self.evaluations - self.calls - ahead
        refine = max(1.0, choice.refine * left / needed)
        # Rounding up steps and parts may exceed the remaining work.
        while refine > 1.0 and work(choice.columns, refine) > left + FINISHED:
            refine = max(1.0, 0.5 * refine)
        self.spent = True
        done = kept if refine == choice.refine else 0
        self.lost = work(choice.columns, refine) > left + done + FINISHED and self.gives_way
        return Choice(choice.columns, refine, True)
