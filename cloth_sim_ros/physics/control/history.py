# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Velocities at the starts of the last frames, from which step control predicts the velocity change of the next one."""

from __future__ import annotations

from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.runs import History
from cloth_sim_ros.physics.state.controller_state import EARLIER_VELOCITIES_KEY, PREVIOUS_VELOCITIES_KEY
from cloth_sim_ros.physics.state.state import State


def load_history(state: State, duration: float) -> History | None:
    """Return the velocities of the last frames, each of a duration [s]; None if there are none."""
    previous = state.memory.get(PREVIOUS_VELOCITIES_KEY)
    return None if previous is None else History(previous, state.memory.get(EARLIER_VELOCITIES_KEY), duration)


def store_history(state: State, velocities: Array) -> None:
    """Store the velocities [m/s] at the start of a frame, shape (3, n), and keep those of the one before."""
    previous = state.memory.get(PREVIOUS_VELOCITIES_KEY)
    if previous is not None:
        state.memory[EARLIER_VELOCITIES_KEY] = previous
    state.memory[PREVIOUS_VELOCITIES_KEY] = velocities
