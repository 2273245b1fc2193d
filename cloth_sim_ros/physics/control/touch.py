# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Contact step limit: stiffness of predicted and encountered contact."""

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
    """Step limit of one advance with contact; without contact it is the limit of the sheet.

    Args:
        options: settings of the integrator.
        plan: equations of motion.
        memory: recorded contact energy.
        stability: spectral bounds of the sheet.
    """

    def __init__(self, options: Options, plan: Plan, memory: Touch, stability: Stability) -> None:
        self._options, self._plan, self._memory, self._stability = options, plan, memory, stability
        #: Largest contact energy per mass in the advance, in U^2/2, see `ContactState`.
        self.held = 0.0
        #: Prediction for the whole advance until its use: time, duration [s], squared frequency [1/s^2], damping [1/s].
        self._seen: tuple[float, float, float, float] | None = None

    @property
    def bare(self) -> float:
        """Step limit of the sheet without contact, from its last spectral bounds [s]."""
        return self._options.step_limit(self._stability.omega2, self._stability.damping)

    def look_ahead(self, t: float, duration: float, state: State) -> float:
        """Predict contact for a whole advance; the prediction also serves the next `predicted_limit`.

        Args:
            t: time at the start [s].
            duration: of the advance [s].
            state: at the start.

        Returns:
            Estimated time that possible contacts add to a force evaluation [ns].

        Raises:
            NoRoomError: if no step is short enough.
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
            raise NoRoomError("no step is short enough for contact: moving bodies have left the cloth no room")
        self._seen = t, duration, omega2, damping
        return CONSTANTS.operation * work

    def limit_ahead(self, t: float, duration: float, state: State) -> float:
        """Return the step limit with predicted contact [s], over a duration [s] from a state at time t [s]."""
        known, seen = self._stability, self._seen
        if self._plan.contact is None:
            return self.bare
        if seen is None or seen[:2] != (t, duration):
            self.look_ahead(t, duration, state)
            seen = self._seen
        assert seen is not None
        # Later intervals of the same time and length may start from another state.
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
        """Return the step limit with contact [s].

        Args:
            energy: energy per mass that contact with obstacles had to absorb, in U^2/2.
            own: squared frequency [1/s^2] and damping rate [1/s] of self-contact.
            omega2: squared frequency of the sheet [1/s^2]; the last bound by default.
            damping: damping rate of the sheet [1/s]; the last bound by default.
        """
        omega2 = self._stability.omega2 if omega2 is None else omega2
        damping = self._stability.damping if damping is None else damping
        if self._plan.contact is not None:
            stiff, damped = self._plan.contact.limits(energy)
            omega2, damping = omega2 + stiff + own[0], damping + damped + own[1]
        return self._options.step_limit(omega2, damping)

    @staticmethod
    def _met(columns: Columns, count: int) -> tuple[float, tuple[float, float]]:
        """Return energy per mass at obstacles and rates of self-contact that T_K encountered, K = n_runs."""
        return max(columns.reached(count), columns.told(count).contact), columns.own(count)

    def acts(self, columns: Columns, count: int) -> bool:
        """Return True if T_K encountered contact, K = n_runs."""
        if self._plan.contact is None:
            return False
        energy, own = self._met(columns, count)
        return bool(energy or own[0])

    def limit_met(self, columns: Columns, count: int) -> float:
        """Return the step limit of T_K [s], K = n_runs: contact in its runs, and the sheet at its end."""
        told = columns.told(count)
        if self._plan.contact is None:
            return self._options.step_limit(told.omega2, told.damping)
        energy, own = self._met(columns, count)
        return self.limit(energy, larger_rates(own, told.own), told.omega2, told.damping)

    def limit_after(self, reached: float, own: tuple[float, float], told: Told) -> float:
        """Return the step limit of a run [s]: contact that it encountered, see `Run.contact_summary`, and its end."""
        return self.limit(max(reached, told.contact), larger_rates(own, told.own), told.omega2, told.damping)

    def is_brief(self, longest: float, duration: float) -> bool:
        """Return True if an interval should be halved before the first attempt, because an impact is short.

        That is the case if contact makes steps much shorter than the sheet does, and the interval has many of them.

        Args:
            longest: longest stable step with contact [s].
            duration: of the interval [s].
        """
        if self._plan.contact is None or self._options.tolerance is None:
            return False
        bare = min(CONSTANTS.safety * self.bare, duration)
        return bare > CONSTANTS.trust * longest and duration > CONSTANTS.brief * longest

    def is_harder(self, held: float) -> bool:
        """Return True if the contact energy clearly exceeds that of the last estimate, so its error is unknown."""
        return held > CONSTANTS.trust * self._memory.held

    def store(self, state: State, *, judged: bool) -> None:
        """Store the contact energy of a frame; it changes only with an error estimate."""
        if self._plan.contact is None:
            return
        if judged:
            self._memory.held = self.held
        self._memory.store(state)
