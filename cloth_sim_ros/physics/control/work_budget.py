# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Work budget of a frame, in force evaluations; no clock is read."""

from __future__ import annotations

import math

from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.control.fallback import FALLBACK_EVALUATIONS, is_implicit_feasible
from cloth_sim_ros.physics.control.force_jump import EVALUATIONS
from cloth_sim_ros.physics.control.stability import MAX_UNDAMPED_STEPS
from cloth_sim_ros.physics.integrators.extrapolation_tableau import RATIO_SUMS
from cloth_sim_ros.physics.plan.plan import Plan


class WorkBudget:
    """Work budget of one advance: used force evaluations, their limit, and the reserve of the fallback.

    Each consecutive fallback halves the limit of explicit attempts once more. With contact, single runs of explicit
    steps finish a frame, and the reserve is twice their work with an estimate. Implicit steps would be slower, because
    contact couples distant particles in their matrix, and they have no friction.

    Args:
        plan: equations of motion.
        work: limit as a multiple of real time by the plan's estimated cost; 0 for none.
        duration: of the advance [s].
        max_step: longest stable step since the last restart, without contact [s].
        fallback_count: consecutive frames with a fallback.
        contact_time: estimated time that contact adds to a force evaluation [ns].
        limit: predicted step limit with contact [s].
        ratio: multirate ratio.
    """

    def __init__(
        self,
        plan: Plan,
        work: float,
        duration: float,
        max_step: float,
        fallback_count: float = 0.0,
        contact_time: float = 0.0,
        limit: float = math.inf,
        ratio: int = 1,
    ) -> None:
        self._plan, self._contact_time, self._ratio = plan, contact_time, ratio
        #: Cost of a force evaluation of the present piece, relative to that of the limit.
        self.weight = 1.0
        #: Force evaluations per second of the rest of the frame, with an error estimate.
        self.rest_rate = 0.0
        count = plan.model.particle_count
        #: Force evaluations, and used work: evaluations and engine calls, in force evaluations.
        self.evaluations, self.used = 0, 0.0
        #: Cost of the engine calls of a piece, in force evaluations: four calls for a run and its result.
        self.call_work = 4e3 * CONSTANTS.engine_call_time / (plan.step_cost * count + contact_time)
        #: Limit of force evaluations, that of explicit steps, and reserve of the fallback; infinite for none.
        self.max_evaluations = self.cap = self.reserve = math.inf
        if work == 0.0:
            return
        evaluation_time = 1e-9 * plan.multirate_step_cost(ratio) * count + 1e-9 * contact_time
        self.max_evaluations, self.reserve = work * duration / evaluation_time, FALLBACK_EVALUATIONS
        budget, min_cap = self.max_evaluations, CONSTANTS.min_work_cap * duration / max_step
        self.cap = math.ldexp(budget, -int(fallback_count))
        if contact_time:
            step = CONSTANTS.stability_safety * limit
            single_run_work = CONSTANTS.estimate_trust_factor * RATIO_SUMS[2] * duration / step if limit else math.inf
            self.reserve = max(min(single_run_work, 0.5 * budget), min_cap)
            self.cap = math.ldexp(max(budget - self.reserve, self.reserve), -int(fallback_count))
        elif is_implicit_feasible(plan):
            self.cap = max(self.cap - FALLBACK_EVALUATIONS, 0.5 * self.cap)
        else:
            # Without implicit steps, explicit ones get all of the work.
            self.cap = max(self.cap, min_cap)

    def set_weight(self, ratio: int, contact_time: float) -> None:
        """Set the cost of a force evaluation of the next piece, relative to that of the limit.

        Args:
            ratio: multirate ratio.
            contact_time: estimated time that contact adds to a force evaluation of a piece [ns]. It may be more than
                what the whole frame predicted.
        """
        cost_of = self._plan.multirate_step_cost
        self.weight = 1.0 if ratio == self._ratio else cost_of(ratio) / cost_of(self._ratio)
        more_time = contact_time - self._contact_time
        if more_time > 0.0:
            particle_time = cost_of(self._ratio) * self._plan.model.particle_count
            self.weight += more_time / (particle_time + self._contact_time)

    def work_of(self, n_runs: int, steps: int, n_pieces: int) -> float:
        """Return the estimated work of runs with an error estimate, in force evaluations, engine calls included."""
        return self.weight * (steps * RATIO_SUMS[n_runs + 1] + n_pieces * (n_runs + 1)) + n_pieces * self.call_work

    def rest_of(self, time: float, n_stretches: int) -> float:
        """Return the estimated work of the remaining time [s] of a frame, in force evaluations.

        It assumes the runs and steps of the frame's start.
        """
        if time <= 0.0:
            return 0.0
        # Each stretch has at least a run of a few steps, its estimate, and the check of its ends.
        min_work = self.work_of(1, MAX_UNDAMPED_STEPS, 1) + 4 * EVALUATIONS
        return time * self.rest_rate + n_stretches * min_work

    def fits(self, work: float) -> bool:
        """Return true if further work, in force evaluations, does not exceed the limit `cap` of explicit steps."""
        return self.used + work <= self.cap

    def add(self, evaluations: int, weight: float = 1.0) -> None:
        """Count used force evaluations; the weight is their cost relative to that of the limit."""
        self.evaluations, self.used = self.evaluations + evaluations, self.used + weight * evaluations

    def grant_reserve(self) -> None:
        """Raise the limit `cap`, so that explicit steps may use the reserve of the fallback."""
        self.cap = self.used + self.reserve
