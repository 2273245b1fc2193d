# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One future of a cloth: what is commanded and told, and how a simulation rolls it out, in a thread or a process."""

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

#: Numbers of particles, or all of them.
Chosen: TypeAlias = NDArray[np.int64] | slice


@attrs.frozen(kw_only=True, eq=False)
class Wanted:
    """What is commanded and told in all futures."""

    #: Whether actions have orientations.
    turned: bool
    #: The particles that are told of, and whether their velocities are.
    chosen: Chosen
    velocities: bool


#: Of one future: positions and, where wanted, velocities, shape (1 or 2, T, m, 3); wrenches, shape (T, grippers, 6);
#: where it ends.
Future: TypeAlias = tuple[NDArray[np.float32], Array, Snapshot]


def future(simulation: Simulation, snapshot: Snapshot, acts: NDArray[Any], wanted: Wanted) -> Future:
    """Roll out one future by a simulation of the snapshot's scene; acts of shape (T, grippers, numbers)."""
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
    """Return what chooses particles from an array, all where none are given, and how many these are.

    Raises:
        ValueError: for numbers that are not whole, or name no particle.
    """
    if particles is None:
        return slice(None), count
    chosen = np.asarray(particles)
    if chosen.ndim != 1 or chosen.size == 0 or chosen.dtype.kind not in "iu":
        raise ValueError(f"particles are {particles!r}; give a list of numbers of particles, or None for all")
    wrong = np.flatnonzero((chosen < 0) | (chosen >= count))
    if wrong.size:
        raise ValueError(f"particles name particle {chosen[wrong[0]]}; there are {count}, counted from 0")
    return chosen.astype(np.int64), chosen.size


def put(out: NDArray[np.float32], chosen: Chosen, state: State) -> None:
    """Write positions and, where there is room, velocities of chosen particles, shape (1 or 2, m, 3)."""
    for k in range(len(out)):
        out[k] = (state.x, state.v)[k][:, chosen].T
