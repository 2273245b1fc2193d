# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Processes that roll out futures of a cloth. They are loky's: they outlive a call, start without the caller's own
program, and one that was killed is told of and replaced.
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

#: How long processes wait for a further call [s].
_WAIT = 300.0
#: Pieces of the work for each process: enough that none waits long for another at the end.
_PIECES = 4


def in_processes(snapshot: Snapshot, acts: NDArray[Any], wanted: Wanted, processes: int) -> Iterator[Future]:
    """Roll out futures, in order, by as many processes.

    Raises:
        ImportError: if loky is not there.
        RuntimeError: if a process was killed.
    """
    try:
        from loky import get_reusable_executor
        from loky.process_executor import TerminatedWorkerError
    except ImportError as error:
        raise ImportError("rollouts in processes need loky: pip install 'cloth_sim_ros[batch]'") from error
    packed = pickle.dumps(snapshot)
    pieces = np.array_split(acts, max(1, min(len(acts), _PIECES * processes)))
    # Workers that start later, in place of lost ones, have the variables from `env`.
    with safe_imports():
        executor = get_reusable_executor(max_workers=processes, timeout=_WAIT, env=overrides())
        tasks = [executor.submit(_rolled, packed, piece, wanted) for piece in pieces]
    try:
        for task in tasks:
            yield from task.result()
    except TerminatedWorkerError as error:
        raise RuntimeError(
            f"one of {processes} processes that roll out futures was killed, perhaps for want of memory; the next call "
            "starts new ones. Ask for fewer processes, or fewer particles to be told of"
        ) from error
    finally:
        for task in tasks:
            task.cancel()


#: What this process stepped last.
_kept: list[Simulation] = []


def _rolled(packed: bytes, acts: NDArray[Any], wanted: Wanted) -> list[Future]:
    snapshot: Snapshot = pickle.loads(packed)
    with cores.alone():
        simulation = _simulation(snapshot)
        return [future(simulation, snapshot, each, wanted) for each in acts]


def _simulation(snapshot: Snapshot) -> Simulation:
    """A simulation of the snapshot's scene: that of the call before where it fits."""
    try:
        snapshot.check_fits(_kept[0].scene)
    except (IndexError, ValueError):
        _kept[:] = [Simulation(snapshot.scene, snapshot.state)]
    return _kept[0]
