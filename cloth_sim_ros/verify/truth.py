# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Reference solution from a state, with its uncertainty and perturbation amplification."""

from __future__ import annotations

import math
from collections.abc import Sequence

import attrs
import numpy as np

from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.state import State
from cloth_sim_ros.verify.fine import FINE, FINER, ROUNDING, FineSteps, amplification, distance, follow
from cloth_sim_ros.verify.motion import Equations, Motion, RunFrame, starting_state, take_hold

#: Maximum perturbation of a particle's position [m], and of its velocity [m/s].
KICK = 1e-9
#: Error of the reference solution per second, as a fraction of the tolerance.
PART_OF_TOLERANCE = 0.01
#: Substitute for the tolerance of a run with fixed steps, which may be very small [m].
_FINE_ANYHOW = 1e-6
#: Number of parts of a window; later perturbations begin at their borders.
_PARTS = 8


@attrs.frozen(eq=False, kw_only=True)
class Told:
    """Reference solution at the end of a frame, and its uncertainty."""

    #: Positions [m], shape (3, n).
    x: Array
    #: Uncertainty of the positions: difference of the solution and its check [m].
    own: float
    #: Estimated effect of rounding on the positions [m].
    floor: float
    #: Maximum amplification of three perturbations since the start; nan if not measured.
    growth: float


class Truth:
    """Reference solution, its check, and perturbed copies, all from one state.

    Args:
        state: initial state.
        seed: random seed of the perturbations.
        measure_amplification: True to integrate the perturbed copies.
    """

    def __init__(self, state: State, *, seed: int, kicks: bool = True) -> None:
        self._fine, self._finer = Motion(state), Motion(state)
        self._kicked = [Motion(state) for _ in range(3)] if kicks else []
        self._seed: int | None = seed
        self._stretches = 0
        self._steps = FineSteps(0.0)

    def frame(self, equations: Equations, frame: RunFrame) -> Told:
        """Advance by a frame."""
        fine, finer, kicked = self._fine, self._finer, self._kicked
        take_hold([fine, finer, *kicked], frame)
        plan = equations.plan(frame, fine)
        if self._seed is not None:
            self._kick(plan.model.inverse_masses > 0.0, self._seed)
            self._seed = None
        self._steps.rate = fine_rate(frame.tolerance)
        fine.now, lengths = self._steps.frame(plan, frame.t, frame.duration, fine.now, frame.step)
        for motion in kicked:
            motion.now = follow(equations.plan(frame, motion), frame.t, lengths, motion.now)
        finer.now = follow(equations.plan(frame, finer), frame.t, lengths, finer.now, FINER)
        self._stretches += len(lengths)
        growth = max((distance(motion.x, fine.x) / KICK for motion in kicked), default=math.nan)
        coordinate = float(np.abs(finer.x).max())
        rounding = ROUNDING * coordinate * amplification(FINE) * math.sqrt(self._stretches)
        return Told(
            x=finer.x,
            own=distance(fine.x, finer.x),
            floor=rounding * (max(1.0, growth) if kicked else 1.0),
            growth=growth,
        )

    def _kick(self, free: np.ndarray, seed: int) -> None:
        if not self._kicked:
            return
        random = np.random.default_rng(seed)
        x, still = self._fine.x, np.zeros_like(self._fine.x)
        alone, together, by_velocity = self._kicked
        alone.kick(random_kick(x, free, random, smooth=False), still)
        together.kick(random_kick(x, free, random, smooth=True), still)
        # No rough perturbation of velocities: opposed velocities of neighbours decay quickly.
        by_velocity.kick(still, random_kick(x, free, random, smooth=True))


def fine_rate(tolerance: float | None) -> float:
    """Return the permitted error per second of the reference solution [m/s]."""
    return PART_OF_TOLERANCE * (tolerance or _FINE_ANYHOW)


def random_kick(x: Array, free: np.ndarray, random: np.random.Generator, *, smooth: bool) -> Array:
    """Return a perturbation, shape (3, n), with maximum norm `PERTURBATION`.

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
    return np.asarray(field * (KICK / largest if largest else 0.0))


def frame_truth(equations: Equations, frame: RunFrame, state: State) -> Array:
    """Return the reference positions (3, n) [m] at a frame's end from a state at its beginning."""
    motion = Motion(state)
    motion.take_hold(frame)
    plan = equations.plan(frame, motion)
    steps = FineSteps(fine_rate(frame.tolerance))
    now, _ = steps.frame(plan, frame.t, frame.duration, motion.now, frame.step)
    return now.x


def later_growth(equations: Equations, frames: Sequence[RunFrame]) -> float:
    """Return the maximum amplification of perturbations made within a window, up to any later frame of it.

    A motion may damp a perturbation at the window's beginning and amplify a later one: a strip falls, then buckles.
    """
    most = 0.0
    for begin in sorted({part * len(frames) // _PARTS for part in range(1, _PARTS)} - {0}):
        truth = Truth(starting_state(frames[begin]), seed=frames[begin].index)
        for frame in frames[begin:]:
            if frame.reset and frame is not frames[begin]:
                break
            most = max(most, truth.frame(equations, frame).growth)
    return most
