# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parallel rollouts of one cloth, for sampling planners such as MPPI."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import attrs
import numpy as np
from numpy.typing import ArrayLike, NDArray

from cloth_sim_ros.learning.actions import ActionDecoder
from cloth_sim_ros.learning.process_rollouts import roll_out_in_processes
from cloth_sim_ros.learning.rollout import Rollout, RolloutRequest, roll_out, select_particles
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.simulation.simulation import Simulation
from cloth_sim_ros.simulation.snapshot import Snapshot
from cloth_sim_ros.simulation.thread_pool import ThreadPool, resolve_worker_count


@attrs.frozen(kw_only=True, eq=False)
class Trajectories:
    """Particles, wrenches and final snapshots of K rollouts of T frames with m recorded particles."""

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
    """Roll out several action sequences from one snapshot, in threads or processes; return the trajectories.

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
    if not isinstance(snapshot, Snapshot):
        raise ValueError(f"snapshot is {snapshot!r}; give one of a simulation, simulation.snapshot()")
    if snapshot.paused:
        raise ValueError("the snapshot is of a paused simulation, so nothing would move; resume it by Pause(False)")
    shape = np.shape(actions)
    if len(shape) != 4:
        raise ValueError(f"actions have shape {shape}; they must be (K, T, grippers, 4), or 8 with orientations")
    if threads is not None and processes is not None:
        raise ValueError(f"threads is {threads} and processes is {processes}; give one of them")
    has_orientations = shape[-1] == 8
    checked = ActionDecoder(snapshot.scene, has_orientations=has_orientations).validate(actions, shape[:2])
    selection, _ = select_particles(particles, snapshot.state.particle_count)
    request = RolloutRequest(has_orientations=has_orientations, particles=selection, has_velocities=velocities)
    results: Iterable[Rollout]
    if processes is not None:
        results = roll_out_in_processes(snapshot, checked, request, resolve_worker_count(processes, "processes"))
    else:
        results = _roll_out_in_threads(snapshot, checked, request, threads)
    return _collect(snapshot, checked, request, results)


def _roll_out_in_threads(
    snapshot: Snapshot, actions: NDArray[Any], request: RolloutRequest, threads: int | None
) -> list[Rollout]:
    results: dict[int, Rollout] = {}
    with ThreadPool(threads) as pool:
        simulations: list[Simulation | None] = [None] * pool.threads

        def roll(worker: int, k: int) -> None:
            simulation = simulations[worker]
            if simulation is None:
                simulation = simulations[worker] = Simulation(snapshot.scene, snapshot.state)
            results[k] = roll_out(simulation, snapshot, actions[k], request)

        pool.run(len(actions), roll)
    return [results[k] for k in range(len(actions))]


def _collect(
    snapshot: Snapshot, actions: NDArray[Any], request: RolloutRequest, results: Iterable[Rollout]
) -> Trajectories:
    count, frames, grippers = actions.shape[:3]
    size = len(np.arange(snapshot.state.particle_count)[request.particles])
    trajectories = np.empty((2 if request.has_velocities else 1, count, frames, size, 3), dtype=np.float32)
    wrenches = np.empty((count, frames, grippers, 6))
    ends = []
    for k, (trajectory, frame_wrenches, end) in enumerate(results):
        trajectories[:, k], wrenches[k] = trajectory, frame_wrenches
        ends.append(end)
    velocities = trajectories[1] if request.has_velocities else None
    return Trajectories(positions=trajectories[0], velocities=velocities, wrenches=wrenches, ends=ends)
