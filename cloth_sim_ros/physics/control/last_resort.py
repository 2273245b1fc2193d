# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is left where no explicit step within reach follows the motion: steps that make no energy, whatever they miss.

Some forces grow beyond all bounds next to a place where they are not defined, as S8's does where its two lines become
parallel. A motion that meets such a place is kicked by whatever the step makes of it. The implicit method's last
resort only goes where the energy falls.
"""

from __future__ import annotations

import math

from cloth_sim_ros.physics.book import Book
from cloth_sim_ros.physics.control.control import HOPELESS, Memory
from cloth_sim_ros.physics.integrators.base import Advance, UnstableError
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.state import State

#: Sheets of more particles are always stepped explicitly: one implicit frame would take half a minute and gigabytes.
MOST_IMPLICIT = 50_000


def within_reach(plan: Plan) -> bool:
    """Whether the implicit method comes into question for a sheet of this size."""
    return plan.model.particle_count <= MOST_IMPLICIT


def last_resort(plan: Plan, state: State, t: float, duration: float, book: Book | None, *, instead_of: str) -> Advance:
    """Advance by implicit steps; at least one is flagged.

    Args:
        plan: equations of motion.
        state: advanced in place.
        t: time at the start [s].
        duration: time to advance [s].
        book: notes the motion.
        instead_of: name of the integrator whose steps made energy.

    Raises:
        UnstableError: if the motion does not stay finite.
    """
    if not math.isfinite(plan.energy(t, state.x, state.v)):
        raise UnstableError(f"{instead_of}: not finite even by the smallest steps, from a motion without finite energy")
    from cloth_sim_ros.physics.integrators.implicit import Implicit
    from cloth_sim_ros.physics.integrators.implicit_run import LAST_STEPS

    memory = Memory.of(state)
    done = Implicit(duration / LAST_STEPS).advance(plan, state, t, duration, book)
    # What was known of the motion is true no longer; what follows is tried where it can make no energy either.
    memory.columns, memory.refine, memory.wait, memory.interval, memory.made = 1, HOPELESS, 0, 1, 0.0
    memory.omega2, memory.damping = plan.rates(state.x)
    memory.store(state)
    why = f"{instead_of}: springs made energy even by the smallest steps"
    return done._replace(
        flagged=max(1, done.flagged), reason=f"{why}: implicit, order 2, step {done.step:.3g} s for this frame"
    )
