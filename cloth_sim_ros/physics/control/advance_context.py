# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Context of an advance: rules, limits and work counters that its intervals share."""

from __future__ import annotations

from collections.abc import Callable

import attrs

from cloth_sim_ros.physics.accounting.work_accumulator import WorkAccumulator
from cloth_sim_ros.physics.control.contact_step_limit import ContactStepLimit
from cloth_sim_ros.physics.control.energy import EnergyRule, external_work
from cloth_sim_ros.physics.control.fallback import FALLBACK_EVALUATIONS, is_implicit_feasible
from cloth_sim_ros.physics.control.multirate import MultirateRule
from cloth_sim_ros.physics.control.precision import PrecisionRule
from cloth_sim_ros.physics.control.step_choice import ExplicitSettings, StepChoice
from cloth_sim_ros.physics.integrators.extrapolation_tableau import ExtrapolationTableau, PrecomputedRun
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.plan.runs import History
from cloth_sim_ros.physics.state.controller_state import StabilityState
from cloth_sim_ros.physics.state.state import State


@attrs.define(kw_only=True, eq=False)
class AdvanceContext:
    """Rules, limits and work counters of one advance, shared by its intervals."""

    options: ExplicitSettings
    plan: Plan
    state: State
    accumulator: WorkAccumulator | None
    stability: StabilityState
    energy: EnergyRule
    precision: PrecisionRule
    multirate: MultirateRule
    contact_limit: ContactStepLimit
    #: Length of the advance [s].
    duration: float
    #: Limit of force evaluations, and the cost of the engine calls of one part, in force evaluations.
    max_evaluations: float
    part_call_work: float
    #: True if contact is possible during the advance.
    may_touch: bool
    #: Force evaluations; cost of the engine calls of all parts, in force evaluations; rejected attempts.
    evaluations: int = 0
    call_work: float = 0.0
    rejected: int = 0
    #: True if the work limit allows no finer steps; if explicit steps are abandoned; if a run used single precision.
    exhausted: bool = False
    abandoned: bool = False
    single_precision: bool = False
    #: True while the reserve finishes the advance.
    in_fallback: bool = False
    #: Velocities of previous intervals; None for none.
    history: History | None = None
    #: A run that exists at the start of the advance.
    precomputed_run: PrecomputedRun | None = None

    def fits_budget(self, work: float) -> bool:
        """True if further work, in force evaluations, fits the limit."""
        return self.evaluations + self.call_work + work <= self.max_evaluations

    @property
    def has_fallback(self) -> bool:
        """True if a fallback can finish the advance after explicit steps are abandoned."""
        return self.has_explicit_fallback or is_implicit_feasible(self.plan)

    @property
    def has_explicit_fallback(self) -> bool:
        """True if explicit steps within the reserve are the fallback."""
        return self.may_touch and self.options.tolerance is not None and not self.in_fallback

    def creates_energy(
        self, tableau: ExtrapolationTableau, choice: StepChoice, times: tuple[float, float], step: float
    ) -> bool:
        """True if a choice of runs creates energy.

        Args:
            tableau: runs.
            choice: the runs to combine.
            times: start and end [s].
            step: step size of a single run [s], with which its energy oscillates; 0 for several step sizes.
        """
        state, contact, end = self.state, self.plan.contact, self.state.shallow_copy()
        tableau.commit(choice.n_runs, end)
        work, evaluations = external_work(self.plan, state, tableau, times[0], choice.n_runs)
        self.evaluations += evaluations
        exceeds = self.energy.exceeds_gain((times[0], state), (times[1], end), step, work, refinement=choice.refinement)
        if contact is not None:
            contact.load_state(state)
        return exceeds

    def reduce_runs(self, n_runs: int, estimate_work: Callable[[int], float]) -> int:
        """Return the number of runs to combine.

        With contact it is reduced until the work fits, because fewer runs are cheaper and more accurate than implicit
        steps.
        """
        while self.may_touch and n_runs > 1 and not self.fits_budget(estimate_work(n_runs)):
            n_runs -= 1
        return n_runs

    def clamp(
        self, choice: StepChoice, estimate_work: Callable[[int, float], float], reserved: float, reusable: int = 0
    ) -> StepChoice:
        """Clamp a choice to the remaining work.

        Explicit steps are abandoned if the longest stable ones exceed the limit by more than the cost of implicit steps
        that finish the frame.

        Args:
            choice: wanted runs and refinement.
            estimate_work: returns the force evaluations of a number of runs at a refinement.
            reserved: force evaluations reserved for later intervals.
            reusable: force evaluations already done, reusable for the same refinement.
        """
        if self.options.tolerance is None:
            # The order is fixed, and there is no error estimate.
            return choice
        n_runs = self.reduce_runs(choice.n_runs, lambda count: reserved + estimate_work(count, 1.0))
        choice = StepChoice(n_runs, choice.refinement, choice.estimates_error or n_runs < choice.n_runs)
        work = estimate_work(n_runs, choice.refinement)
        if self.fits_budget(reserved + work - reusable):
            return choice
        remaining = self.max_evaluations - self.evaluations - self.call_work - reserved
        refinement = max(1.0, choice.refinement * remaining / work)
        # Rounding up steps and parts may exceed the remaining work.
        while refinement > 1.0 and estimate_work(choice.n_runs, refinement) > remaining + FALLBACK_EVALUATIONS:
            refinement = max(1.0, 0.5 * refinement)
        self.exhausted = True
        reused = reusable if refinement == choice.refinement else 0
        work = estimate_work(choice.n_runs, refinement)
        self.abandoned = work > remaining + reused + FALLBACK_EVALUATIONS and self.has_fallback
        return StepChoice(choice.n_runs, refinement, True)
