# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Precision rule: selects single precision if its measured effect fits the error budget.

The budget protects positions. Energies need a further bound. Rounding of coordinates excites neighbours against each
other, with a power that grows as the stiffness to the power of 1.5. Damping dissipates it. Therefore the power is
measured too; in one second it may supply a small fraction of the kinetic energy.
"""

from __future__ import annotations

import math

from cloth_sim_ros.physics.arrays import largest_distance, weighted_dot
from cloth_sim_ros.physics.book import Book
from cloth_sim_ros.physics.constants import CONSTANTS
from cloth_sim_ros.physics.control.choice import Choice
from cloth_sim_ros.physics.integrators.columns import amplification
from cloth_sim_ros.physics.integrators.fixed import steps_for
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.remembered import Noise, Precision
from cloth_sim_ros.physics.state import State

#: Relative spacing of single precision; a run changes by at least some tenths of it, relative to the sheet.
_SPACING = 2.0**-24
#: Time over which energy input of rounding is compared with the kinetic energy [s]: that of the error bound.
_SECOND = 1.0
#: Number of frames in which the power is measured; the largest counts. A flat sheet of 65 x 65 over one metre has
#: coordinates without rounding until it moves.
_SAMPLES = 4.0


class PrecisionRule:
    """Choice of precision for one advance.

    Args:
        plan: equations of motion.
        memory: measured effect on positions.
        noise: measured energy input.
        duration: of the advance [s].
        budget: error budget of the advance [m].
    """

    def __init__(self, plan: Plan, memory: Precision, noise: Noise, duration: float, budget: float) -> None:
        self._plan, self.memory, self.noise, self._duration = plan, memory, noise, duration
        #: Attempts that missed the budget. From the second on, rounding may be the cause; finer steps do not reduce it.
        self.missed = 0
        self._room = CONSTANTS.rounding * budget
        #: Allowed uncertainty of an error estimate [m]; it can still show that an error is far below the budget.
        self._blur = CONSTANTS.trust * CONSTANTS.far * budget

    def measure(self, t: float, state: State, step: float, choice: Choice) -> int:
        """Measure the effect of single precision by a short pair of runs, if it is unknown and may fit.

        Args:
            t: time at the start [s].
            state: at the start.
            step: step size [s].
            choice: of the attempt.

        Returns:
            Force evaluations of the measurement.
        """
        memory, noise, plan = self.memory, self.noise, self._plan
        if noise.samples >= _SAMPLES or choice.columns > 1 or not plan.narrows(self._duration, state.x, state.v):
            return 0
        extent = float((state.x.max(axis=1) - state.x.min(axis=1)).max())
        if _SPACING * extent > self._room:
            return 0
        # A fraction of the steps is representative: compensated summation of positions leaves a rounding error of the
        # last bit of the sheet's extent for any number of steps.
        steps = max(1, int(steps_for(self._duration, step) // CONSTANTS.sample))
        part = steps * step
        ends, energies = [], []
        for narrow in (False, True):
            if plan.contact is not None:
                plan.contact.take(state)
            (run,), _ = plan.runs(t, part, (state.x, state.v), [steps], narrow=narrow, powers=True, touches=True)
            book = Book(plan.gripper_count, powers=True, obstacle_count=plan.obstacle_count)
            book.add_runs((1.0,), (run,), part)
            ends.append(run)
            put_in = book.work + book.given + book.recovered
            energies.append(plan.energy(t + part, run.x, run.v) + book.lost - put_in)
        # Over a few steps the energy changes by rounding may cancel; the kinetic energy of the difference does not.
        away = ends[1].v - ends[0].v
        made = max(abs(energies[1] - energies[0]), 0.5 * weighted_dot(plan.model.masses, away, away))
        if math.isfinite(energies[1] - energies[0]):
            noise.samples += 1.0
            if memory.rounding < 0.0:
                memory.rounding = CONSTANTS.trust * largest_distance(ends[0].x, ends[1].x)
            noise.power = max(noise.power, CONSTANTS.trust * made / part)
        return 2 * (steps + 1)

    def look(self, state: State) -> None:
        """Update the kinetic energy for the comparison, in a frame with an error estimate."""
        noise = self.noise
        if noise.power >= 0.0:
            noise.kinetic = max(0.5 * weighted_dot(self._plan.model.masses, state.v, state.v), 0.5 * noise.kinetic)

    def narrows(self, state: State, choice: Choice) -> bool:
        """Return True if runs of a choice may use single precision.

        The motion must be large against the amplified rounding error, so that a sheet can come to rest accurately.

        Args:
            state: at the start.
            choice: runs and refinement.
        """
        rounding = amplification(choice.columns) * self.memory.rounding
        # An error estimate needs one further run.
        if self.missed > 1 or not (0.0 <= rounding <= self._room and self.tells(choice.columns + choice.judge)):
            return False
        if not 0.0 <= self.noise.power * _SECOND <= CONSTANTS.gain * self.noise.kinetic:
            return False
        v, least = state.v, CONSTANTS.motion * rounding
        # The last particle is checked first: it moves in most moving sheets.
        if max(map(abs, v[:, -1].tolist())) * self._duration > least:
            return True
        return float(v.max()) * self._duration > least or -float(v.min()) * self._duration > least

    def tells(self, columns: int) -> bool:
        """Return True if a combination of single-precision runs still resolves the error.

        The combination is only an estimate. Rounding must be small against the budget, not against the error.
        """
        return amplification(columns) * self.memory.rounding <= self._blur
