# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Assignment of test files to the workers of pytest-xdist."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

pytest.importorskip("xdist")

from support import worker_scheduling
from support.worker_scheduling import TIMED, TimedFileScheduling, count_workers, is_timed, runs_timed

ROOT = Path(__file__).resolve().parent.parent
FILES = [
    *(f"test/physics/test_{k}.py" for k in range(5)),
    *(f"test/ros/test_{k}.py" for k in range(3)),
    *(f"test/scene/test_{k}.py" for k in range(2)),
]


class Worker:
    """A worker that records the tests that it is sent."""

    def __init__(self, name: str) -> None:
        self.gateway = SimpleNamespace(id=name)
        self.shutting_down = False
        self.pending: list[int] = []

    def send_runtest_some(self, indices: list[int]) -> None:
        self.pending += indices

    def shutdown(self) -> None:
        self.shutting_down = True


def has_timed(orders: list[list[str]]) -> bool:
    return any(is_timed(path) for order in orders for path in order)


def run(speeds: list[int]) -> list[list[str]]:
    """Return the files in each worker's order; in each round a worker completes its number of tests."""
    config = SimpleNamespace(
        option=SimpleNamespace(loadscopereorder=False),
        getvalue=lambda name: {"tx": [f"{len(speeds)}*popen"]}[name],
    )
    scheduler = TimedFileScheduling(config)
    workers = [Worker(f"gw{k}") for k in range(len(speeds))]
    tests = [f"{path}::test_{k}" for path in FILES for k in range(4)]
    for worker in workers:
        scheduler.add_node(worker)
        scheduler.add_node_collection(worker, tests)
    scheduler.schedule()
    done: list[list[str]] = [[] for _ in workers]
    while scheduler.has_pending:
        for worker, speed, ran in zip(workers, speeds, done, strict=True):
            for index in worker.pending[:speed]:
                scheduler.mark_test_complete(worker, index)
                ran.append(tests[index].split("::")[0])
            del worker.pending[:speed]
    assert sorted(path for ran in done for path in ran) == sorted(4 * FILES)
    return [list(dict.fromkeys(ran)) for ran in done]


def test_timed_files_run_in_one_of_three_workers() -> None:
    timed, *untimed = run([2, 2, 2])
    assert timed[:3] == FILES[5:8]
    assert not has_timed(untimed)
    assert untimed[0][0] == FILES[0]


@pytest.mark.parametrize("speeds", [[1, 4, 4], [4, 1, 1]], ids=["timed tests slow", "other tests slow"])
def test_free_workers_take_files_of_the_other_kind(speeds: list[int]) -> None:
    timed, *untimed = run(speeds)
    assert has_timed(untimed) == (speeds[0] == 1)
    assert all(map(is_timed, timed)) == (speeds[0] == 1)


def test_one_worker_runs_timed_files_first() -> None:
    (order,) = run([1])
    assert order == [*FILES[5:8], *FILES[:5], *FILES[8:]]


def test_a_third_of_the_workers_runs_timed_tests() -> None:
    workers = {processors: count_workers(processors) for processors in (1, 2, 4, 16)}
    assert workers == {1: 2, 2: 3, 4: 6, 16: 24}
    timed = {n: sum(runs_timed(f"gw{k}", n) for k in range(n)) for n in (1, 2, 3, 6, 24)}
    assert timed == {1: 1, 2: 1, 3: 1, 6: 2, 24: 8}


def test_workers_of_other_tests_have_lower_priority() -> None:
    script = "import os, sys; from support import worker_scheduling; n = os.nice(0); "
    script += "worker_scheduling.lower_priority(dict(zip(*[iter(sys.argv[1:])] * 2))); print(os.nice(0) - n)"

    def niceness(*variables: str) -> int:
        command = [sys.executable, "-c", script, *variables]
        return int(subprocess.run(command, cwd=ROOT / "test", check=True, capture_output=True, text=True).stdout)

    assert niceness() == 0
    count = ("PYTEST_XDIST_WORKER_COUNT", "3")
    assert niceness("PYTEST_XDIST_WORKER", "gw0", *count) == 0
    # A process that has this niceness already can't raise it beyond 19.
    assert 0 < niceness("PYTEST_XDIST_WORKER", "gw1", *count) <= worker_scheduling.NICENESS


def test_timed_files_exist() -> None:
    assert all((ROOT / beginning).exists() for beginning in TIMED)
