# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The choice of integrator and step, from the scene's stiffness, the tolerance and the frame time."""

from __future__ import annotations

import math
from functools import cached_property

import attrs
import numpy as np

from cloth_sim_ros.physics.assembly import NUMPY_FORCE
from cloth_sim_ros.physics.book import Book
from cloth_sim_ros.physics.control.control import Memory
from cloth_sim_ros.physics.control.last_resort import within_reach
from cloth_sim_ros.physics.integrators.base import CHOICE, Advance, Integrator, UnstableError, restart
from cloth_sim_ros.physics.integrators.extrapolated import Extrapolated
from cloth_sim_ros.physics.integrators.fixed import SAFETY
from cloth_sim_ros.physics.integrators.leapfrog import Leapfrog
from cloth_sim_ros.physics.integrators.limit import leapfrog_limit
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.state import State

#: Integrators by the name that a scene gives.
INTEGRATORS = ("auto", "leapfrog", "extrapolated", "implicit", "symplectic_euler")

#: Cost of one multiply-add in the two-threaded factorisation of the implicit method's matrix [ns]. Measured once; a
#: constant, so that the choice is the same on any machine.
MULTIPLY_ADD = 0.35
#: Newton iterations of an implicit frame that is held to a tolerance, as a rule: two steps.
ITERATIONS = 10.0
#: Explicit steps are kept while they cost less than this share of real time: they follow what implicit ones damp out.
AFFORDABLE = 0.5
#: Frames between two comparisons.
REVIEW = 30
#: A change has to pay by this factor: the two would else take turns.
_DEAR = 1.5


def make_integrator(name: str, *, step: float | None = None, tolerance: float | None = None) -> Integrator:
    """Return an integrator by its name; with a fixed step no tolerance is held.

    Raises:
        ValueError: for an unknown name.
    """
    held = None if step is not None else tolerance
    if name == "auto":
        return Leapfrog(step) if step is not None else Automatic(tolerance=held)
    if name == "leapfrog":
        return Leapfrog(step, tolerance=held)
    if name == "extrapolated":
        return Extrapolated(step=step, tolerance=held)
    if name == "implicit":
        from cloth_sim_ros.physics.integrators.implicit import Implicit

        return Implicit(step, tolerance=held)
    if name == "symplectic_euler":
        from cloth_sim_ros.physics.integrators.symplectic_euler import SymplecticEuler

        return SymplecticEuler(step)
    raise ValueError(f"no integrator '{name}'; there are {', '.join(INTEGRATORS)}")


@attrs.define
class Choice:
    """What the choice rests on from frame to frame."""

    #: 0 explicit, 1 implicit.
    implicit: float = 0.0
    #: Cost of an implicit frame when last run [ns]; 0 unknown.
    cost: float = 0.0
    #: Frames until the next comparison.
    wait: float = 0.0
    #: Cost of an explicit frame at the stability limit when last compared [ns].
    explicit: float = 0.0
    #: What one cost that missed the tolerance none the less [ns].
    vain: float = 0.0

    @classmethod
    def of(cls, state: State) -> Choice:
        stored = state.memory.get(CHOICE)
        return cls() if stored is None else cls(*stored.tolist())

    def store(self, state: State) -> None:
        state.memory[CHOICE] = np.array((self.implicit, self.cost, self.wait, self.explicit, self.vain))


class Automatic(Integrator):
    """Explicit steps where they can hold real time, the implicit method where it is cheaper then.

    Explicit is the extrapolated leapfrog, which is the plain leapfrog while the tolerance is loose or none is set.
    Costs are estimates from the step limit, the particle count and the width of the implicit matrix; no clock is
    read.

    Args:
        tolerance: target of the largest particle position error at frames [m]; None holds the stability limit alone.
    """

    name = "auto"
    order = 2
    evaluations_per_step = 1
    suits = "any scene"

    def __init__(self, *, tolerance: float | None = None) -> None:
        self.tolerance = tolerance
        self._explicit = Leapfrog() if tolerance is None else Extrapolated(tolerance=tolerance)

    @cached_property
    def _implicit(self) -> Integrator:
        """The implicit method, which most scenes never come to."""
        return make_integrator("implicit", tolerance=self.tolerance)

    def step_limit(self, omega2: float, damping_rate: float) -> float:
        return math.inf

    def advance(self, plan: Plan, state: State, t: float, duration: float, book: Book | None = None) -> Advance:
        memory = Choice.of(state)
        self._choose(memory, plan, state, duration)
        memory.wait -= 1.0
        stuck = False
        if memory.implicit:
            start = state.share()
            try:
                done = self._implicit.advance(plan, state, t, duration, book)
            except UnstableError:
                # Its iterations find no way through some folds; explicit steps only need to be short enough.
                state.restore(start)
                memory.implicit, stuck = 0.0, True
                done = self._explicit.advance(plan, state, t, duration, book)
        else:
            done = self._explicit.advance(plan, state, t, duration, book)
        if memory.implicit:
            cost = done.evaluations * _implicit_iteration(plan)
            # A single frame that had to be repeated is no reason to change.
            memory.cost = 0.8 * memory.cost + 0.2 * cost if memory.cost else cost
        elif done.flagged:
            cost = done.evaluations * plan.step_cost * plan.model.particle_count
            if cost > AFFORDABLE * duration * 1e9:
                # Small steps that miss the tolerance are worth no more than large ones that do.
                memory.vain, memory.wait = cost, 0.0
        memory.store(state)
        if stuck:
            why = "implicit steps found no way through this fold, explicit ones may not hold real time"
        elif memory.implicit:
            why = "too stiff for explicit steps in real time"
        else:
            why = "explicit steps are cheaper" if memory.cost else "explicit steps are affordable"
        return done._replace(reason=f"auto: {why}; {done.reason}")

    def _choose(self, memory: Choice, plan: Plan, state: State, duration: float) -> None:
        """Compare costs, from time to time and whenever the implicit method turns out dear."""
        if memory.wait > 0.0 and not (memory.implicit and memory.cost > _DEAR * memory.explicit):
            return
        memory.explicit = max(_explicit_frame(plan, state, duration), memory.vain)
        # Before long it is tried again.
        memory.vain *= 0.5
        better = memory.explicit > AFFORDABLE * duration * 1e9 and within_reach(plan)
        if better:
            implicit = memory.cost or ITERATIONS * _implicit_iteration(plan)
            better = implicit <= (_DEAR if memory.implicit else 1.0) * memory.explicit
        if better != bool(memory.implicit):
            restart(state)
        memory.implicit, memory.wait = float(better), float(REVIEW)


def _explicit_frame(plan: Plan, state: State, duration: float) -> float:
    """Estimated cost of a frame by explicit steps at the stability limit [ns].

    What accuracy asks for on top of that is not counted: a motion that makes explicit steps smaller than stability
    does is too lively for large implicit ones.
    """
    stepper = Memory.of(state)
    if stepper.omega2 < 0.0:
        stepper = Memory()
        stepper.omega2, stepper.damping = plan.rates(state.x)
    limit = SAFETY * leapfrog_limit(stepper.omega2, stepper.damping)
    steps = max(1.0, duration / limit)
    return steps * plan.step_cost * plan.model.particle_count


def _implicit_iteration(plan: Plan) -> float:
    """Estimated cost of one iteration of the implicit method [ns]."""
    from cloth_sim_ros.physics.integrators.stage_matrix import stage_matrix

    rows, width = stage_matrix(plan.model).size
    return MULTIPLY_ADD * 4.5 * rows * width * width + NUMPY_FORCE * plan.model.particle_count
