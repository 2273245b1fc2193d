# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rollouts in a process pool.

The pool is loky's. Its processes persist between calls and do not import the caller's program. The pool reports and
replaces killed processes.
"""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.learning.rollout import Rollout, RolloutRequest, roll_out
from cloth_sim_ros.physics.plan import thread_limit
from cloth_sim_ros.session.child_process import overrides, safe_imports
from cloth_sim_ros.simulation.simulation import Simulation
from cloth_sim_ros.simulation.snapshot import Snapshot

#: Time after which idle processes exit [s].
_IDLE_TIMEOUT = 300.0
#: Pieces of work per process, for an even load at the end.
_PIECES_PER_PROCESS = 4


def roll_out_in_processes(
    snapshot: Snapshot, actions: NDArray[Any], request: RolloutRequest, processes: int
) -> Iterator[Rollout]:
    """Yield the rollouts of several action sequences, in order, from processes that persist between calls.

    Args:
        snapshot: start of all rollouts.
        actions: actions, shape (K, T, grippers, 4 or 8).
        request: type of the actions and outputs.
        processes: number of processes.

    Raises:
        ImportError: if loky is not installed.
        RuntimeError: if a process was killed.
    """
    try:
        from loky import get_reusable_executor
        from loky.process_executor import TerminatedWorkerError
    except ImportError as error:
        raise ImportError("rollouts in processes need loky: pip install 'cloth_sim_ros[batch]'") from error
    packed = pickle.dumps(snapshot)
    pieces = np.array_split(actions, max(1, min(len(actions), _PIECES_PER_PROCESS * processes)))
    # Processes that replace lost ones get their environment variables from `env`.
    with safe_imports():
        executor = get_reusable_executor(max_workers=processes, timeout=_IDLE_TIMEOUT, env=overrides())
        tasks = [executor.submit(_roll_out_piece, packed, piece, request) for piece in pieces]
    try:
        for task in tasks:
            yield from task.result()
    except TerminatedWorkerError as error:
        cause = f"one of {processes} rollout processes was killed, possibly out of memory"
        remedy = "the next call starts new ones. Use fewer processes, or fewer particles"
        raise RuntimeError(f"{cause}; {remedy}") from error
    finally:
        for task in tasks:
            task.cancel()


#: Latest simulation of this process; empty at the start.
_cached_simulation: list[Simulation] = []


def _roll_out_piece(packed: bytes, actions: NDArray[Any], request: RolloutRequest) -> list[Rollout]:
    snapshot: Snapshot = pickle.loads(packed)
    with thread_limit.single_threaded():
        simulation = _simulation(snapshot)
        return [roll_out(simulation, snapshot, sequence, request) for sequence in actions]


def _simulation(snapshot: Snapshot) -> Simulation:
    """Return a simulation of the snapshot's scene; the cached one if it fits."""
    try:
        snapshot.check_fits(_cached_simulation[0].scene)
    except (IndexError, ValueError):
        _cached_simulation[:] = [Simulation(snapshot.scene, snapshot.state)]
    return _cached_simulation[0]
