# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Choice between explicit and implicit steps by stiffness, tolerance and frame time."""

from __future__ import annotations

import math
from functools import cached_property
from typing import TYPE_CHECKING

from cloth_sim_ros.physics.accounting.work_accumulator import WorkAccumulator
from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.control.extrapolated import Extrapolated
from cloth_sim_ros.physics.control.fallback import is_implicit_feasible
from cloth_sim_ros.physics.control.leapfrog import Leapfrog
from cloth_sim_ros.physics.integrators import base
from cloth_sim_ros.physics.integrators.base import Advance, Integrator
from cloth_sim_ros.physics.integrators.limit import leapfrog_limit
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.state import controller_state
from cloth_sim_ros.physics.state.controller_state import IntegratorChoiceState, MultirateState, StabilityState
from cloth_sim_ros.physics.state.state import State

if TYPE_CHECKING:
    from cloth_sim_ros.physics.integrators.implicit import Implicit

_TOLERANCE_MISSED = "implicit steps missed the tolerance"
_NO_SOLUTION = "implicit steps found no way through this fold"
#: Expected iterations of the first frame by the implicit method: two stages of five.
_FIRST_ITERATIONS = 10
#: Integrators by the name that a scene gives.
INTEGRATORS = ("auto", "leapfrog", "extrapolated", "implicit", "symplectic_euler")


def make_integrator(
    name: str, *, step: float | None = None, tolerance: float | None = None, work: float = 0.0
) -> Integrator:
    """Return a new integrator by name, with a step [s], or else a tolerance [m], and a work limit; refuse other names.

    Args:
        name: one of `INTEGRATORS`.
        step: fixed step [s]; the tolerance is then ignored.
        tolerance: of positions [m]; None for none.
        work: work limit of a frame, as a multiple of real time; 0 for no limit.

    Raises:
        ValueError: for an unknown name.
    """
    active_tolerance = None if step is not None else tolerance
    if name == "auto":
        return Leapfrog(step, work=work) if step is not None else Automatic(tolerance=active_tolerance, work=work)
    if name == "leapfrog":
        return Leapfrog(step, tolerance=active_tolerance, work=work)
    if name == "extrapolated":
        return Extrapolated(step=step, tolerance=active_tolerance, work=work)
    if name == "implicit":
        from cloth_sim_ros.physics.integrators.implicit import Implicit

        return Implicit(step, tolerance=active_tolerance, work=work)
    if name == "symplectic_euler":
        from cloth_sim_ros.physics.integrators.symplectic_euler import SymplecticEuler

        return SymplecticEuler(step)
    raise ValueError(f"no integrator '{name}'; there are {', '.join(INTEGRATORS)}")


class Automatic(Integrator):
    """Integrator `auto`: explicit steps while they achieve real time, else the implicit method if it is cheaper.

    The explicit method is the extrapolated leapfrog, which is the plain leapfrog for a loose tolerance or none. Costs
    are estimates from step limit, particle count and width of the implicit matrix; no clock is read.

    Args:
        tolerance: of positions [m], see docs/time_stepping.md; None for the stability limit alone.
        work: work limit of a frame, as a multiple of real time by the plan's estimated cost; 0 for no limit.
    """

    name = "auto"
    order = 2
    suits = "any scene"

    def __init__(self, *, tolerance: float | None = None, work: float = 0.0) -> None:
        self.tolerance, self.work = tolerance, work
        self._explicit = Leapfrog(work=work) if tolerance is None else Extrapolated(tolerance=tolerance, work=work)

    @cached_property
    def _implicit(self) -> Implicit:
        """The implicit method, created at its first use: most scenes never need it."""
        from cloth_sim_ros.physics.integrators.implicit import Implicit

        return Implicit(tolerance=self.tolerance, work=self.work)

    def step_limit(self, omega2: float, damping_rate: float) -> float:
        return math.inf

    def advance(
        self, plan: Plan, state: State, t: float, duration: float, accumulator: WorkAccumulator | None = None
    ) -> Advance:
        memory = IntegratorChoiceState.load(state)
        self._choose_integrator(memory, plan, state, t, duration)
        memory.frames_until_comparison -= 1.0
        result, failure = None, ""
        if memory.is_implicit:
            start = state.shallow_copy()
            fits = not self.work or memory.explicit_cost <= self.work * duration * 1e9
            strict = fits and not memory.explicit_also_failed
            try:
                result = self._implicit.advance(plan, state, t, duration, accumulator, is_strict=strict)
                evaluations = result.evaluations
                if result.flagged and strict:
                    result, failure = None, _TOLERANCE_MISSED
            except base.UnstableError as error:
                failure = _TOLERANCE_MISSED if isinstance(error, base.ToleranceMissedError) else _NO_SOLUTION
                evaluations = error.evaluations
            if result is None:
                if plan.contact is not None:
                    # A fold stays stiff for some frames: the cost of the attempt decides when the next one pays.
                    memory.implicit_cost = max(memory.implicit_cost, evaluations * _iteration_cost(plan))
                # Explicit steps have a solution at any small enough step size.
                state.restore(start)
                memory.is_implicit, memory.frames_until_comparison = 0.0, CONSTANTS.comparison_period
        if result is None:
            result = self._explicit.advance(plan, state, t, duration, accumulator)
            if failure and result.flagged and is_implicit_feasible(plan):
                # Both methods miss the tolerance: the cheaper one is used until the next comparison.
                memory.is_implicit = memory.explicit_also_failed = 1.0
        else:
            cost = result.evaluations * _iteration_cost(plan)
            # The mean avoids a change because of one repeated frame.
            memory.implicit_cost = 0.5 * (memory.implicit_cost + cost) if memory.implicit_cost else cost
        memory.store(state)
        if failure:
            explanation = f"{failure}, explicit ones may not hold real time"
        elif memory.is_implicit:
            explanation = "too stiff for explicit steps in real time"
        else:
            explanation = "explicit steps are cheaper" if memory.implicit_cost else "explicit steps are affordable"
        # `_replace` is slower, and every frame runs this line.
        return Advance._make((*result[:-1], f"auto: {explanation}; {result.reason}"))

    def _choose_integrator(
        self, memory: IntegratorChoiceState, plan: Plan, state: State, t: float, duration: float
    ) -> None:
        """Write explicit or implicit steps into `memory`, by periodic comparison; a change resets step control.

        They are compared at once if the implicit method becomes expensive, or if the cloth comes close to itself.
        """
        if memory.frames_until_comparison > 0.0:
            is_expensive = memory.implicit_cost > CONSTANTS.estimate_trust_factor * memory.explicit_cost
            if not memory.is_implicit or (not is_expensive and _is_clear_of_itself(plan, state, duration)):
                return
        memory.explicit_cost, memory.explicit_also_failed = _explicit_frame_cost(plan, state, t, duration), 0.0
        if plan.contact is not None and not memory.is_implicit:
            # The contact that made implicit steps expensive may have ended.
            memory.implicit_cost *= 0.5
        target_cost = CONSTANTS.error_target_fraction * duration * 1e9
        implicit_pays = memory.explicit_cost > target_cost and is_implicit_feasible(plan)
        # Implicit steps find no way through a fold.
        implicit_pays = implicit_pays and _is_clear_of_itself(plan, state, duration)
        if implicit_pays:
            implicit_cost = memory.implicit_cost or _FIRST_ITERATIONS * _iteration_cost(plan)
            factor = CONSTANTS.estimate_trust_factor if memory.is_implicit else 1.0
            implicit_pays = implicit_cost <= factor * memory.explicit_cost
        if implicit_pays != bool(memory.is_implicit):
            controller_state.reset_step_control(state)
        memory.is_implicit, memory.frames_until_comparison = float(implicit_pays), CONSTANTS.comparison_period


def _is_clear_of_itself(plan: Plan, state: State, duration: float) -> bool:
    """Return true if layers of the cloth can't meet within a duration [s]."""
    return plan.contact is None or plan.contact.is_clear_of_itself(duration, state.x, state.v)


def _explicit_frame_cost(plan: Plan, state: State, t: float, duration: float) -> float:
    """Return the estimated cost of a frame by explicit steps at the stability limit [ns], or raise UnstableError.

    The estimate ignores accuracy: a motion that requires explicit steps below the stability limit is too fast for large
    implicit steps.
    """
    stability = StabilityState.load(state)
    bounds = (stability.omega2, stability.damping) if stability.omega2 >= 0.0 else plan.spectral_bounds(state.x)
    base.refuse_unbounded(*bounds)
    steps = max(1.0, duration / (CONSTANTS.stability_safety * leapfrog_limit(*bounds)))
    cost = steps * plan.multirate_step_cost(int(MultirateState.load(state).ratio)) * plan.model.particle_count
    return cost + steps * plan.contact_cost(t, duration, state)


def _iteration_cost(plan: Plan) -> float:
    """Return the estimated cost of one iteration of the implicit method [ns]; imported late, as few scenes need it."""
    from cloth_sim_ros.physics.integrators.stage_matrix import iteration_cost

    return iteration_cost(plan.model)
