# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What all stretches of an advance share: what they work with, and the work that they have done."""

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
    """Of one advance."""

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
    #: Most force evaluations, and what the calls of one part cost, in force evaluations.
    cap: float
    part_cost: float
    #: Whether anything may touch the cloth.
    touches: bool
    #: Force evaluations; what the calls of all parts cost, in force evaluations; attempts that did not hold.
    evaluations: int = 0
    calls: float = 0.0
    rejected: int = 0
    #: Whether nothing finer is tried any more, whether explicit steps are given up, and whether a run was in single
    #: precision.
    spent: bool = False
    lost: bool = False
    narrow: bool = False
    #: Whether what was left over finishes the advance.
    finishing: bool = False
    #: A run that is there from the start.
    ran: Ran | None = None

    def affords(self, work: float) -> bool:
        """Whether so many force evaluations more fit the cap."""
        return self.evaluations + self.calls + work <= self.cap

    @property
    def gives_way(self) -> bool:
        """Whether something else finishes the advance where explicit steps are given up."""
        return self.may_finish or within_reach(self.plan)

    @property
    def may_finish(self) -> bool:
        """Whether explicit steps do that themselves, by what was left over."""
        return self.touches and self.options.tolerance is not None and not self.finishing

    def makes_energy(self, columns: Columns, choice: Choice, times: tuple[float, float], step: float) -> bool:
        """Whether a choice of runs between two times [s] makes energy from nowhere; that of one swings by its step."""
        state, contact, end = self.state, self.plan.contact, self.state.share()
        columns.pass_on(choice.columns, end)
        work, evaluations = put_in(self.plan, state, columns, times[0], choice.columns)
        self.evaluations += evaluations
        exceeds = self.energy.exceeds((times[0], state), (times[1], end), step, work, refine=choice.refine)
        if contact is not None:
            contact.take(state)
        return exceeds

    def fewer(self, columns: int, needed: Callable[[int], float]) -> int:
        """Return how many runs to combine. Where the cloth touches it is as many as fit: fewer of them do better than
        implicit steps, and take less.
        """
        while self.touches and columns > 1 and not self.affords(needed(columns)):
            columns -= 1
        return columns

    def fitted(self, choice: Choice, work: Callable[[int, float], float], ahead: float, kept: int = 0) -> Choice:
        """Return what fits the cap of a choice whose work is told, with so much ahead, and so much of it done already
        where it stays as it is. Explicit steps are given up where the longest stable ones exceed the cap by more than
        implicit ones take to finish the frame.
        """
        if self.options.tolerance is None:
            # A fixed order, and no error to judge.
            return choice
        columns = self.fewer(choice.columns, lambda count: ahead + work(count, 1.0))
        choice = Choice(columns, choice.refine, choice.judge or columns < choice.columns)
        needed = work(columns, choice.refine)
        if self.affords(ahead + needed - kept):
            return choice
        left = self.cap - self.evaluations - self.calls - ahead
        refine = max(1.0, choice.refine * left / needed)
        # Whole numbers of steps and parts may take more than their share.
        while refine > 1.0 and work(choice.columns, refine) > left + FINISHED:
            refine = max(1.0, 0.5 * refine)
        self.spent = True
        done = kept if refine == choice.refine else 0
        self.lost = work(choice.columns, refine) > left + done + FINISHED and self.gives_way
        return Choice(choice.columns, refine, True)
