# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Choice between explicit and implicit steps by stiffness, tolerance and frame time."""

from __future__ import annotations

import math
from functools import cached_property
from typing import TYPE_CHECKING

from cloth_sim_ros.physics.book import Book
from cloth_sim_ros.physics.constants import CONSTANTS
from cloth_sim_ros.physics.control.extrapolated import Extrapolated
from cloth_sim_ros.physics.control.fallback import within_reach
from cloth_sim_ros.physics.control.leapfrog import Leapfrog
from cloth_sim_ros.physics.integrators.base import (
    WORK_LIMIT,
    Advance,
    Integrator,
    MissedError,
    UnstableError,
    refuse_boundless,
)
from cloth_sim_ros.physics.integrators.limit import leapfrog_limit
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.remembered import Choice, Hinges, Stability, restart
from cloth_sim_ros.physics.state import State

if TYPE_CHECKING:
    from cloth_sim_ros.physics.integrators.implicit import Implicit

_MISSED = "implicit steps missed the tolerance"
#: Integrators by the name that a scene gives.
INTEGRATORS = ("auto", "leapfrog", "extrapolated", "implicit", "symplectic_euler")


def make_integrator(
    name: str, *, step: float | None = None, tolerance: float | None = None, work: float = WORK_LIMIT
) -> Integrator:
    """Return an integrator by its name.

    Args:
        name: one of `INTEGRATORS`.
        step: fixed step [s]; the tolerance is then ignored.
        tolerance: of positions [m]; None for none.
        work: work limit of a frame, as a multiple of real time; 0 for no limit.

    Raises:
        ValueError: for an unknown name.
    """
    held = None if step is not None else tolerance
    if name == "auto":
        return Leapfrog(step, work=work) if step is not None else Automatic(tolerance=held, work=work)
    if name == "leapfrog":
        return Leapfrog(step, tolerance=held, work=work)
    if name == "extrapolated":
        return Extrapolated(step=step, tolerance=held, work=work)
    if name == "implicit":
        from cloth_sim_ros.physics.integrators.implicit import Implicit

        return Implicit(step, tolerance=held, work=work)
    if name == "symplectic_euler":
        from cloth_sim_ros.physics.integrators.symplectic_euler import SymplecticEuler

        return SymplecticEuler(step)
    raise ValueError(f"no integrator '{name}'; there are {', '.join(INTEGRATORS)}")


class Automatic(Integrator):
    """Explicit steps while they achieve real time, otherwise the implicit method if it is cheaper.

    The explicit method is the extrapolated leapfrog, which is the plain leapfrog for a loose tolerance or none. Costs
    are estimates from step limit, particle count and width of the implicit matrix; no clock is read.

    Args:
        tolerance: of positions [m], see docs/time_stepping.md; None for the stability limit alone.
        work: work limit of a frame, as a multiple of real time by the plan's estimated cost; 0 for no limit.
    """

    name = "auto"
    order = 2
    suits = "any scene"

    def __init__(self, *, tolerance: float | None = None, work: float = WORK_LIMIT) -> None:
        self.tolerance, self.work = tolerance, work
        self._explicit = Leapfrog(work=work) if tolerance is None else Extrapolated(tolerance=tolerance, work=work)

    @cached_property
    def _implicit(self) -> Implicit:
        """The implicit method, created at its first use: most scenes never need it."""
        from cloth_sim_ros.physics.integrators.implicit import Implicit

        return Implicit(tolerance=self.tolerance, work=self.work)

    def step_limit(self, omega2: float, damping_rate: float) -> float:
        return math.inf

    def advance(self, plan: Plan, state: State, t: float, duration: float, book: Book | None = None) -> Advance:
        memory = Choice.of(state)
        self._choose(memory, plan, state, t, duration)
        memory.wait -= 1.0
        done, missed = None, ""
        if memory.implicit:
            start = state.share()
            strict = not memory.vain and self._within_work(memory.explicit, duration)
            try:
                done = self._implicit.advance(plan, state, t, duration, book, strict=strict)
                spent = done.evaluations
                if done.flagged and strict:
                    done, missed = None, _MISSED
            except UnstableError as error:
                missed = _MISSED if isinstance(error, MissedError) else "implicit steps found no way through this fold"
                spent = error.evaluations
            if done is None:
                if plan.contact is not None:
                    # A fold stays stiff for some frames: the cost of the attempt decides when the next one pays.
                    memory.cost = max(memory.cost, spent * _iteration(plan))
                # Explicit steps have a solution at any small enough step size.
                state.restore(start)
                memory.implicit, memory.wait = 0.0, CONSTANTS.wait
        if done is None:
            done = self._explicit.advance(plan, state, t, duration, book)
            if missed and done.flagged and within_reach(plan):
                # Both methods miss the tolerance: the cheaper one is used until the next comparison.
                memory.implicit = memory.vain = 1.0
        elif memory.implicit:
            cost = done.evaluations * _iteration(plan)
            # The mean avoids a change because of one repeated frame.
            memory.cost = 0.5 * (memory.cost + cost) if memory.cost else cost
        memory.store(state)
        if missed:
            why = f"{missed}, explicit ones may not hold real time"
        elif memory.implicit:
            why = "too stiff for explicit steps in real time"
        else:
            why = "explicit steps are cheaper" if memory.cost else "explicit steps are affordable"
        # `_replace` is slower, and every frame runs this line.
        return Advance(*done[:-1], reason=f"auto: {why}; {done.reason}")

    def _within_work(self, cost: float, duration: float) -> bool:
        """True if a frame of a cost [ns] fits the work limit."""
        return self.work == 0.0 or cost <= self.work * duration * 1e9

    def _choose(self, memory: Choice, plan: Plan, state: State, t: float, duration: float) -> None:
        """Compare the costs of both methods periodically, and at once if the implicit method becomes expensive."""
        if memory.wait > 0.0 and not (memory.implicit and memory.cost > CONSTANTS.trust * memory.explicit):
            return
        memory.explicit, memory.vain = _explicit_frame(plan, state, t, duration), 0.0
        if plan.contact is not None and not memory.implicit:
            # The contact that made implicit steps expensive may have ended.
            memory.cost *= 0.5
        better = memory.explicit > CONSTANTS.aim * duration * 1e9 and within_reach(plan)
        if better:
            implicit = memory.cost or _first(plan)
            better = implicit <= (CONSTANTS.trust if memory.implicit else 1.0) * memory.explicit
        if better != bool(memory.implicit):
            restart(state)
        memory.implicit, memory.wait = float(better), CONSTANTS.wait


def _explicit_frame(plan: Plan, state: State, t: float, duration: float) -> float:
    """Return the estimated cost of a frame by explicit steps at the stability limit [ns].

    The estimate ignores accuracy: a motion that requires explicit steps below the stability limit is too fast for large
    implicit steps.
    """
    known = Stability.of(state)
    rates = (known.omega2, known.damping) if known.omega2 >= 0.0 else plan.rates(state.x)
    refuse_boundless(*rates)
    steps = max(1.0, duration / (CONSTANTS.safety * leapfrog_limit(*rates)))
    cost = steps * plan.cost(int(Hinges.of(state).every)) * plan.model.particle_count
    return cost + steps * plan.contact_cost(t, duration, state)


def _first(plan: Plan) -> float:
    """Return the estimated cost of the first frame by the implicit method [ns]."""
    from cloth_sim_ros.physics.integrators.implicit_run import EXPECTED_ITERATIONS

    return EXPECTED_ITERATIONS * _iteration(plan)


def _iteration(plan: Plan) -> float:
    """Return the estimated cost of one iteration of the implicit method [ns]; most scenes never need it."""
    from cloth_sim_ros.physics.integrators.stage_matrix import iteration_cost

    return iteration_cost(plan.model)
