# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Contact step limit: stiffness of predicted and encountered contact."""

from __future__ import annotations

import math

from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.control.description import ExplicitSettings
from cloth_sim_ros.physics.integrators.base import NoRoomError
from cloth_sim_ros.physics.integrators.extrapolation_tableau import ExtrapolationTableau, max_rates
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.plan.runs import RunSummary
from cloth_sim_ros.physics.state.controller_state import ContactState, StabilityState
from cloth_sim_ros.physics.state.state import State


class ContactStepLimit:
    """Rule for the stability limit of the step in one advance with contact, predicted and encountered.

    Args:
        options: settings of the integrator.
        plan: equations of motion.
        state: at the start; it has the contact energy of the last estimate.
        stability: spectral bounds of the sheet.
    """

    def __init__(self, options: ExplicitSettings, plan: Plan, state: State, stability: StabilityState) -> None:
        self._options, self._plan, self._stability = options, plan, stability
        #: Largest contact energy per mass of the last frame with an estimate, in U^2/2.
        self._known_energy = 0.0 if plan.contact is None else ContactState.load(state).contact_energy
        #: Estimated time that possible contacts add to a force evaluation, by the last prediction [ns].
        self.contact_time = 0.0

    @property
    def sheet_limit(self) -> float:
        """Stability limit of the step [s] without contact, from the model's last spectral bounds."""
        return self._options.step_limit(self._stability.omega2, self._stability.damping)

    def predicted_limit(self, t: float, duration: float, state: State) -> float:
        """Return the stability limit of the step [s] with the contact predicted from t to t + duration [s].

        Raises:
            NoRoomError: if no step is short enough.
        """
        contact, stability = self._plan.contact, self._stability
        if contact is None:
            return self.sheet_limit
        try:
            omega2, damping, operations = contact.predict_contact(t, duration, state.x, state.v, state.memory)
        except ValueError as error:
            raise NoRoomError(str(error)) from error
        if not omega2 < math.inf:
            raise NoRoomError("no step is short enough for contact: moving bodies have left the cloth no room")
        self.contact_time = CONSTANTS.operation_time * operations
        return self._options.step_limit(stability.omega2 + omega2, stability.damping + damping)

    def limit_at_energy(self, energy: float, rates: tuple[float, float], sheet: StabilityState | RunSummary) -> float:
        """Return the stability limit of the step [s] for a contact energy and rates of self-contact.

        Args:
            energy: energy per mass that contact with obstacles had to absorb, in U^2/2.
            rates: squared frequency [1/s^2] and damping rate [1/s] of self-contact.
            sheet: spectral bounds of the sheet.
        """
        omega2, damping = sheet.omega2, sheet.damping
        if self._plan.contact is not None:
            contact_omega2, contact_damping = self._plan.contact.bounds_at_energy(energy)
            omega2, damping = omega2 + contact_omega2 + rates[0], damping + contact_damping + rates[1]
        return self._options.step_limit(omega2, damping)

    @staticmethod
    def _encountered(tableau: ExtrapolationTableau, n_runs: int) -> tuple[float, tuple[float, float]]:
        """Return the energy per mass at obstacles and the rates of self-contact that n_runs runs encountered."""
        energy, _, rates = tableau.contact_summary(n_runs)
        return max(energy, tableau.summary(n_runs).contact_energy), rates

    def has_contact(self, tableau: ExtrapolationTableau, n_runs: int) -> bool:
        """Return True if the first n_runs runs of a tableau met an obstacle or the cloth itself."""
        if self._plan.contact is None:
            return False
        energy, self_contact = self._encountered(tableau, n_runs)
        return bool(energy or self_contact[0])

    def encountered_limit(self, tableau: ExtrapolationTableau, n_runs: int, summary: RunSummary) -> float:
        """Return the stability limit of the step [s] by contact that n_runs runs met, and the sheet at their end."""
        if self._plan.contact is None:
            return self._options.step_limit(summary.omega2, summary.damping)
        energy, self_contact = self._encountered(tableau, n_runs)
        rates = max_rates(self_contact, summary.self_contact)
        return self.limit_at_energy(energy, rates, summary)

    def should_halve(self, max_step: float, duration: float) -> bool:
        """Return True if an interval should be halved at once, because contact requires much shorter steps.

        That is the case if contact makes steps much shorter than the sheet does, and the interval has many of them: an
        impact is short.

        Args:
            max_step: longest stable step with contact [s].
            duration: of the interval [s].
        """
        if self._plan.contact is None or self._options.tolerance is None:
            return False
        sheet_max_step = min(CONSTANTS.stability_safety * self.sheet_limit, duration)
        is_shorter = sheet_max_step > CONSTANTS.estimate_trust_factor * max_step
        return is_shorter and duration > CONSTANTS.contact_min_interval_steps * max_step

    def exceeds_known_energy(self, contact_energy: float) -> bool:
        """Return True if a contact energy is far above that of the last error estimate, so the error is unknown."""
        return contact_energy > CONSTANTS.estimate_trust_factor * self._known_energy

    def store(self, state: State, contact_energy: float | None) -> None:
        """Store a frame's largest contact energy per mass (unit U^2/2) in a state; None keeps that before."""
        if self._plan.contact is not None:
            ContactState(self._known_energy if contact_energy is None else contact_energy).store(state)
