# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Thread pool: each index once, and no further engine threads."""

import threading

import pytest

from cloth_sim_ros.physics.plan import thread_limit
from cloth_sim_ros.simulation.thread_pool import ThreadPool


@pytest.mark.parametrize("threads", [1, 2, 4])
def test_pool_calls_each_index_once_per_worker(threads):
    called, busy, clash = [], set(), []

    def job(worker, i):
        clash.extend([worker] * (worker in busy))
        busy.add(worker)
        called.append(i)
        busy.discard(worker)

    with ThreadPool(threads) as pool:
        pool.run(50, job)
        pool.run(0, job)
        pool.run(1, job)
    assert sorted(called) == [0, *range(50)]
    assert not clash


def test_pool_calls_all_indices_and_raises_first_error():
    called = []

    def job(_, i):
        called.append(i)
        if i in (3, 7):
            raise ValueError(f"trouble {i}")

    with ThreadPool(2) as pool, pytest.raises(ValueError, match="trouble 3"):
        pool.run(10, job)
    assert sorted(called) == list(range(10))


def test_frame_uses_one_thread_inside_pool(monkeypatch):
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {0, 1, 2})
    seen, names = [], set()

    def job(_, __):
        seen.append(thread_limit.available_threads())
        names.add(threading.current_thread().name)

    with ThreadPool() as pool:
        assert pool.threads == 3
        pool.run(8, job)
    assert seen == [1] * 8
    assert thread_limit.available_threads() == 2
