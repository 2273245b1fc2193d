# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rollout of one action sequence by a simulation."""

from __future__ import annotations

from typing import Any, TypeAlias

import attrs
import numpy as np
from numpy.typing import ArrayLike, NDArray

from cloth_sim_ros.batch.actions import Commands
from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.state import State
from cloth_sim_ros.simulation.simulation import Simulation
from cloth_sim_ros.simulation.snapshot import Snapshot

#: Indices of particles, or a slice for all.
Chosen: TypeAlias = NDArray[np.int64] | slice


@attrs.frozen(kw_only=True, eq=False)
class Wanted:
    """Actions and outputs that all rollouts of a call share."""

    #: True if actions have orientations.
    turned: bool
    #: Recorded particles.
    chosen: Chosen
    #: True if velocities are recorded.
    velocities: bool


#: Result of one rollout: positions [m] and optionally velocities [m/s], shape (1 or 2, T, m, 3); wrenches [N, N m],
#: shape (T, grippers, 6); final snapshot.
Future: TypeAlias = tuple[NDArray[np.float32], Array, Snapshot]


def future(simulation: Simulation, snapshot: Snapshot, acts: NDArray[Any], wanted: Wanted) -> Future:
    """Roll out one action sequence.

    Args:
        simulation: simulation of the snapshot's scene; its state is overwritten.
        snapshot: start of the rollout.
        actions: actions, shape (T, grippers, 4 or 8).
        request: type of the actions and outputs.
    """
    commands = Commands(snapshot.scene, turned=wanted.turned)
    size = len(np.arange(snapshot.state.particle_count)[wanted.chosen])
    told = np.empty((2 if wanted.velocities else 1, len(acts), size, 3), dtype=np.float32)
    wrenches = np.empty((len(acts), len(commands.names), 6))
    simulation.restore(snapshot)
    for t, action in enumerate(acts):
        frame = simulation.advance(commands.events(action, simulation))
        put(told[:, t], wanted.chosen, simulation.state)
        wrenches[t] = frame.wrenches
    return told, wrenches, simulation.snapshot()


def particles_of(particles: ArrayLike | None, count: int) -> tuple[Chosen, int]:
    """Return an index of particles and their number; all particles by default.

    Args:
        particles: indices of particles, or None for all.
        count: number of all particles.

    Raises:
        ValueError: if an index is no whole number, or names no particle.
    """
    if particles is None:
        return slice(None), count
    chosen = np.asarray(particles)
    if chosen.ndim != 1 or chosen.size == 0 or chosen.dtype.kind not in "iu":
        raise ValueError(f"particles are {particles!r}; give a list of particle indices, or None for all")
    wrong = np.flatnonzero((chosen < 0) | (chosen >= count))
    if wrong.size:
        raise ValueError(f"particles name particle {chosen[wrong[0]]}; there are {count}, from index 0")
    return chosen.astype(np.int64), chosen.size


def put(out: NDArray[np.float32], chosen: Chosen, state: State) -> None:
    """Store positions [m] and optionally velocities [m/s] of selected particles into `out`, shape (1 or 2, m, 3)."""
    for k in range(len(out)):
        out[k] = (state.x, state.v)[k][:, chosen].T
