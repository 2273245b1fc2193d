# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Multirate rule: hinge forces are integrated with an m times larger step (r-RESPA).

Hinge forces are the most expensive and the slowest. Their impulses are a leapfrog with step m h around that of the
springs; the order stays 2 (Tuckerman, Berne and Martyna, J. Chem. Phys. 97, 1990, 1992). Impulses may excite waves
whose phase advances by half a period or more between two impulses. Along springs the damping of such waves must exceed
this excitation. Across springs there is no damping, so no such waves may exist. Derivation:
docs/derivations/time_stepping.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from cloth_sim_ros.physics.arithmetic.deterministic_math import root
from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.integrators.limit import leapfrog_limit, steps_for
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.plan.runs import RunSummary
from cloth_sim_ros.physics.state.controller_state import MultirateState

#: Largest ratio: a ninth of the cost of hinges remains.
MAX_RATIO = 9
#: Minimum number of impulses in a run; with fewer of them the runs of a combination do not differ enough.
MIN_IMPULSES = 4
#: Factor on limits of the impulse interval, and on the damping time, see `_max_impulse_interval`.
_STABILITY_FRACTION = 0.6


class MultirateRule:
    """Rule that chooses the multirate ratio of one advance: steps per evaluation of hinge forces.

    Args:
        plan: equations of motion.
        memory: state of the rule.
        allowed: False fixes the ratio to 1.
    """

    def __init__(self, plan: Plan, memory: MultirateState, *, allowed: bool) -> None:
        self._plan, self.memory = plan, memory
        self._min_damping_time = plan.min_damping_time() if allowed and plan.has_hinges else 0.0
        #: Multirate ratio m: steps per evaluation of hinges, an odd number.
        self.ratio = int(memory.ratio) if self._min_damping_time and memory.omega2 >= 0.0 else 1

    @property
    def bounds(self) -> Sequence[float]:
        """Bounds of squared frequency and damping rate of hinges, and of squared frequency across springs; settable."""
        return self.memory.omega2, self.memory.damping, self.memory.transverse_omega2

    @bounds.setter
    def bounds(self, bounds: Sequence[float]) -> None:
        self.memory.omega2, self.memory.damping, self.memory.transverse_omega2 = bounds

    def keep_ratio(self, max_step: float, duration: float) -> None:
        """Keep the `ratio` of the last advance, or set it to 1 if that is cheaper.

        Args:
            max_step: longest stable step [s].
            duration: of the advance [s].
        """
        if self._min_damping_time and self._cost(self.ratio, max_step, duration) > self._cost(1, max_step, duration):
            self.ratio = 1

    def choose_ratio(self, x: Array, max_step: float, duration: float, n_runs: int) -> None:
        """Set `ratio` to that of least cost; to 1 if runs are combined, and for some estimates after that.

        A refinement for accuracy keeps the ratio, so that the error decreases with its order. The error of impulses is
        m^2 times that of steps. It would cost further runs if more than one is combined, so the ratio is then 1, and
        for some estimates after that.

        Args:
            x: positions [m], shape (3, n).
            max_step: longest stable step without impulses [s].
            duration: of the advance [s].
            n_runs: number of combined runs.
        """
        if not self._min_damping_time:
            return
        self.memory.estimates_since_combination = 0.0 if n_runs > 1 else self.memory.estimates_since_combination + 1.0
        if self.memory.estimates_since_combination < CONSTANTS.multirate_pause:
            self.ratio = 1
        else:
            self.bounds = self._plan.detailed_spectral_bounds(x, hinges=True)[2:]
            self.ratio = min(range(1, MAX_RATIO + 1, 2), key=lambda ratio: self._cost(ratio, max_step, duration))

    def _cost(self, ratio: int, max_step: float, duration: float) -> float:
        """Return the estimated cost of an advance at a ratio [ns a particle]; infinite with too few hinge impulses."""
        steps = self._steps(ratio, max_step, duration)
        if ratio > 1 and steps < MIN_IMPULSES * ratio * steps_for(duration, CONSTANTS.max_interval):
            return math.inf
        return self._plan.multirate_step_cost(ratio) * ratio * math.ceil(steps / ratio)

    def _steps(self, ratio: int, max_step: float, duration: float) -> int:
        """Return the number of the longest steps, stable at a multirate ratio, that cover a duration [s]."""
        return steps_for(duration, max_step / max(1.0, self.min_refinement(ratio, max_step)))

    def ratio_within(self, max_step: float, duration: float) -> tuple[int, float]:
        """Return the ratio for an interval, reduced until it has enough impulses, and the refinement it requires.

        Args:
            max_step: longest stable step [s].
            duration: of the interval [s].
        """
        ratio, part_duration = self.ratio, min(duration, CONSTANTS.max_interval)
        while ratio > 1 and self._steps(ratio, max_step, part_duration) < MIN_IMPULSES * ratio:
            ratio -= 2
        return ratio, self.min_refinement(ratio, max_step)

    def min_refinement(self, ratio: int, max_step: float) -> float:
        """Return the refinement, relative to the longest stable step [s], that a multirate ratio requires."""
        return 1.0 if ratio == 1 else ratio * max_step / self._max_impulse_interval(self.bounds, _STABILITY_FRACTION)

    def exceeds_limit(self, impulse_interval: float, summary: RunSummary) -> bool:
        """Return True if hinge impulses are unstable at their interval, by the bounds at the end of a run.

        Args:
            impulse_interval: interval between two impulses [s].
            summary: summary of the run.
        """
        return impulse_interval > self._max_impulse_interval(summary.hinge_bounds, 1.0)

    def _max_impulse_interval(self, bounds: Sequence[float], fraction: float) -> float:
        """Return the longest stable interval [s] between hinge impulses, by spectral bounds and a safety fraction."""
        omega2, damping, transverse_omega2 = bounds
        if omega2 <= 0.0:
            return math.inf
        # Waves along springs with w = pi / interval: excited by omega2 / w, damped by min_damping_time w^2.
        longitudinal = math.pi * root(fraction * self._min_damping_time / omega2, 3)
        transverse = fraction * math.pi / math.sqrt(transverse_omega2 + omega2)
        max_interval = min(fraction * leapfrog_limit(omega2, damping), longitudinal, transverse)
        if damping > 0.0:
            # Delayed damping forces excite such a wave too.
            damped = math.pi * math.sqrt(fraction * self._min_damping_time / damping)
            max_interval = min(max_interval, damped, 0.5 * fraction / damping)
        return max_interval
