# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where runs calculate in single precision: where it was measured what that changes, and the budget has room for it.

Positions keep the tolerance so. Energies ask for more: rounding of coordinates shakes neighbours against each other,
with a power that goes as the stiffness to the power of 1.5, and damping takes that up. So the power is measured too,
and in a second it may be a small part of the kinetic energy.
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

#: Spacing of single precision's numbers: a stretch changes no less than a few tenths of it, relative to the sheet.
_SPACING = 2.0**-24
#: Time over which energy that rounding makes is compared with the kinetic energy [s]: that of the promise.
_SECOND = 1.0
#: Judged frames in which the power is measured, of which the largest counts: a flat sheet of 65 x 65 over a metre lies
#: where nothing is rounded, but only until it moves.
_SAMPLES = 4.0


class PrecisionRule:
    """The choice of one advance.

    Args:
        plan: equations of motion.
        memory: what was measured of positions.
        noise: what was measured of energies.
        duration: of the advance [s].
        budget: error that it may have [m].
    """

    def __init__(self, plan: Plan, memory: Precision, noise: Noise, duration: float, budget: float) -> None:
        self._plan, self.memory, self.noise, self._duration = plan, memory, noise, duration
        #: Attempts that missed the budget: from the second on it may be rounding, which finer steps do not mend.
        self.missed = 0
        self._room = CONSTANTS.rounding * budget
        #: What an estimate of the error may be off by [m]: it tells whether an error is far below the budget all the
        #: same, for what was measured is counted `trust` times.
        self._blur = CONSTANTS.trust * CONSTANTS.far * budget

    def measure(self, t: float, state: State, step: float, choice: Choice) -> int:
        """Measure what single precision changes over steps of a length [s], where that is not known and might fit.

        Returns:
            The force evaluations that it took.
        """
        memory, noise, plan = self.memory, self.noise, self._plan
        if noise.samples >= _SAMPLES or choice.columns > 1 or not plan.narrows(self._duration, state.x, state.v):
            return 0
        extent = float((state.x.max(axis=1) - state.x.min(axis=1)).max())
        if _SPACING * extent > self._room:
            return 0
        # A part of the steps stands for all of them: positions carry what rounding takes, and what is left is a last
        # bit of the sheet's extent, whatever the number of steps.
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
        # Over a few steps what rounding did may have taken as much as it gave; what it moved is there all the same.
        away = ends[1].v - ends[0].v
        made = max(abs(energies[1] - energies[0]), 0.5 * weighted_dot(plan.model.masses, away, away))
        if math.isfinite(energies[1] - energies[0]):
            noise.samples += 1.0
            if memory.rounding < 0.0:
                memory.rounding = CONSTANTS.trust * largest_distance(ends[0].x, ends[1].x)
            noise.power = max(noise.power, CONSTANTS.trust * made / part)
        return 2 * (steps + 1)

    def look(self, state: State) -> None:
        """Look at the energy that rounding's is compared with, where a frame is judged."""
        noise = self.noise
        if noise.power >= 0.0:
            noise.kinetic = max(0.5 * weighted_dot(self._plan.model.masses, state.v, state.v), 0.5 * noise.kinetic)

    def narrows(self, state: State, choice: Choice) -> bool:
        """Whether the runs of a choice from a state take it: what comes to rest has to find its place, so the motion
        must be large against what their combination makes of it.
        """
        rounding = amplification(choice.columns) * self.memory.rounding
        # A judgement looks at one combination more.
        if self.missed > 1 or not (0.0 <= rounding <= self._room and self.tells(choice.columns + choice.judge)):
            return False
        if not 0.0 <= self.noise.power * _SECOND <= CONSTANTS.gain * self.noise.kinetic:
            return False
        v, least = state.v, CONSTANTS.motion * rounding
        # The last particle is looked at first: where the sheet moves it mostly does.
        if max(map(abs, v[:, -1].tolist())) * self._duration > least:
            return True
        return float(v.max()) * self._duration > least or -float(v.min()) * self._duration > least

    def tells(self, columns: int) -> bool:
        """Whether a combination of so many such runs still tells what the error is. It is no result, so rounding need
        not be small against it, only against the budget.
        """
        return amplification(columns) * self.memory.rounding <= self._blur
