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

from cloth_sim_ros.batch.future import Future, Wanted, future
from cloth_sim_ros.physics import cores
from cloth_sim_ros.session.child_process import overrides, safe_imports
from cloth_sim_ros.simulation.simulation import Simulation
from cloth_sim_ros.simulation.snapshot import Snapshot

#: Time after which idle processes exit [s].
_WAIT = 300.0
#: Pieces of work per process, for an even load at the end.
_PIECES = 4


def in_processes(snapshot: Snapshot, acts: NDArray[Any], wanted: Wanted, processes: int) -> Iterator[Future]:
    """Yield the rollouts of several action sequences, in order, computed by processes.

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
    pieces = np.array_split(acts, max(1, min(len(acts), _PIECES * processes)))
    # Processes that replace lost ones get their environment variables from `env`.
    with safe_imports():
        executor = get_reusable_executor(max_workers=processes, timeout=_WAIT, env=overrides())
        tasks = [executor.submit(_rolled, packed, piece, wanted) for piece in pieces]
    try:
        for task in tasks:
            yield from task.result()
    except TerminatedWorkerError as error:
        raise RuntimeError(
            f"one of {processes} rollout processes was killed, possibly out of memory; the next call starts new ones. "
            "Use fewer processes, or fewer particles"
        ) from error
    finally:
        for task in tasks:
            task.cancel()


#: Latest simulation of this process; empty at the start.
_kept: list[Simulation] = []


def _rolled(packed: bytes, acts: NDArray[Any], wanted: Wanted) -> list[Future]:
    snapshot: Snapshot = pickle.loads(packed)
    with cores.alone():
        simulation = _simulation(snapshot)
        return [future(simulation, snapshot, each, wanted) for each in acts]


def _simulation(snapshot: Snapshot) -> Simulation:
    """Return a simulation of the snapshot's scene; the cached one if it fits."""
    try:
        snapshot.check_fits(_kept[0].scene)
    except (IndexError, ValueError):
        _kept[:] = [Simulation(snapshot.scene, snapshot.state)]
    return _kept[0]
