# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Energy balance of a motion: work, dissipation, stored energy and residual."""

from __future__ import annotations

from cloth_sim_ros.physics.accounting.work_accumulator import WorkAccumulator
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.state.state import State


class EnergyBalance:
    """Energy sums [J] over the advances of a motion: pass `accumulator` to each advance, then call `add_advance`.

    residual = E - E at the start - work - wind work - recovery work + dissipation.

    Args:
        plan: equations of motion.
        state: state at the start.
        t: time at the start [s].
    """

    def __init__(self, plan: Plan, state: State, t: float = 0.0) -> None:
        self._plan = plan
        #: Accumulates the integrals of one advance.
        self.accumulator = WorkAccumulator(plan.gripper_count, record_power=True, obstacle_count=plan.obstacle_count)
        #: Dissipated energy so far [J].
        self.dissipation = 0.0
        #: Part of it by friction between layers [J].
        self.friction_work = 0.0
        #: Work of grippers and obstacles on the cloth so far [J].
        self.work = 0.0
        #: Work of moving air on the cloth so far [J].
        self.wind_work = 0.0
        #: Energy converted between forms so far, at least [J].
        self.energy_turnover = 0.0
        #: Work of contacts that regain their thickness on the cloth so far [J].
        self.recovery_work = 0.0
        self._kinetic, potential = self._energies(t, state)
        self._start = self._kinetic + potential

    def add_advance(self, t: float, state: State) -> float:
        """Add the advance in `accumulator`, ended at t [s], and reset it; return the residual energy so far [J]."""
        sums = self.accumulator
        dissipation, work, wind_work, recovery_work = sums.dissipation, sums.work, sums.wind_work, sums.recovery_work
        self.dissipation += dissipation
        self.friction_work += sums.friction_work
        self.work += work
        self.wind_work += wind_work
        self.recovery_work += recovery_work
        sums.reset()
        kinetic, potential = self._energies(t, state)
        turnover = abs(kinetic - self._kinetic) + abs(dissipation) + abs(work)
        self.energy_turnover += turnover + abs(wind_work) + abs(recovery_work)
        self._kinetic = kinetic
        return kinetic + potential - self._start - self.work - self.wind_work - self.recovery_work + self.dissipation

    def _energies(self, t: float, state: State) -> tuple[float, float]:
        return self._plan.energies(t, state.x, state.v, state.memory)
