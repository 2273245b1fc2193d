# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Engine binding of the plastic lengths of one plan: the state of the friction of bending."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cloth_sim_ros.engine.binding import address, check, float64_address, library
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.forces.hinge_springs import gradient_squares, signed_lengths
from cloth_sim_ros.physics.model.parts import ElementList
from cloth_sim_ros.physics.plan.plan_handle import PlanHandle
from cloth_sim_ros.physics.plan.uncopyable import Uncopyable
from cloth_sim_ros.physics.state.controller_state import MISSING_MEMORY, PLASTIC_LENGTHS_KEY, StateMemory


class PlasticLengths(Uncopyable):
    """Engine binding of hinges' plastic lengths [m], the state of bending friction: uploads and combines them.

    A memory without them, or with those of another cloth, is at rest.

    Args:
        engine_plan: handle of the engine's plan.
        hinges: the hinges with friction.
        inverse_masses: of the model's particles [1/kg], shape (n,).
    """

    def __init__(self, engine_plan: PlanHandle, hinges: ElementList, inverse_masses: Array) -> None:
        self._engine_plan, self._library, self._handle = engine_plan, library(), engine_plan.pointer
        self._rest_lengths, self._stiffness, self._reach = np.ascontiguousarray(hinges.coefficients.T)
        self._shape = (3, len(inverse_masses))
        self._particles, self._inverse_masses = hinges.particles, inverse_masses[hinges.particles]
        # Arrays are never changed, but replaced. Therefore the identity tells if the engine has it.
        self._uploaded: Array | None = None

    def upload(self, memory: StateMemory) -> None:
        """Upload the plastic lengths of a state's memory to the engine, if they changed.

        Raises:
            ValueError: for `MISSING_MEMORY`.
        """
        if memory is MISSING_MEMORY:
            raise ValueError(
                "friction of bending depends on the memory of the state; pass State.memory, or {} for an empty one"
            )
        lengths = memory.get(PLASTIC_LENGTHS_KEY)
        if lengths is not self._uploaded:
            fitting = self.lengths_of(memory)
            addresses = float64_address(PLASTIC_LENGTHS_KEY, fitting, fitting.shape)
            check(self._library.cloth_plan_plastic_lengths(self._handle, addresses))
            self._uploaded = lengths

    def lengths_of(self, memory: StateMemory) -> Array:
        """Return the plastic lengths of a memory [m], or the rest lengths if it has none that fit, shape (hinges,)."""
        lengths = memory.get(PLASTIC_LENGTHS_KEY)
        return lengths if lengths is not None and lengths.shape == self._rest_lengths.shape else self._rest_lengths

    def end_buffer(self, runs: int) -> Array:
        """Return an uninitialised array for the plastic lengths at the ends of runs, shape (runs, hinges)."""
        return np.empty((runs, len(self._rest_lengths)))

    def combine(self, x: Array, ends: Array, weights: Sequence[float]) -> tuple[Array, float]:
        """Return the weighted plastic lengths of runs, mapped to the yield surface, and the work of the mapping [J].

        They are returned to the yield surface at the combined positions.

        Args:
            x: combined positions [m], shape (3, n).
            ends: plastic lengths at the end of each run [m], shape (runs, hinges).
            weights: dimensionless weight of each run.
        """
        out, work, weight_array = np.empty(len(self._rest_lengths)), np.empty(1), np.array(weights, dtype=np.float64)
        inputs = (
            float64_address("x", x, self._shape),
            len(weights),
            address(weight_array),
            float64_address("ends", ends, ends.shape),
        )
        check(self._library.cloth_combine_plastic_lengths(self._handle, *inputs, address(out), address(work)))
        return out, float(work[0])

    def return_mapping(self, x: Array, memory: StateMemory) -> tuple[Array, float]:
        """Return a memory's plastic lengths, mapped to the yield surface at x (3, n), and the dissipated work [J]."""
        return self.combine(x, self.lengths_of(memory)[None], [1.0])

    def displacement(self, x: Array, errors: Array) -> float:
        """Return the largest displacement [m] that errors of plastic lengths [m] cause later, at x (3, n).

        A hinge oscillates about the length of its spring, so its particles move to twice the error. A slow hinge moves
        as far as the force accelerates it within a second: by a/6 in the mean over a second's errors.
        """
        if not errors.any():
            return 0.0
        squares = gradient_squares(self._particles, x, kind="crossed")
        mobility = squares * self._inverse_masses
        total = mobility[:, 0] + mobility[:, 1] + mobility[:, 2] + mobility[:, 3]
        size = np.abs(errors) * np.maximum.reduce(np.sqrt(squares) * self._inverse_masses, axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            displaced = size * np.minimum(2.0 / total, self._stiffness / 6.0)
        return float(np.fmax.reduce(displaced, initial=0.0))

    def kink_displacement(
        self,
        start: tuple[Array, Array],
        end: tuple[Array, Array],
        lengths: tuple[Array, Sequence[Array], Array],
        step: float,
        steps: int,
        error_time: float,
    ) -> float:
        """Return the displacement [m] by errors of a run at kinks: where hinges yield, or turn round.

        Args:
            start: positions [m] and velocities [m/s] at its start, (3, n) each.
            end: the same at its end.
            lengths: plastic lengths [m] at its start, at the ends of combined runs, and of their combination.
            step: step of the first run [s].
            steps: number of its steps.
            error_time: time within which an error of velocities displaces [s].
        """
        before, ends, after = lengths
        moved = (np.array(ends) != before).any(axis=0)
        if not moved.any():
            return 0.0
        (first, first_rate), (last, last_rate) = (self._motion(x, v, step) for x, v in (start, end))
        error = np.abs(last_rate - first_rate) * (step / (4.0 * steps))
        stretch, last_stretch = first - before, last - after
        # A hinge that yields all the time stays at its reach, but for what its rate changes in a step.
        limit = self._reach * (1.0 - 1e-6) - 2.0 * error
        is_within = np.minimum(np.abs(stretch), np.abs(last_stretch)) < limit
        # A hinge that turned round near the end is still near its reach.
        has_kink = moved & (is_within | (stretch * last_stretch < 0.0) | (first_rate * last_rate < 0.0))
        if not has_kink.any():
            return 0.0
        rate = np.fmax(np.abs(first_rate), np.abs(last_rate)) * has_kink
        squares = gradient_squares(self._particles, end[0], kind="crossed")
        size = np.maximum.reduce(np.sqrt(squares) * self._inverse_masses, axis=1)
        # The jerk jumps by the stiffness times the rate, which a step misses by an eighth of its square.
        yielding = float(np.fmax.reduce(rate * self._stiffness * size, initial=0.0)) * (0.125 * step * step)
        return self.displacement(end[0], np.nan_to_num(error) * has_kink) + error_time * yielding

    def _motion(self, x: Array, v: Array, step: float) -> tuple[Array, Array]:
        """Return signed lengths [m] of the hinges and their rates [m/s] over a step [s], shape (hinges,) each."""
        now, later = (signed_lengths(self._particles, y, kind="crossed") for y in (x, x + step * v))
        return now, (later - now) / step
