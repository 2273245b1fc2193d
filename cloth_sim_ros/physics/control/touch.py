# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The rule of contact: what it adds to the step limit before it touches and after, and when it is judged anew."""

from __future__ import annotations

import math

from cloth_sim_ros.physics.constants import CONSTANTS
from cloth_sim_ros.physics.control.choice import Options
from cloth_sim_ros.physics.integrators.base import NoRoomError
from cloth_sim_ros.physics.integrators.columns import Columns, larger_rates
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.remembered import PINCHED, THICKNESS, Stability, Touch
from cloth_sim_ros.physics.runs import Told
from cloth_sim_ros.physics.state import State


class TouchRule:
    """Of one advance; scenes without obstacles are told that nothing touches.

    Args:
        options: what is asked for.
        plan: equations of motion.
        memory: what was remembered.
        stability: what is known of the sheet.
    """

    def __init__(self, options: Options, plan: Plan, memory: Touch, stability: Stability) -> None:
        self._options, self._plan, self._memory, self._stability = options, plan, memory, stability
        #: Largest energy that contact held in the advance, see `Touch`.
        self.held = 0.0
        #: What was seen ahead of the whole advance, until it is used: time, duration [s], squared frequency, damping.
        self._seen: tuple[float, float, float, float] | None = None

    @property
    def bare(self) -> float:
        """Step limit [s] of the sheet as it was last, without contact."""
        return self._options.step_limit(self._stability.omega2, self._stability.damping)

    def look_ahead(self, t: float, duration: float, state: State) -> float:
        """Look at what contact may come to in the whole advance; return the estimated time [ns] that what may meet adds
        to an evaluation. The step limit ahead from there is told without a second look.
        """
        if (contact := self._plan.contact) is None:
            return 0.0
        contact.lay_pads(state.memory.get(PINCHED))
        contact.lay_thickness(state.memory.get(THICKNESS))
        try:
            omega2, damping, work = contact.ahead(t, duration, state.x, state.v)
        except ValueError as error:
            raise NoRoomError(str(error)) from error
        if not omega2 < math.inf:
            raise NoRoomError("no step is short enough for contact: what moves has left no room")
        self._seen = t, duration, omega2, damping
        return CONSTANTS.operation * work

    def limit_ahead(self, t: float, duration: float, state: State) -> float:
        """Return the step limit [s] for a duration [s] from a state at time t on."""
        known, seen = self._stability, self._seen
        if self._plan.contact is None:
            return self.bare
        if seen is None or seen[:2] != (t, duration):
            self.look_ahead(t, duration, state)
            seen = self._seen
        assert seen is not None
        # Later stretches of the same time and length begin elsewhere.
        self._seen = None
        omega2, damping = seen[2:]
        return self._options.step_limit(known.omega2 + omega2, known.damping + damping)

    def limit(
        self,
        energy: float,
        own: tuple[float, float],
        omega2: float | None = None,
        damping: float | None = None,
    ) -> float:
        """Return the step limit [s] of obstacles' contact that had to take up an energy, of the cloth's contact with
        itself of some squared frequency and damping rate, and of a sheet of these rates.
        """
        omega2 = self._stability.omega2 if omega2 is None else omega2
        damping = self._stability.damping if damping is None else damping
        if self._plan.contact is not None:
            stiff, damped = self._plan.contact.limits(energy)
            omega2, damping = omega2 + stiff + own[0], damping + damped + own[1]
        return self._options.step_limit(omega2, damping)

    @staticmethod
    def _met(columns: Columns, count: int) -> tuple[float, tuple[float, float]]:
        """What contact had to take up in T_K, K = count: an energy at obstacles, and rates of the cloth with itself."""
        return max(columns.reached(count), columns.told(count).contact), columns.own(count)

    def acts(self, columns: Columns, count: int) -> bool:
        """Whether there was contact in T_K, K = count."""
        if self._plan.contact is None:
            return False
        energy, own = self._met(columns, count)
        return bool(energy or own[0])

    def limit_met(self, columns: Columns, count: int) -> float:
        """Return the step limit [s] of T_K, K = count: of contact in its runs, and of the sheet at its end."""
        told = columns.told(count)
        if self._plan.contact is None:
            return self._options.step_limit(told.omega2, told.damping)
        energy, own = self._met(columns, count)
        return self.limit(energy, larger_rates(own, told.own), told.omega2, told.damping)

    def limit_after(self, reached: float, own: tuple[float, float], told: Told) -> float:
        """Return the step limit [s] of a run: of contact that it met, see `Run.met`, and of its end."""
        return self.limit(max(reached, told.contact), larger_rates(own, told.own), told.omega2, told.damping)

    def is_brief(self, longest: float, duration: float) -> bool:
        """Whether contact makes steps much shorter than the sheet does, over a stretch [s] of many: it is rather halved
        untried, for an impact is soon over.
        """
        if self._plan.contact is None or self._options.tolerance is None:
            return False
        bare = min(CONSTANTS.safety * self.bare, duration)
        return bare > CONSTANTS.trust * longest and duration > CONSTANTS.brief * longest

    def is_harder(self, held: float) -> bool:
        """Whether contact held more energy than in the frame that was judged last: nothing is known of it."""
        return held > CONSTANTS.trust * self._memory.held

    def store(self, state: State, *, judged: bool) -> None:
        """Remember a frame, judged or not."""
        if self._plan.contact is None:
            return
        if judged:
            self._memory.held = self.held
        self._memory.store(state)
