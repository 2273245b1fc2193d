# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Precision rule: selects single precision if its measured effect fits the error budget.

The budget protects positions. Energies need a further bound. Rounding of forces excites neighbours against each other,
and damping dissipates this energy. Therefore the power is measured too; in one second it may supply a small fraction of
the kinetic energy (docs/derivations/single_precision.md).
"""

from __future__ import annotations

import math

import numpy as np

from cloth_sim_ros.physics.accounting.work_accumulator import WorkAccumulator
from cloth_sim_ros.physics.arithmetic.arrays import largest_component, largest_distance, weighted_dot
from cloth_sim_ros.physics.arithmetic.deterministic_math import ordered_sum, root
from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.integrators.extrapolation_tableau import VELOCITY_ERROR_TIME, rounding_amplification
from cloth_sim_ros.physics.integrators.limit import steps_for
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.state.controller_state import PrecisionState, RoundingNoiseState
from cloth_sim_ros.physics.state.state import State

#: Relative spacing of single precision; a run changes by at least some tenths of it, relative to the sheet.
_SPACING = 2.0**-24
#: Time over which energy input of rounding is compared with the kinetic energy [s]: that of the error bound.
_COMPARISON_TIME = 1.0
#: Number of frames in which the power is measured; the largest counts. A flat sheet of 65 x 65 over one metre has
#: coordinates without rounding until it moves.
_MAX_SAMPLES = 4.0
#: Attempts in single precision that may miss the budget. Rounding may be the cause; finer steps do not reduce it.
_MAX_MISSES = 1


class PrecisionRule:
    """Rule that chooses single or double precision for one advance.

    Args:
        plan: equations of motion.
        state: at the start; it has the measured effect.
        duration: of the advance [s].
        budget: error budget of the advance [m].
    """

    def __init__(self, plan: Plan, state: State, duration: float, budget: float) -> None:
        self._plan, self._duration = plan, duration
        self.memory, self.noise = PrecisionState.load(state), RoundingNoiseState.load(state)
        #: Attempts that missed the budget.
        self.n_misses = 0
        self._rounding_budget = CONSTANTS.single_precision_budget_fraction * budget
        #: Allowed uncertainty of an error estimate [m]; it can still show that an error is far below the budget.
        self._estimate_uncertainty = CONSTANTS.estimate_trust_factor * CONSTANTS.low_error_fraction * budget

    def store(self, state: State) -> None:
        """Store the measured effects of rounding on positions and energy in a state."""
        self.memory.store(state)
        if self.noise.power >= 0.0 or RoundingNoiseState.key in state.memory:
            self.noise.store(state)

    def measure(self, t: float, state: State, step: float, n_runs: int) -> int:
        """Measure the effect of single precision by two short runs, unless it is known; return the evaluations spent.

        Args:
            t: time at the start [s].
            state: at the start.
            step: step size [s].
            n_runs: number of combined runs.

        Returns:
            Force evaluations of the measurement.
        """
        if n_runs > 1 or self._plan.model.particle_count < CONSTANTS.single_precision_min_particles:
            return 0
        memory, noise, plan, speed = self.memory, self.noise, self._plan, largest_component(state.v)
        # Sheets at rest use no single precision, and rounding changes all their springs alike.
        if speed == 0.0 or (noise.n_samples >= _MAX_SAMPLES and self._is_known_at(state)):
            return 0
        if not plan.supports_single_precision(self._duration, state.x, state.v, state.memory):
            return 0
        extent = float((state.x.max(axis=1) - state.x.min(axis=1)).max())
        if _SPACING * extent > self._rounding_budget:
            return 0
        # A fraction of the steps is representative: low parts of positions carry the rounding of drifts, and forces
        # restore what they round.
        steps = max(1, int(steps_for(self._duration, step) // CONSTANTS.single_precision_sample_divisor))
        span = steps * step
        runs, dissipation = [], []
        for single in (False, True):
            (run,), _ = plan.runs(
                t,
                span,
                (state.x, state.v),
                [steps],
                single_precision=single,
                record_power=True,
                record_obstacles=True,
                memory=state.memory,
            )
            accumulator = WorkAccumulator(plan.gripper_count, record_power=True, obstacle_count=plan.obstacle_count)
            accumulator.add_runs((1.0,), (run,), span)
            runs.append(run)
            dissipation.append(accumulator.dissipation)
        # What rounding supplies is dissipated, or remains as kinetic energy of the difference and as much in springs.
        dv = runs[1].v - runs[0].v
        supplied = abs(dissipation[1] - dissipation[0]) + weighted_dot(plan.model.masses, dv, dv)
        means = [self._mean(dv, axis) for axis in range(3)]
        if plan.model.inverse_masses.all():
            # Nothing restores the common motion of a sheet without anchors, and its rounding may have one sign.
            products = [self._mean(runs[0].v, axis) * means[axis] for axis in range(3)]
            supplied += abs(plan.model.mass * ordered_sum(products))
        if math.isfinite(supplied):
            noise.n_samples += 1.0
            trust = CONSTANTS.estimate_trust_factor
            displacement, _ = plan.velocity_displacement(t + span, runs[0].x, dv, VELOCITY_ERROR_TIME)
            change = largest_distance(runs[0].x, runs[1].x) + displacement
            memory.rounding = max(memory.rounding, trust * change)
            # What all particles have in common is small beside their noise, and not restored by forces.
            mean_change = root(ordered_sum(mean * mean for mean in means), 2)
            growth = root(self._duration / span, 2)
            memory.common_rounding = max(memory.common_rounding, trust * VELOCITY_ERROR_TIME * mean_change * growth)
            memory.speed = max(memory.speed, largest_component(runs[0].v))
            memory.reach = max(memory.reach, _reach(state.x))
            noise.power = max(noise.power, trust * supplied / span)
        return 2 * (steps + 1)

    def update_kinetic_energy(self, state: State) -> None:
        """Update the recorded kinetic energy [J], with which the power of rounding is compared."""
        noise = self.noise
        if noise.power >= 0.0:
            kinetic_energy = 0.5 * weighted_dot(self._plan.model.masses, state.v, state.v)
            noise.kinetic_energy = max(kinetic_energy, 0.5 * noise.kinetic_energy)

    def allows_single_precision(self, state: State, n_runs: int, *, estimates_error: bool) -> bool:
        """Return True if runs of this advance may use single precision, by its measured effect and the error budget.

        The motion must be large against the amplified rounding error, so that a sheet can come to rest accurately.

        Args:
            state: at the start.
            n_runs: number of combined runs.
            estimates_error: True if a further run estimates the error.
        """
        memory, noise = self.memory, self.noise
        if self.n_misses > _MAX_MISSES or memory.rounding < 0.0:
            return False
        if not 0.0 <= noise.power * _COMPARISON_TIME <= CONSTANTS.max_energy_gain * noise.kinetic_energy:
            return False
        factor = rounding_amplification(n_runs)
        rounding = factor * memory.rounding
        # An error estimate needs one further run.
        if not (rounding <= self._rounding_budget and self.resolves_error(n_runs + estimates_error)):
            return False
        if factor * memory.common_rounding > self._estimate_uncertainty:
            return False
        speed = largest_component(state.v)
        is_large = speed * self._duration > CONSTANTS.single_precision_min_motion * rounding
        return is_large and self._is_known_at(state)

    def require_double(self) -> None:
        """Require double precision until the end of the frame."""
        self.n_misses = _MAX_MISSES + 1

    def resolves_error(self, n_runs: int) -> bool:
        """Return True if rounding in a combination of single-precision runs is small enough for an error estimate.

        The combination is only an estimate. Rounding must be small against the budget, not against the error.
        """
        return rounding_amplification(n_runs) * self.memory.rounding <= self._estimate_uncertainty

    def _is_known_at(self, state: State) -> bool:
        """Return True if the effect of rounding was measured at about these speeds and distances, or above them."""
        trust_factor, memory = CONSTANTS.estimate_trust_factor, self.memory
        is_known = largest_component(state.v) <= trust_factor * memory.speed
        return is_known and _reach(state.x) <= trust_factor * memory.reach

    def _mean(self, dv: Array, axis: int) -> float:
        """Return the mass-weighted mean over free particles of a component of velocity changes [m/s]."""
        model, unit = self._plan.model, np.zeros_like(dv)
        unit[axis] = model.inverse_masses > 0.0
        mass = weighted_dot(model.masses, unit, unit)
        return weighted_dot(model.masses, dv, unit) / mass if mass else 0.0


def _reach(x: Array) -> float:
    """Return the largest distance of positions (3, n) from the first one along an axis [m].

    Positions are rounded relative to the first one.
    """
    return float(np.maximum(x.max(axis=1) - x[:, 0], x[:, 0] - x.min(axis=1)).max())
