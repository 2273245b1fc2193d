# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parallel rollouts of one cloth, for sampling planners such as MPPI."""

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
    """Trajectories of K rollouts of T frames with m recorded particles."""

    #: Positions at the ends of frames [m], shape (K, T, m, 3), float32.
    positions: NDArray[np.float32]
    #: Velocities at the ends of frames [m/s], shape (K, T, m, 3), float32; None if they were not requested.
    velocities: NDArray[np.float32] | None
    #: Force [N] and torque [N m] of the cloth on each gripper, mean over the frame, shape (K, T, grippers, 6).
    wrenches: Array
    #: Final snapshot of each rollout, from which further rollouts can start.
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
    """Roll out several action sequences from one snapshot.

    The result of a rollout is independent of the number of threads or processes and of the other rollouts.

    Args:
        snapshot: start of all rollouts; it is not changed.
        actions: actions of each rollout, frame and gripper. Shape (K, T, grippers, 4): target position [m] and grasp
            (closed from 0.5 on). Shape (K, T, grippers, 8): position, quaternion x, y, z, w, and grasp. A gripper
            reaches its target at the end of the frame.
        particles: indices of the recorded particles; all by default.
        velocities: true to record velocities too.
        threads: number of threads; None takes one per core that this process may use.
        processes: number of processes, instead of threads. They take about a second to start, and wait for further
            calls. For small cloths processes are faster than threads, which share the interpreter lock. The interpreter
            takes a third of a small cloth's frame.

    Returns:
        Positions, velocities, wrenches and final snapshots.

    Raises:
        ValueError: if actions have another shape or are not finite, or an index names no particle.
        UnstableError: if the motion of a rollout does not stay finite.
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
