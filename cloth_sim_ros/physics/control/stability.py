# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Stability rule: limit of the step by sheet and contact, refinement and pieces that combinations of runs require.

The leapfrog's limit follows from bounds of stiffness and damping. Contact that is predicted, or that a run met, adds to
them. A combination of runs has the same limit if damping removes waves within a piece before the runs' phases drift
apart. With less damping steps are shorter. With hardly any, a piece has few steps, and the stability function of the
combination shortens them (docs/step_control.md).
"""

from __future__ import annotations

import math
from functools import cached_property

from cloth_sim_ros.physics.arithmetic.deterministic_math import root
from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.integrators.base import NoRoomError
from cloth_sim_ros.physics.integrators.extrapolation_tableau import RATIOS, ExtrapolationTableau, max_rates
from cloth_sim_ros.physics.integrators.limit import leapfrog_limit, steps_for
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.plan.runs import RunSummary
from cloth_sim_ros.physics.state.controller_state import StabilityState
from cloth_sim_ros.physics.state.state import State

#: Maximum number of combined runs; one further run estimates their error.
MAX_COMBINED_RUNS = len(RATIOS) - 1
#: Maximum steps of a short piece. Fractions of the leapfrog's limit for combinations of 1 to 4 runs in short pieces, by
#: the least decay of the fastest waves over four steps. With four to six steps no undamped wave grows by more than 1e-5
#: per step (eigenvalues of the stability function). In frames of fewer steps waves may grow by up to 3e-3 per step with
#: three runs; there the error estimate detects them.
MAX_UNDAMPED_STEPS, _MIN_SHORT_STEPS = 6, 4
LIMIT_FRACTIONS = {0.0: (1.0, 0.2, 0.75, 0.35), 0.02: (1.0, 0.45, 0.8, 0.6)}
#: Decay of the fastest waves over a piece with which a combination of 1 to 4 of the longest runs is stable, and the
#: number of steps above which it has to increase (eigenvalues as well).
_STABLE_DECAYS, _MAX_STABLE_STEPS = (0.0, 4.5, 6.0, 6.0), 25.0
#: Steps n of a single run times (w h)^3 from which on phases of n and 5/4 n steps differ by 4.5 rad or more. Largest
#: number of steps for which a third run shows it (leapfrog of an oscillator, w h up to 1.92).
_COINCIDENCE_STEPS, _MAX_THIRD_RUN_STEPS = 84.0, 64
#: Fraction of the sheet's squared frequency up to which undamped grips do no harm, because their waves hardly drift.
_SOFT_GRIP_FRACTION = 0.02


class StabilityRule:
    """Rule for the limit of the step, and for the refinement and pieces that stable combinations of runs require.

    Args:
        plan: equations of motion.
        memory: spectral bounds; those of the state if they are unknown.
        x: positions [m], shape (3, n).
    """

    def __init__(self, plan: Plan, memory: StabilityState, x: Array) -> None:
        self._plan, self.memory = plan, memory
        #: Estimated time that possible contacts add to a force evaluation, by the last prediction [ns].
        self.contact_time = 0.0
        self._refinements: dict[tuple[int, float, float, float], tuple[float, bool]] = {}
        if memory.omega2 < 0.0:
            memory.omega2, memory.damping = plan.spectral_bounds(x)

    @cached_property
    def _damping_time(self) -> float:
        """Damping rate of all waves over their squared frequency [s], at least; 0 if no force damps waves.

        A frame asks several times, and grips change only between frames.
        """
        plan = self._plan
        return plan.min_damping_time(_SOFT_GRIP_FRACTION * self.memory.omega2) if plan.damps_waves else 0.0

    def _decay(self, length: float) -> float:
        """Return the decay of the fastest waves within a time [s], their damping rate times it."""
        memory, damping_time = self.memory, self._damping_time
        # Waves of an undamped part persist, however much another part is damped.
        rate = min(memory.damping, damping_time * memory.omega2) if damping_time else 0.0
        return math.inf if memory.omega2 == 0.0 else rate * length

    def is_damped(self, length: float) -> bool:
        """Return True if damping removes the fastest waves within a time [s]."""
        return self._decay(length) >= CONSTANTS.damped_wave_decay

    def count_confirming_runs(self, steps: int, length: float) -> int:
        """Return the number of further runs that an error estimate of a single run needs because of undamped waves.

        The phases of runs of n and 5/4 n steps differ by up to 0.054 n (w h)^3. Where they differ by a turn, both runs
        end alike and may be wrong. A third run shows that up to 64 steps, a fourth one beyond.

        Args:
            steps: n, of the single run.
            length: of the run [s].
        """
        least = root(_COINCIDENCE_STEPS / steps, 3)
        excess = self.memory.omega2 * (length / steps) * (length / steps) / (least * least)
        if excess <= 1.0 or self._decay(length) >= CONSTANTS.damped_wave_decay * excess:
            return 0
        return 1 if steps <= _MAX_THIRD_RUN_STEPS else 2

    def _long_refinement(self, n_runs: int, length: float) -> float:
        """Return the least refinement at which a combination of runs is stable in pieces of any number of steps.

        Phases of two runs of n steps h drift apart by n h^3 w^3, and waves decay by w^2. So at the refinement r, waves
        of all w are stable above a decay of the fastest that is proportional to (n r)^(2/3) / r^2.
        """
        piece = length / steps_for(length, CONSTANTS.max_interval)
        decay = self._decay(piece)
        if not decay:
            return math.inf
        excess = max(1.0, piece / (_MAX_STABLE_STEPS * CONSTANTS.stability_safety * self.sheet_limit))
        ratio = _STABLE_DECAYS[n_runs - 1] / decay * root(excess * excess, 3)
        return max(1.0, math.sqrt(ratio * math.sqrt(ratio)))

    def _short_refinement(self, n_runs: int, length: float) -> float:
        """Return the least refinement at which a combination of runs is stable in short pieces."""
        max_step, refinement = CONSTANTS.stability_safety * self.sheet_limit, math.inf
        for min_decay, fractions in LIMIT_FRACTIONS.items():
            fraction = fractions[n_runs - 1]
            if self._decay(min(length, _MIN_SHORT_STEPS * fraction * max_step)) >= min_decay:
                refinement = 1.0 / fraction
        return refinement

    def _refinement(self, n_runs: int, length: float) -> tuple[float, bool]:
        """Return the least refinement of a combination of runs over a length [s], and whether pieces are short."""
        if n_runs == 1:
            return 1.0, False
        # An error estimate asks for each number of runs several times.
        key = n_runs, length, self.memory.omega2, self.memory.damping
        if key not in self._refinements:
            long, short = self._long_refinement(n_runs, length), self._short_refinement(n_runs, length)
            is_short = long > CONSTANTS.long_piece_preference * short
            self._refinements[key] = (short if is_short else long), is_short
        return self._refinements[key]

    def min_refinement(self, n_runs: int, length: float) -> float:
        """Return the least refinement at which a combination of runs is stable over a length [s]; 1 for one run."""
        return self._refinement(n_runs, length)[0]

    def n_pieces(self, n_runs: int, steps: int, length: float) -> int:
        """Return the number of pieces to divide a length [s] into: each short, and of few steps with little damping.

        Args:
            n_runs: number of combined runs.
            steps: steps of the first run over the length.
            length: to divide [s].
        """
        n_pieces = steps_for(length, CONSTANTS.max_interval)
        is_short = self._refinement(n_runs, length)[1]
        return max(n_pieces, math.ceil(steps / MAX_UNDAMPED_STEPS)) if is_short else n_pieces

    @property
    def sheet_limit(self) -> float:
        """Stability limit of the step [s] without contact, from the model's last spectral bounds."""
        return leapfrog_limit(self.memory.omega2, self.memory.damping)

    def predicted_limit(self, t: float, duration: float, state: State) -> float:
        """Return the largest stable step [s] with contact until t + duration; set `contact_time` or raise NoRoomError.

        Raises:
            NoRoomError: if no step is short enough.
        """
        contact, memory = self._plan.contact, self.memory
        if contact is None:
            return self.sheet_limit
        try:
            omega2, damping, operations = contact.predict_contact(t, duration, state.x, state.v, state.memory)
        except ValueError as error:
            raise NoRoomError(str(error)) from error
        if not omega2 < math.inf:
            raise NoRoomError("no step is short enough for contact: moving bodies have left the cloth no room")
        self.contact_time = CONSTANTS.operation_time * operations
        return leapfrog_limit(memory.omega2 + omega2, memory.damping + damping)

    def encountered_limit(self, tableau: ExtrapolationTableau, n_runs: int, summary: RunSummary) -> float:
        """Return the stability limit of the step [s] by contact that n_runs runs met, and the sheet at their end.

        If their combination is not finite, contact did not stop a particle, and the sheet is that at the start.
        """
        contact, sheet = self._plan.contact, summary if summary.is_finite else self.memory
        if contact is None:
            return leapfrog_limit(sheet.omega2, sheet.damping)
        energy, _, rates = tableau.contact_summary(n_runs)
        if sheet is summary:
            energy, rates = max(energy, summary.contact_energy), max_rates(rates, summary.self_contact)
        omega2, damping = contact.bounds_at_energy(energy)
        return leapfrog_limit(sheet.omega2 + omega2 + rates[0], sheet.damping + damping + rates[1])

    def has_contact(self, tableau: ExtrapolationTableau, n_runs: int) -> bool:
        """Return True if the first n_runs runs of a tableau met an obstacle or the cloth itself."""
        energy, _, rates = tableau.contact_summary(n_runs)
        return bool(energy or tableau.summary(n_runs).contact_energy or rates[0])

    def should_halve(self, max_step: float, length: float) -> bool:
        """Return True if contact requires much shorter steps [s] than the sheet, and a length [s] has many of them.

        It should then be halved at once, because an impact is short.
        """
        if self._plan.contact is None:
            return False
        sheet_max_step = min(CONSTANTS.stability_safety * self.sheet_limit, length)
        is_shorter = sheet_max_step > CONSTANTS.estimate_trust_factor * max_step
        return is_shorter and length > CONSTANTS.contact_min_interval_steps * max_step
