# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Assignment of test files to the workers of pytest-xdist: timed tests to some, the others to the rest.

Tests of nodes wait for discovery, clocks and other processes, and are timed by the wall clock. One worker on two
processors runs them, one after another, and two more use the processors meanwhile, at a lower priority.
"""

from __future__ import annotations

import os
from collections.abc import Mapping

from xdist.scheduler import LoadFileScheduling
from xdist.workermanage import WorkerController

#: Beginnings of the paths of timed tests: nodes, rates of topics, interrupted commands, concurrent threads.
TIMED = (
    "test/ros/",
    "test/benchmarks/test_ros_benchmarks.py",
    "test/engine/test_engine_threads.py",
    "test/studies/test_study_kills.py",
    "test/test_examples.py",
    "test/test_interrupts.py",
    "test/test_open_ports.py",
)
#: Niceness of the workers that run no timed tests.
NICENESS = 10


def is_timed(path: str) -> bool:
    """Return true if the tests of a file, relative to the repository, are timed."""
    return path.startswith(TIMED)


def count_workers(processors: int) -> int:
    """Return the number of workers: one per processor, and one for timed tests per two processors."""
    return processors + (processors + 1) // 2


def runs_timed(worker: str, count: int) -> bool:
    """Return true if a worker, such as `gw0` of `count`, runs timed tests as long as there are any."""
    return int(worker.removeprefix("gw")) < max(1, count // 3)


def lower_priority(environment: Mapping[str, str]) -> None:
    """Let this process, a worker without timed tests, yield the processors to those that run them.

    Args:
        environment: variables of the process; pytest-xdist sets two in its workers.
    """
    worker = environment.get("PYTEST_XDIST_WORKER")
    if worker is not None and not runs_timed(worker, int(environment["PYTEST_XDIST_WORKER_COUNT"])):
        os.nice(NICENESS)


class TimedFileScheduling(LoadFileScheduling):
    """A scheduler that keeps the order of the files among timed ones and among the others.

    A worker that finds no more of its kind takes the other kind.
    """

    def _assign_work_unit(self, node: WorkerController) -> None:
        timed = runs_timed(node.gateway.id, self.numnodes)
        path = next((path for path in self.workqueue if is_timed(path) == timed), None)
        if path is not None:
            self.workqueue.move_to_end(path, last=False)
        super()._assign_work_unit(node)
