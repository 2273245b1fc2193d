# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Work budget of a frame, in force evaluations; no clock is read."""

from __future__ import annotations

import math

from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.control.fallback import FALLBACK_EVALUATIONS, is_implicit_feasible
from cloth_sim_ros.physics.integrators.extrapolation_tableau import RATIO_SUMS
from cloth_sim_ros.physics.plan.plan import Plan


class WorkBudget:
    """Force evaluations of one advance, and their limit.

    Args:
        cap: limit of force evaluations by explicit steps; infinite for none.
        reserve: force evaluations that finish the frame after that.
        call_work: cost of the engine calls of a piece, in force evaluations.
    """

    def __init__(self, cap: float, reserve: float, call_work: float) -> None:
        self.cap, self.reserve, self.call_work = cap, reserve, call_work
        #: Force evaluations, and used work: evaluations and engine calls, in force evaluations.
        self.evaluations, self.used = 0, 0.0

    @property
    def remaining(self) -> float:
        """Remaining work, in force evaluations; negative beyond the limit."""
        return self.cap - self.used

    def fits(self, work: float) -> bool:
        """Return True if further work, in force evaluations, fits the limit."""
        return self.used + work <= self.cap

    def add(self, evaluations: int, weight: float = 1.0) -> None:
        """Add force evaluations; the weight is their cost relative to that of the limit."""
        self.evaluations, self.used = self.evaluations + evaluations, self.used + weight * evaluations

    def grant_reserve(self) -> None:
        """Grant the reserve."""
        self.cap = self.used + self.reserve


def evaluation_budget(plan: Plan, work: float, duration: float, contact_time: float = 0.0, ratio: int = 1) -> float:
    """Return the force evaluations of an advance within a work limit; infinite without a limit.

    Args:
        plan: equations of motion.
        work: limit as a multiple of real time by the plan's estimated cost; 0 for none.
        duration: of the advance [s].
        contact_time: estimated time that contact adds to a force evaluation [ns].
        ratio: multirate ratio.
    """
    if work == 0.0:
        return math.inf
    return work * duration / (1e-9 * plan.multirate_step_cost(ratio) * plan.model.particle_count + 1e-9 * contact_time)


def work_cap(
    plan: Plan,
    budget: float,
    duration: float,
    max_step: float,
    fallback_count: float,
    contact_time: float = 0.0,
    limit: float = math.inf,
) -> tuple[float, float]:
    """Return the limit of force evaluations by explicit steps, and the reserve of the fallback.

    Each consecutive fallback halves the limit of the next frame. With contact, single runs of explicit steps finish a
    frame, and the reserve is twice their work. Implicit steps would be slower, because contact couples distant
    particles in their matrix, and they have no friction.

    Args:
        plan: equations of motion.
        budget: force evaluations of the frame, see `evaluation_budget`.
        duration: of the advance [s].
        max_step: longest stable step since the last restart, without contact [s].
        fallback_count: consecutive frames with a fallback.
        contact_time: estimated time that contact adds to a force evaluation [ns].
        limit: predicted step limit with contact [s].
    """
    if budget == math.inf:
        return math.inf, math.inf
    min_cap = CONSTANTS.min_work_cap * duration / max_step
    cap = math.ldexp(budget, -int(fallback_count))
    if contact_time:
        step = CONSTANTS.stability_safety * limit
        single_run_work = CONSTANTS.estimate_trust_factor * RATIO_SUMS[2] * duration / step if limit else math.inf
        reserve = max(min(single_run_work, 0.5 * budget), min_cap)
        return math.ldexp(max(budget - reserve, reserve), -int(fallback_count)), reserve
    # Without implicit steps, explicit ones get all of the work.
    if is_implicit_feasible(plan):
        return max(cap - FALLBACK_EVALUATIONS, 0.5 * cap), FALLBACK_EVALUATIONS
    return max(cap, min_cap), FALLBACK_EVALUATIONS


def piece_call_work(plan: Plan, contact_time: float = 0.0) -> float:
    """Return the cost of the engine calls of one piece, in force evaluations: four calls for a run and its result.

    Args:
        plan: equations of motion.
        contact_time: estimated time that contact adds to a force evaluation [ns].
    """
    return 4e3 * CONSTANTS.engine_call_time / (plan.step_cost * plan.model.particle_count + contact_time)
