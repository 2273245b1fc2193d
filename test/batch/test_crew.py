# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Thread pool: each index once, and no further engine threads."""

import threading

import pytest

from cloth_sim_ros.batch.crew import Crew
from cloth_sim_ros.physics import cores


@pytest.mark.parametrize("threads", [1, 2, 4])
def test_pool_calls_each_index_once_per_worker(threads):
    called, busy, clash = [], set(), []

    def job(worker, i):
        clash.extend([worker] * (worker in busy))
        busy.add(worker)
        called.append(i)
        busy.discard(worker)

    with Crew(threads) as crew:
        crew.run(50, job)
        crew.run(0, job)
        crew.run(1, job)
    assert sorted(called) == [0, *range(50)]
    assert not clash


def test_pool_calls_all_indices_and_raises_first_error():
    called = []

    def job(_, i):
        called.append(i)
        if i in (3, 7):
            raise ValueError(f"trouble {i}")

    with Crew(2) as crew, pytest.raises(ValueError, match="trouble 3"):
        crew.run(10, job)
    assert sorted(called) == list(range(10))


def test_frame_uses_one_thread_inside_pool(monkeypatch):
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {0, 1, 2})
    seen, names = [], set()

    def job(_, __):
        seen.append(cores.available())
        names.add(threading.current_thread().name)

    with Crew() as crew:
        assert crew.threads == 3
        crew.run(8, job)
    assert seen == [1] * 8
    assert cores.available() == 2
