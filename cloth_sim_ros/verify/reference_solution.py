# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Reference solution from a state, with its uncertainty and perturbation amplification."""

from __future__ import annotations

import math
from collections.abc import Sequence

import attrs
import numpy as np

from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.verify.reference_integrator import (
    CHECK_STEP_COUNTS,
    STEP_COUNTS,
    UNIT_ROUNDOFF,
    ReferenceIntegrator,
    integrate_intervals,
    max_distance,
    rounding_amplification,
)
from cloth_sim_ros.verify.reference_motion import (
    Equations,
    ReferenceMotion,
    SimulatedFrame,
    apply_grasps,
    starting_state,
)

#: Maximum perturbation of a particle's position [m], and of its velocity [m/s].
PERTURBATION = 1e-9
#: Error of the reference solution per second, as a fraction of the tolerance.
ERROR_BUDGET_FRACTION = 0.01
#: Substitute for the tolerance of a run with fixed steps, which may be very small [m].
_DEFAULT_TOLERANCE = 1e-6
#: Number of parts of a window; later perturbations begin at their borders.
_N_PARTS = 8


@attrs.frozen(eq=False, kw_only=True)
class ReferenceResult:
    """Reference positions at the end of a frame, their uncertainty, and the growth factor of small perturbations."""

    #: Positions [m], shape (3, n).
    x: Array
    #: Uncertainty of the positions: difference of the solution and its check [m].
    uncertainty: float
    #: Estimated effect of rounding on the positions [m].
    rounding_floor: float
    #: Largest of the factors by which three small perturbations have grown since the start; nan if not measured.
    amplification: float


class ReferenceSolution:
    """Reference motion, a check with other step counts, and perturbed copies, all from one state.

    Args:
        state: initial state.
        seed: random seed of the perturbations.
        measure_amplification: True to integrate the perturbed copies.
    """

    def __init__(self, state: State, *, seed: int, measure_amplification: bool = True) -> None:
        self._solution, self._check = ReferenceMotion(state), ReferenceMotion(state)
        self._perturbed = [ReferenceMotion(state) for _ in range(3)] if measure_amplification else []
        self._seed: int | None = seed
        self._n_intervals = 0
        self._integrator = ReferenceIntegrator(0.0)

    def advance(self, equations: Equations, frame: SimulatedFrame) -> ReferenceResult:
        """Integrate the motions over the next frame; return reference positions, uncertainty and amplification."""
        solution, check, perturbed = self._solution, self._check, self._perturbed
        apply_grasps([solution, check, *perturbed], frame)
        plan = equations.plan(frame, solution)
        if self._seed is not None:
            self._perturb(plan.model.inverse_masses > 0.0, self._seed)
            self._seed = None
        self._integrator.rate = reference_error_rate(frame.tolerance)
        start = solution.state
        solution.state, lengths = self._integrator.integrate_frame(plan, frame.t, frame.duration, start, frame.step)
        for motion in perturbed:
            motion.state = integrate_intervals(equations.plan(frame, motion), frame.t, lengths, motion.state)
        plan = equations.plan(frame, check)
        check.state = integrate_intervals(plan, frame.t, lengths, check.state, CHECK_STEP_COUNTS)
        self._n_intervals += len(lengths)
        amplifications = (max_distance(motion.x, solution.x) / PERTURBATION for motion in perturbed)
        max_amplification = max(amplifications, default=math.nan)
        coordinate = float(np.abs(check.x).max())
        rounding = UNIT_ROUNDOFF * coordinate * rounding_amplification(STEP_COUNTS) * math.sqrt(self._n_intervals)
        floor = rounding * (max(1.0, max_amplification) if perturbed else 1.0)
        error = max_distance(solution.x, check.x)
        return ReferenceResult(x=check.x, uncertainty=error, rounding_floor=floor, amplification=max_amplification)

    def _perturb(self, free: np.ndarray, seed: int) -> None:
        if not self._perturbed:
            return
        random = np.random.default_rng(seed)
        x, zero = self._solution.x, np.zeros_like(self._solution.x)
        rough_position, smooth_position, smooth_velocity = self._perturbed
        rough_position.perturb(random_perturbation(x, free, random, smooth=False), zero)
        smooth_position.perturb(random_perturbation(x, free, random, smooth=True), zero)
        # No rough perturbation of velocities: opposed velocities of neighbours decay quickly.
        smooth_velocity.perturb(zero, random_perturbation(x, free, random, smooth=True))


def reference_error_rate(tolerance: float | None) -> float:
    """Return the permitted error of the reference solution per second [m/s]: a hundredth of the tolerance, if set."""
    return ERROR_BUDGET_FRACTION * (tolerance or _DEFAULT_TOLERANCE)


def random_perturbation(x: Array, free: np.ndarray, random: np.random.Generator, *, smooth: bool) -> Array:
    """Return displacements of free particles, shape (3, n), the largest of length `PERTURBATION` [m].

    A smooth one excites slow modes of the whole sheet; independent ones of each particle excite fast local modes.
    """
    if smooth:
        size = float(np.ptp(x, axis=1).max()) or 1.0
        field = np.repeat(random.normal(size=(3, 1)), x.shape[1], axis=1)
        for _ in range(4):
            wave, phase = random.normal(scale=4.0 / size, size=3), random.uniform(0.0, 2.0 * np.pi)
            field += random.normal(size=(3, 1)) * np.cos(wave @ x + phase)
    else:
        field = random.normal(size=x.shape)
        field /= np.sqrt(np.square(field).sum(axis=0))
    field = field * free
    largest = float(np.sqrt(np.square(field).sum(axis=0).max()))
    return np.asarray(field * (PERTURBATION / largest if largest else 0.0))


def reference_positions(equations: Equations, frame: SimulatedFrame, state: State) -> Array:
    """Integrate a frame by the reference integrator from a state at its start; return end positions (3, n) [m]."""
    motion = ReferenceMotion(state)
    motion.apply_grasps(frame)
    plan = equations.plan(frame, motion)
    integrator = ReferenceIntegrator(reference_error_rate(frame.tolerance))
    end_state, _ = integrator.integrate_frame(plan, frame.t, frame.duration, motion.state, frame.step)
    return end_state.x


def later_amplification(equations: Equations, frames: Sequence[SimulatedFrame]) -> float:
    """Return the largest factor by which perturbations that begin within a window grow, up to any later frame of it.

    A motion may damp a perturbation at the window's beginning and amplify a later one: a strip falls, then buckles.
    """
    largest = 0.0
    for first in sorted({part * len(frames) // _N_PARTS for part in range(1, _N_PARTS)} - {0}):
        reference = ReferenceSolution(starting_state(frames[first]), seed=frames[first].index)
        for frame in frames[first:]:
            if frame.reset and frame is not frames[first]:
                break
            largest = max(largest, reference.advance(equations, frame).amplification)
    return largest
