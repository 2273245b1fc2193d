# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Many futures of one cloth, on all cores: what sampling planners such as MPPI need."""

from __future__ import annotations

from typing import TypeAlias

import attrs
import numpy as np
from numpy.typing import ArrayLike, NDArray

from cloth_sim_ros.batch.actions import Commands
from cloth_sim_ros.batch.crew import Crew
from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.state import State
from cloth_sim_ros.simulation.simulation import Simulation
from cloth_sim_ros.simulation.snapshot import Snapshot


@attrs.frozen(kw_only=True, eq=False)
class Trajectories:
    """What K futures of T frames did, frame by frame; m particles are told of."""

    #: Positions at the ends of frames [m], shape (K, T, m, 3), float32.
    positions: NDArray[np.float32]
    #: Velocities [m/s], the same shape; None where they were not asked for.
    velocities: NDArray[np.float32] | None
    #: Force [N] and torque [N m] of the cloth on each gripper, mean over the frame, shape (K, T, grippers, 6).
    wrenches: Array
    #: Where each future ends, to go on from.
    ends: list[Snapshot]


def rollouts(
    snapshot: Snapshot,
    actions: ArrayLike,
    *,
    particles: ArrayLike | None = None,
    velocities: bool = False,
    threads: int | None = None,
) -> Trajectories:
    """Let a cloth go on from a snapshot by each of several sequences of actions.

    The result depends neither on the number of threads nor on what else is rolled out.

    Args:
        snapshot: where all begin; it stays as it is.
        actions: shape (K, T, grippers, 4): in each frame, for each gripper, its target's position [m] and grasp (closed
            from 0.5 on); or (K, T, grippers, 8) with a quaternion x, y, z, w between. A target is reached by the end of
            its frame.
        particles: of which particles positions are told; all where left out.
        velocities: whether velocities are told too.
        threads: None takes the cores that this process may use.

    Raises:
        ValueError: for actions of another shape or numbers that are not finite, or particles that are none.
        UnstableError: if the motion of a future does not stay finite.
    """
    given = np.shape(actions)
    if len(given) != 4:
        raise ValueError(f"actions have shape {given}; they must be (K, T, grippers, 4), or 8 with orientations")
    commands = Commands(snapshot.scene, turned=given[-1] == 8)
    acts = commands.checked(actions, given[:2])
    count, frames = given[:2]
    chosen, size = particles_of(particles, snapshot.state.particle_count)
    told = np.empty((2 if velocities else 1, count, frames, size, 3), dtype=np.float32)
    wrenches = np.empty((count, frames, len(commands.names), 6))
    ends: list[Snapshot] = [snapshot] * count

    with Crew(threads) as crew:
        simulations: list[Simulation | None] = [None] * crew.threads

        def roll(worker: int, k: int) -> None:
            simulation = simulations[worker]
            if simulation is None:
                simulation = simulations[worker] = Simulation(snapshot.scene, snapshot.state)
            simulation.restore(snapshot)
            for t in range(frames):
                frame = simulation.advance(commands.events(acts[k, t], simulation))
                put(told[:, k, t], chosen, simulation.state)
                wrenches[k, t] = frame.wrenches
            ends[k] = simulation.snapshot()

        crew.run(count, roll)
    return Trajectories(positions=told[0], velocities=told[1] if velocities else None, wrenches=wrenches, ends=ends)


#: Numbers of particles, or all of them.
Chosen: TypeAlias = NDArray[np.int64] | slice


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
    for room, source in zip(out, (state.x, state.v), strict=False):
        room[:] = source[:, chosen].T
