# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Many futures of one cloth, on all cores: what sampling planners such as MPPI need."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import attrs
import numpy as np
from numpy.typing import ArrayLike, NDArray

from cloth_sim_ros.batch.actions import Commands
from cloth_sim_ros.batch.crew import Crew, check_workers
from cloth_sim_ros.batch.future import Future, Wanted, future, particles_of
from cloth_sim_ros.batch.pool import in_processes
from cloth_sim_ros.physics.forces.force import Array
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
    processes: int | None = None,
) -> Trajectories:
    """Let a cloth go on from a snapshot by each of several sequences of actions.

    The result depends neither on the number of threads or processes nor on what else is rolled out.

    Args:
        snapshot: where all begin; it stays as it is.
        actions: shape (K, T, grippers, 4): in each frame, for each gripper, its target's position [m] and grasp (closed
            from 0.5 on); or (K, T, grippers, 8) with a quaternion x, y, z, w between. A target is reached by the end of
            its frame.
        particles: of which particles positions are told; all where left out.
        velocities: whether velocities are told too.
        threads: None takes the cores that this process may use.
        processes: so many processes instead of threads. They take about a second to start, and wait for further calls.
            Small cloths are stepped faster by them: threads share the interpreter, which has a third of their frames.

    Raises:
        ValueError: for actions of another shape or numbers that are not finite, or particles that are none.
        UnstableError: if the motion of a future does not stay finite.
    """
    given = np.shape(actions)
    if len(given) != 4:
        raise ValueError(f"actions have shape {given}; they must be (K, T, grippers, 4), or 8 with orientations")
    if threads is not None and processes is not None:
        raise ValueError(f"threads is {threads} and processes is {processes}; give one of them")
    turned = given[-1] == 8
    acts = Commands(snapshot.scene, turned=turned).checked(actions, given[:2])
    chosen, _ = particles_of(particles, snapshot.state.particle_count)
    wanted = Wanted(turned=turned, chosen=chosen, velocities=velocities)
    done: Iterable[Future]
    if processes is not None:
        done = in_processes(snapshot, acts, wanted, check_workers(processes, "processes"))
    else:
        done = _in_threads(snapshot, acts, wanted, threads)
    return _gathered(snapshot, acts, wanted, done)


def _in_threads(snapshot: Snapshot, acts: NDArray[Any], wanted: Wanted, threads: int | None) -> list[Future]:
    done: dict[int, Future] = {}
    with Crew(threads) as crew:
        simulations: list[Simulation | None] = [None] * crew.threads

        def roll(worker: int, k: int) -> None:
            simulation = simulations[worker]
            if simulation is None:
                simulation = simulations[worker] = Simulation(snapshot.scene, snapshot.state)
            done[k] = future(simulation, snapshot, acts[k], wanted)

        crew.run(len(acts), roll)
    return [done[k] for k in range(len(acts))]


def _gathered(snapshot: Snapshot, acts: NDArray[Any], wanted: Wanted, done: Iterable[Future]) -> Trajectories:
    count, frames, grippers = acts.shape[:3]
    size = len(np.arange(snapshot.state.particle_count)[wanted.chosen])
    told = np.empty((2 if wanted.velocities else 1, count, frames, size, 3), dtype=np.float32)
    wrenches = np.empty((count, frames, grippers, 6))
    ends = []
    for k, (moved, pulled, end) in enumerate(done):
        told[:, k], wrenches[k] = moved, pulled
        ends.append(end)
    return Trajectories(
        positions=told[0], velocities=told[1] if wanted.velocities else None, wrenches=wrenches, ends=ends
    )
