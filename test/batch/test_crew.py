# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Workers that step many cloths: each number once, and no thread of the engine's beside theirs."""

import threading

import pytest

from cloth_sim_ros.batch.crew import Crew
from cloth_sim_ros.physics import cores


@pytest.mark.parametrize("threads", [1, 2, 4])
def test_each_number_is_called_once_by_one_worker_at_a_time(threads):
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


def test_all_are_called_and_the_first_trouble_is_raised():
    called = []

    def job(_, i):
        called.append(i)
        if i in (3, 7):
            raise ValueError(f"trouble {i}")

    with Crew(2) as crew, pytest.raises(ValueError, match="trouble 3"):
        crew.run(10, job)
    assert sorted(called) == list(range(10))


def test_a_frame_takes_no_further_thread_while_a_crew_works(monkeypatch):
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
