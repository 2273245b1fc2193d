# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Engine binding of the plastic lengths of one plan: the state of the friction of bending."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cloth_sim_ros.engine.binding import address, check, float64_address, library
from cloth_sim_ros.physics.model.forces.force import Array
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
        particle_count: number of particles of the model.
    """

    def __init__(self, engine_plan: PlanHandle, hinges: ElementList, particle_count: int) -> None:
        self._engine_plan, self._library, self._handle = engine_plan, library(), engine_plan.pointer
        self._rest_lengths = np.ascontiguousarray(hinges.coefficients[:, 0])
        self._shape = (3, particle_count)
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
