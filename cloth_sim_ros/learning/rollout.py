# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rollout of one action sequence by a simulation."""

from __future__ import annotations

from typing import Any, TypeAlias

import attrs
import numpy as np
from numpy.typing import ArrayLike, NDArray

from cloth_sim_ros.learning.actions import ActionDecoder
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.simulation.simulation import Simulation
from cloth_sim_ros.simulation.snapshot import Snapshot

#: Indices of particles, or a slice for all.
ParticleSelection: TypeAlias = NDArray[np.int64] | slice


@attrs.frozen(kw_only=True, eq=False)
class RolloutRequest:
    """Type of the actions, and recorded particles, that all rollouts of a call share."""

    #: True if actions have orientations.
    has_orientations: bool
    #: Recorded particles.
    particles: ParticleSelection
    #: True if velocities are recorded.
    has_velocities: bool


#: Result of one rollout: positions [m] and optionally velocities [m/s], shape (1 or 2, T, m, 3); wrenches [N, N m],
#: shape (T, grippers, 6); final snapshot.
Rollout: TypeAlias = tuple[NDArray[np.float32], Array, Snapshot]


def roll_out(simulation: Simulation, snapshot: Snapshot, actions: NDArray[Any], request: RolloutRequest) -> Rollout:
    """Simulate an action sequence from a snapshot; return trajectory, wrenches and final snapshot as a `Rollout`.

    Args:
        simulation: simulation of the snapshot's scene; its state is overwritten.
        snapshot: start of the rollout.
        actions: actions, shape (T, grippers, 4 or 8).
        request: type of the actions and outputs.
    """
    decoder = ActionDecoder(snapshot.scene, has_orientations=request.has_orientations)
    size = len(np.arange(snapshot.state.particle_count)[request.particles])
    trajectory = np.empty((2 if request.has_velocities else 1, len(actions), size, 3), dtype=np.float32)
    wrenches = np.empty((len(actions), len(decoder.names), 6))
    simulation.restore(snapshot)
    for t, action in enumerate(actions):
        frame = simulation.advance(decoder.to_events(action, simulation))
        store_particles(trajectory[:, t], request.particles, simulation.state)
        wrenches[t] = frame.wrenches
    return trajectory, wrenches, simulation.snapshot()


def select_particles(particles: ArrayLike | None, count: int) -> tuple[ParticleSelection, int]:
    """Return an index that selects particles (None: all), and their number. Raises ValueError.

    Args:
        particles: indices of particles, or None for all.
        count: number of all particles.

    Raises:
        ValueError: if an index is no whole number, or names no particle.
    """
    if particles is None:
        return slice(None), count
    indices = np.asarray(particles)
    if indices.ndim != 1 or indices.size == 0 or indices.dtype.kind not in "iu":
        raise ValueError(f"particles are {particles!r}; give a list of particle indices, or None for all")
    wrong = np.flatnonzero((indices < 0) | (indices >= count))
    if wrong.size:
        raise ValueError(f"particles name particle {indices[wrong[0]]}; there are {count}, from index 0")
    return indices.astype(np.int64), indices.size


def store_particles(out: NDArray[np.float32], particles: ParticleSelection, state: State) -> None:
    """Store positions [m] and optionally velocities [m/s] of selected particles into `out`, shape (1 or 2, m, 3)."""
    for k in range(len(out)):
        out[k] = (state.x, state.v)[k][:, particles].T
