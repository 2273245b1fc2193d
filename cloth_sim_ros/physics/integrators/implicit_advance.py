# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One advance of the implicit method: Newton's iteration, step size control, descent steps."""

from __future__ import annotations

import math
from typing import Protocol

import attrs
import numpy as np

from cloth_sim_ros.physics.accounting.implicit_steps import ImplicitStep, accumulate_step, external_work
from cloth_sim_ros.physics.accounting.work_accumulator import WorkAccumulator
from cloth_sim_ros.physics.contact.thickness import relative_growth
from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.integrators.base import Advance, ToleranceMissedError, UnstableError
from cloth_sim_ros.physics.integrators.extrapolation_tableau import VELOCITY_ERROR_TIME
from cloth_sim_ros.physics.integrators.limit import steps_for
from cloth_sim_ros.physics.integrators.stage_matrix import ParticleBlocks, iteration_cost, stage_matrix
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.gripper_path import rigid_velocities
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.state.controller_state import THICKNESS_KEY
from cloth_sim_ros.physics.state.controller_state import ImplicitState as Memory
from cloth_sim_ros.physics.state.state import State

#: The diagonal coefficient of Alexander's two-stage method: 1 - 1/sqrt(2).
GAMMA = 1.0 - math.sqrt(0.5)
#: The error constant of the method: coefficient of z^3 in its stability function minus exp(z). With g = `GAMMA`,
#: R(z) = (1 + (1 - 2 g) z) / (1 - g z)^2 = 1 + z + z^2 / 2 + (4 g^3 + 3 g^2 (1 - 2 g)) z^3 + ...
_ERROR_CONSTANT = abs(GAMMA * GAMMA * (4.0 * GAMMA + 3.0 * (1.0 - 2.0 * GAMMA)) - 1.0 / 6.0)
#: Error constant of velocities where the force depends on time alone: quadrature at g h and h.
_QUADRATURE_CONSTANT = 0.5 * (GAMMA * GAMMA * (1.0 - GAMMA) + GAMMA - 1.0 / 3.0)
#: Fraction of the first stage's error over which forces are differenced: its square is negligible, and rounding of
#: positions enters the velocities by 1e-13 m / h.
_DIFFERENCE = 1e-3
#: Safety margin of the predicted next correction, because the prediction has the right order of magnitude only.
_PREDICTION_MARGIN = 0.1
#: Fraction of a step's error budget at which its iteration ends.
_CONVERGENCE_FRACTION = 0.2
#: Largest ratio of successive corrections from iteration `_SLOW_FROM` on.
_SLOW_RATIO = 0.5
#: Iterations with full corrections before the line search begins, and the smallest fraction that it tries.
_FULL_STEP_ITERATIONS, _MIN_STEP_FRACTION = 4, 1e-3
#: Maximum number of attempts of an advance.
_MAX_ATTEMPTS = 12
#: Maximum number of steps of an advance. Steps that fail at this number are neither repeated nor halved: they are 8 us
#: long in a frame of 60 Hz, in which an obstacle at 120 m/s moves by a millimetre.
_MAX_STEPS = 2048
#: Size of the last correction without a tolerance [m].
CONVERGED_DISTANCE = 1e-9
#: Largest relative growth of a contact thickness in a step. Beyond it corrections below the tolerance may correspond
#: to an arbitrary contact energy.
_MAX_THICKNESS_GROWTH = 0.1
#: Maximum number of iterations of a stage; beyond it the step becomes smaller.
MAX_ITERATIONS = 30
#: From this iteration on, slow convergence ends a stage too. The matrix omits the negative stiffness of compressed
#: springs, so the iteration may converge linearly or not at all.
_SLOW_FROM = 6
#: Iterations of a descent step: eight of them leave a few thousandths of the possible decrease.
DESCENT_ITERATIONS = 8
#: Energy that a step may create, relative to the energy that it moves: the error of a good step has either sign.
_MAX_ENERGY_GAIN = 1e-4
#: Rounding of a sum of energies, relative to it.
_ROUNDING = 1e-12


class ImplicitSettings(Protocol):
    """Protocol of the settings of the implicit method: name, fixed step [s], tolerance [m], work limit."""

    name: str
    step: float | None
    tolerance: float | None
    work: float


class ImplicitAdvance:
    """Computation of one advance by the implicit method, by one call of `run`: steps, budgets and counters."""

    def __init__(
        self,
        integrator: ImplicitSettings,
        plan: Plan,
        state: State,
        t: float,
        duration: float,
        accumulator: WorkAccumulator | None,
        *,
        is_strict: bool = False,
        max_evaluations: float = math.inf,
        factorizes: bool = True,
    ) -> None:
        self._integrator, self._plan, self._state, self._accumulator = integrator, plan, state, accumulator
        self._t, self._duration = t, duration
        tolerance = integrator.tolerance
        self._budget = math.inf if tolerance is None else CONSTANTS.error_budget_fraction * duration * tolerance
        self._memory = Memory.load(state)
        #: Prescribed particles, and true for each particle that is neither prescribed nor anchored.
        self._prescribed, self._is_free = plan.prescribed_particles(), plan.free_particles()
        self._matrix = stage_matrix(plan.model) if factorizes else ParticleBlocks(plan)
        self._evaluations, self._is_strict = 0, is_strict
        #: Limit of force evaluations of an advance by safe steps, and the reserve for descents in its remaining steps.
        self._max_evaluations, self._reserve = max_evaluations, 0
        self._work_limit = self._max_steps = math.inf
        if integrator.work and integrator.step is None:
            self._work_limit = integrator.work * duration * 1e9 / iteration_cost(plan.model)
        #: Time offset of obstacles while a descent computes velocities [s].
        self._obstacle_time_offset = 0.0
        #: True once the work limit allows no finer steps.
        self._exhausted = False

    def run(self) -> Advance:
        """Move the state by the duration, with finer steps until the error fits the budget or work runs out; report it.

        Raises:
            UnstableError: if the motion does not stay finite.
            ToleranceMissedError: if strict, with contact, and no solution of a step is found.
        """
        state, memory, integrator = self._state, self._memory, self._integrator
        min_steps = 1 if integrator.step is None else steps_for(self._duration, integrator.step)
        contact = self._plan.contact
        if contact is not None and (end_thickness := contact.force.controls.recovery.target) is not None:
            growth = relative_growth(state.memory[THICKNESS_KEY], end_thickness)
            min_steps = max(min_steps, math.ceil(growth / _MAX_THICKNESS_GROWTH))
        is_step_known = memory.step > 0.0 and self._max_evaluations == math.inf
        steps = max(min_steps, steps_for(self._duration, memory.step)) if is_step_known else min_steps
        start, rejected = state.shallow_copy(), 0
        while True:
            if self._accumulator is not None:
                self._accumulator.reset()
            # If no solution is found at this step size, smaller steps find none either, down to explicit step sizes.
            self._uses_safe_steps = steps >= CONSTANTS.implicit_finish_steps
            evaluations_before = self._evaluations
            error = self._take_steps(steps)
            if error is not None and (error <= self._budget or self._exhausted or self._n_unsolved):
                break
            factor = 2.0 if error is None else math.sqrt(error / (CONSTANTS.error_target_fraction * self._budget))
            next_steps = max(steps + 1, math.ceil(steps * min(factor, 2.0 * CONSTANTS.max_refinement_factor)))
            step_evaluations = max(1, self._evaluations - evaluations_before) / steps
            self._max_steps = self._work_limit / step_evaluations
            self._exhausted = self._evaluations + step_evaluations * next_steps > self._work_limit
            if self._exhausted and error is not None:
                break
            state.restore(start)
            rejected += 1
            if rejected > _MAX_ATTEMPTS or (error is None and (self._halves_failed_steps or steps >= _MAX_STEPS)):
                hint = "; do obstacles leave the cloth room?" if self._plan.contact is not None else ""
                h = self._duration / (_MAX_STEPS if self._halves_failed_steps else steps)
                raise self._with_evaluations(UnstableError(f"implicit: steps of {h:.3g} s did not stay finite{hint}"))
            steps = max(steps, round(CONSTANTS.implicit_finish_steps)) if self._exhausted else next_steps
        flagged = int(error > self._budget) + self._n_unsolved
        memory.step = self._duration / self._next_step_count(steps, min_steps, error)
        memory.store(state)
        return Advance(
            steps=self._n_steps,
            evaluations=self._evaluations,
            step=self._min_step,
            limit=math.inf,
            rejected=rejected,
            integrator=integrator.name,
            limited_by=self._limited_by(steps, min_steps),
            error=error,
            flagged=flagged,
            reason=self._describe(self._min_step, steps),
        )

    def _with_evaluations(self, error: UnstableError) -> UnstableError:
        error.evaluations = self._evaluations
        return error

    @property
    def _halves_failed_steps(self) -> bool:
        """True if a step without a result is repeated as two halves."""
        return self._uses_safe_steps and self._plan.contact is not None

    def _limited_by(self, steps: int, min_steps: int) -> str:
        if self._integrator.step is not None:
            return "step"
        return "work" if self._exhausted else ("frame" if steps == min_steps else "accuracy")

    def _next_step_count(self, steps: int, min_steps: int, error: float) -> int:
        """Return the number of steps for the next advance, from this one's error: at least half of the present one."""
        if self._integrator.tolerance is None:
            return max(min_steps, steps // 2)
        if self._n_unsolved:
            return steps
        target = CONSTANTS.error_target_fraction * self._budget
        required_steps = math.ceil(steps * math.sqrt(max(error, 1e-30) / target))
        # A frame too violent for any number of steps does not increase that of the next one, which may be quiet.
        exceeds_work = self._exhausted and required_steps > self._max_steps
        return max(1, steps // 2, min(required_steps, steps) if exceeds_work else required_steps)

    def _describe(self, h: float, steps: int) -> str:
        tolerance = self._integrator.tolerance
        if self._integrator.step is not None or tolerance is None:
            return f"implicit: order 2, step {h:.3g} s, no tolerance"
        if steps == 1:
            return f"implicit: order 2, one step a frame; it holds the tolerance {tolerance:g} m"
        return f"implicit: order 2, step {h:.3g} s set by the tolerance {tolerance:g} m"

    def _take_steps(self, steps: int) -> float | None:
        """Move the state by equal steps; return the sum of their errors [m], or None if a step has no result."""
        h = self._duration / steps
        distance = _CONVERGENCE_FRACTION * self._budget / steps
        self._convergence_distance = distance if math.isfinite(self._budget) else CONVERGED_DISTANCE
        self._curvature, self._n_unsolved, self._n_steps, self._min_step = math.inf, 0, 0, h
        state, error_sum = self._state, 0.0
        if self._prescribed.size:
            state.x, state.v = state.x.copy(), state.v.copy()
            impulses = self._plan.prescribe(self._t, state.x, state.v)
            if self._accumulator is not None:
                self._accumulator.add_gripper_impulses(impulses)
        guess = np.empty_like(state.x)
        self._plan.accelerations(self._t, state.x, state.v, guess, state.memory)
        for k in range(steps):
            self._reserve = DESCENT_ITERATIONS * (steps - k)
            step_result = self._take_step(self._t + k * h, h, guess)
            if step_result is None:
                return None
            error, guess = step_result
            error_sum += error
        return error_sum

    def _take_step(self, t: float, h: float, guess: Array) -> tuple[float, Array] | None:
        """Move the state by a step, or by halves with contact; return error [m] and last acceleration, or None.

        Returns:
            Its error [m] and its last acceleration [m/s^2]; None if even the smallest step has no result.
        """
        state = self._state
        step, n_unsolved = self._solve_step(t, h, guess), 0
        if self._uses_safe_steps and (step is None or self._creates_energy(t, h, step)):
            if self._is_strict and self._halves_failed_steps:
                # Such a step would flag the frame, or be halved. Explicit steps replace it.
                text = f"implicit: a step of {h:.3g} s has no solution that can be found"
                raise self._with_evaluations(ToleranceMissedError(text))
            # A descent step is inaccurate, but stable.
            n_unsolved = 1
            step = self._descent_step(t, h, guess)
        if step is None or not (np.isfinite(step.x).all() and np.isfinite(step.v).all()):
            if not self._halves_failed_steps or h * _MAX_STEPS < 1.5 * self._duration:
                return None
            # If an obstacle moved too far for the cloth to evade, half its displacement may be small enough.
            half_step = 0.5 * h
            first = self._take_step(t, half_step, guess)
            second = None if first is None else self._take_step(t + half_step, half_step, first[1])
            return None if first is None or second is None else (first[0] + second[0], second[1])
        if self._accumulator is not None:
            accumulate_step(self._accumulator, self._plan, t, h, step, state.memory)
        state.x, state.v = step.x, step.v
        work = self._plan.update_after_step(t + h, h, state)
        if self._accumulator is not None:
            self._accumulator.add_dissipation(work)
        self._n_unsolved += n_unsolved
        self._n_steps, self._min_step = self._n_steps + 1, min(self._min_step, h)
        return step.error, step.a

    def _solve_step(self, t: float, h: float, guess: Array) -> ImplicitStep | None:
        """Return one step of the Runge-Kutta method, the state unchanged; None if a stage does not converge."""
        x, v, d = self._state.x, self._state.v, GAMMA * h
        first = self._solve_stage(t + d, x, v, d, guess)
        if first is None:
            return None
        k1x, k1v = first
        # The second stage starts from the end of the first one's slopes.
        base_x, base_v = x + (h - d) * k1x, v + (h - d) * k1v
        second = self._solve_stage(t + h, base_x, base_v, d, k1v)
        if second is None:
            return None
        k2x, k2v = second
        error = _ERROR_CONSTANT * h * h / (1.0 - GAMMA) * _max_length(k1v - k2v)
        middle, end, end_v = x + d * k1x, base_x + d * k2x, base_v + d * k2v
        if self._prescribed.size:
            self._plan.prescribe(t + d, middle, k1x)
            self._plan.prescribe(t + h, end, end_v)
        if self._ccd_hits(t, h, end):
            return None
        if self._budget < math.inf:
            error += self._velocity_displacement(t + h, h, end, end_v, (guess, k1v, k2v))
        stages = ((t + d, h - d, middle, k1x), (t + h, d, end, k2x))
        return ImplicitStep(end, end_v, k2v, error, stages)

    def _velocity_displacement(
        self, t: float, h: float, x: Array, v: Array, rates: tuple[Array, Array, Array]
    ) -> float:
        """Return the displacement [m] that the velocity error of a step causes later (docs/derivations/implicit.md).

        The matrix of the last iteration divides errors of stiff modes by 1 + d^2 w^2. Forces at the start of a frame
        are noisy there, and the method damps these modes.

        Args:
            t: time at the end [s].
            h: length of the step [s].
            x: positions at its end [m].
            v: velocities there [m/s].
            rates: accelerations at the start, of the first and of the second stage [m/s^2].
        """
        plan, memory, d, (a0, a1, a2) = self._plan, self._state.memory, GAMMA * h, rates
        jerk = (a2 - a1) / (h - d)
        snap = 2.0 / h * (jerk - (a1 - a0) / d)
        # The first stage is off by d^2 a2 / 2 in positions and d^2 jerk / 2 in velocities; forces carry this on.
        scale = _DIFFERENCE * 0.5 * d * d
        a, shifted = np.empty_like(x), np.empty_like(x)
        plan.accelerations(t, x, v, a, memory)
        plan.accelerations(t, x + scale * a2, v + scale * jerk, shifted, memory)
        if not np.isfinite(shifted).all():
            # Inside an obstacle.
            shifted = a
        errors = _QUADRATURE_CONSTANT * h * h * h * snap + (h - d) / _DIFFERENCE * (shifted - a)
        # The rest of Newton's iteration.
        errors -= d * (a - a2)
        errors *= self._is_free
        errors[:, self._prescribed] = 0.0
        errors = plan.momenta(x, errors)
        self._matrix.solve(errors)
        displacement, _ = plan.velocity_displacement(t, x, errors, VELOCITY_ERROR_TIME)
        return displacement

    def _descent_step(self, t: float, h: float, guess: Array) -> ImplicitStep | None:
        """Return an implicit Euler step by descent, stable but inaccurate, the state unchanged; None if it intersects.

        Returns:
            The step; None if an obstacle intersects the cloth for every result.
        """
        x, v = self._state.x, self._state.v
        # Grippers are at their middle position: with the end position the cloth would gain more than their work.
        u = self._descend_clear(t + 0.5 * h, x, v, h, guess)
        end = x + h * u
        if self._ccd_hits(t, h, end):
            return None
        deviation, end_v = u - (v + h * guess), u
        if self._prescribed.size:
            end_v = u.copy()
            self._plan.prescribe(t + h, end, end_v)
            deviation[:, self._prescribed] = 0.0
        error = 0.5 * h * _max_length(deviation)
        # Simpson's rule along the straight path of the step: a gripper may reverse within it.
        sixth = h / 6.0
        stages = ((t, sixth, x, u), (t + 0.5 * h, 4.0 * sixth, x + 0.5 * h * u, u), (t + h, sixth, end, u))
        step = ImplicitStep(end, end_v, (u - v) / h, error, stages, acts_at_end=self._plan.contact is not None)
        gain, kinetic, _ = self._energy_gain(t, h, step)
        if gain > 0.0:
            # The minimisation bounds the potential energy by the total energy before: a lower speed suffices.
            speed_factor = math.sqrt(max(0.0, 1.0 - gain / kinetic)) if kinetic > 0.0 else 0.0
            end_v = speed_factor * u
            step = attrs.evolve(step, v=end_v, a=(end_v - v) / h)
            if self._prescribed.size:
                self._plan.prescribe(t + h, end, end_v)
        return step

    def _ccd_hits(self, t: float, h: float, end: Array) -> bool:
        """Return true if the straight path of a step leads through an obstacle or the cloth, or ends too close.

        At such an end a later step could not exclude an intersection.
        """
        contact = self._plan.contact
        if contact is None:
            return False
        start, memory = self._state.x, self._state.memory
        return contact.ccd_hits(t, h, start, end, memory) or contact.ccd_hits(t + h, 0.0, end, end, memory)

    def _creates_energy(self, t: float, h: float, step: ImplicitStep) -> bool:
        gain, kinetic, work = self._energy_gain(t, h, step)
        return not gain <= _MAX_ENERGY_GAIN * (kinetic + abs(work))

    def _energy_gain(self, t: float, h: float, step: ImplicitStep) -> tuple[float, float, float]:
        """Return the energy that a step created, the kinetic energy at its end, and the external work [J].

        The work is subtracted from the created energy. The kinetic energy is that of free particles, because the motion
        of prescribed ones is given.
        """
        state = self._state
        energy_before = self._plan.energy(t, state.x, state.v, state.memory)
        energy_after = self._plan.energy(t + h, step.x, step.v, state.memory)
        v = step.v * self._is_free
        kinetic = self._plan.energies(t + h, step.x, v, state.memory)[0]
        work = external_work(self._plan, t, h, step, state.memory)
        return energy_after - energy_before - work - _ROUNDING * abs(energy_before), kinetic, work

    def _solve_stage(self, t: float, x: Array, v: Array, d: float, guess: Array) -> tuple[Array, Array] | None:
        """Solve a = a(t, x + d u, u), u = v + d a by Newton's iteration; return u, a, or None."""
        x, v = self._stage_start(t, x, v, d)
        u = v + d * guess * self._is_free
        previous_size = math.inf
        for iteration in range(MAX_ITERATIONS):
            if self._uses_safe_steps and self._evaluations + 1 + self._reserve > self._max_evaluations:
                return None
            correction = self._newton_correction(t, x, v, d, u)
            if iteration >= _FULL_STEP_ITERATIONS:
                correction *= self._line_search(t, x, v, d, u, correction)
            u += correction
            size = d * _max_length(correction)
            if not math.isfinite(size) or (iteration >= _SLOW_FROM and size > _SLOW_RATIO * previous_size):
                return None
            if previous_size < math.inf:
                previous_curvature = self._curvature if self._curvature < math.inf else 0.0
                self._curvature = max(0.5 * previous_curvature, size / (previous_size * previous_size))
            # Newton's iteration converges quadratically: the next correction is about curvature * size^2.
            predicted_size, limit = self._curvature * size * size, self._convergence_distance
            if size <= limit or predicted_size <= _PREDICTION_MARGIN * limit:
                return u, (u - v) / d
            previous_size = size
        return None

    def _stage_start(self, t: float, x: Array, v: Array, d: float) -> tuple[Array, Array]:
        """Return x and v of a stage's start, changed so that prescribed particles reach their points at time t [s]."""
        if not self._prescribed.size:
            return x, v
        x, v = x.copy(), v.copy()
        self._plan.prescribe(t, x, v)
        x[:, self._prescribed] -= d * v[:, self._prescribed]
        return x, v

    def _descend_clear(self, t: float, x: Array, v: Array, d: float, guess: Array) -> Array:
        """Return velocities u [m/s] of a stage that decrease its objective, with obstacles at their end positions.

        The cloth must be clear of obstacles there.
        """
        contact = self._plan.contact
        if contact is None:
            return self._descend(t, x, v, d, guess)
        self._obstacle_time_offset = 0.5 * d
        contact.set_time_offset(self._obstacle_time_offset)
        try:
            return self._descend(t, x, v, d, guess)
        finally:
            self._obstacle_time_offset = 0.0
            contact.set_time_offset(0.0)

    def _descend(self, t: float, x: Array, v: Array, d: float, guess: Array) -> Array:
        """Return velocities u [m/s] that decrease a stage's objective, by Newton steps from the best of several starts.

        Starts are the extrapolated motion, the present velocities, rest, and motions with each moving obstacle, which
        keep their distance from it.
        """
        is_free = self._is_free
        starts = [v + d * guess * is_free, v.copy(), np.zeros_like(v)]
        if self._plan.contact is not None:
            paths = self._plan.contact.force.paths
            moving_paths = [row for row in paths if row[4:13].any() or row[17:26].any()]
            starts += [rigid_velocities(row, t - 0.5 * d, d, x) * is_free for row in moving_paths]
        if self._prescribed.size:
            # The chord of their path in this step.
            end, unused = x.copy(), v.copy()
            self._plan.prescribe(t + 0.5 * d, end, unused)
            for start in starts:
                start[:, self._prescribed] = ((end - x) / d)[:, self._prescribed]
        objectives = [self._objective(t, x, v, d, start) for start in starts]
        best = min(range(len(starts)), key=lambda i: objectives[i] if math.isfinite(objectives[i]) else math.inf)
        u = starts[best]
        for _ in range(DESCENT_ITERATIONS):
            correction = self._newton_correction(t, x, v, d, u)
            fraction = self._line_search(t, x, v, d, u, correction)
            if fraction <= _MIN_STEP_FRACTION:
                break
            u += fraction * correction
        return u

    def _newton_correction(self, t: float, x: Array, v: Array, d: float, u: Array) -> Array:
        """Return Newton's correction of a stage's velocities u [m/s], shape (3, n); NaN inside an obstacle."""
        memory = self._state.memory
        positions, a = x + d * u, np.empty_like(x)
        self._plan.accelerations(t, positions, u, a, memory)
        self._evaluations += 1
        if (self._plan.contact is not None or self._plan.carries_air) and not np.isfinite(a).all():
            # Inside an obstacle there is no correction.
            return np.full_like(a, np.nan)
        correction = self._plan.momenta(positions, v + d * a - u) * self._is_free
        try:
            self._matrix.update(t, positions, d, memory, self._prescribed)
        except UnstableError:
            if not self._plan.carries_air:
                raise
            # Forces of carried air grow with the square of the speed, so that the iteration may diverge.
            return np.full_like(a, np.nan)
        self._matrix.solve(correction)
        return correction

    def _line_search(self, t: float, x: Array, v: Array, d: float, u: Array, correction: Array) -> float:
        """Return the fraction of a correction to take: the largest power of 1/2 that decreases the stage's objective.

        The objective is ``1/2 |u - v|^2_M + E(x + d u) + d/2 u'D u`` while the damping matrix D is nearly constant.
        """
        fraction, limit = 1.0, self._objective(t, x, v, d, u)
        limit += _ROUNDING * abs(limit)
        while fraction > _MIN_STEP_FRACTION and not self._objective(t, x, v, d, u + fraction * correction) <= limit:
            fraction *= 0.5
        return fraction

    def _objective(self, t: float, x: Array, v: Array, d: float, u: Array) -> float:
        positions, plan, memory = x + d * u, self._plan, self._state.memory
        if self._uses_safe_steps and self._ccd_hits(t - 0.5 * d - self._obstacle_time_offset, d, positions):
            return math.inf
        # The force of moving air is nearly constant and has no potential.
        dissipation = 0.5 * plan.dissipation(t, positions, u, memory) - plan.external_power(t, positions, u, memory)
        return plan.energy(t, positions, u - v, memory) + d * dissipation


def _max_length(vectors: Array) -> float:
    """Return the largest length of vectors (3, n); infinite if any is not finite."""
    x, y, z = vectors
    square = float((x * x + y * y + z * z).max())
    return math.sqrt(square) if math.isfinite(square) else math.inf
