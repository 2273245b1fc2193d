# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Threads that step many cloths: the engine holds no interpreter lock while it works, so each has a core of its own."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Self

from cloth_sim_ros.physics import cores


def check_workers(count: int | None, name: str = "threads") -> int:
    """Return a number of threads or processes, where none is given that of the cores that this process may use.

    Raises:
        ValueError: for one that is no whole number of at least 1.
    """
    if count is None:
        return len(os.sched_getaffinity(0))
    if isinstance(count, bool) or not isinstance(count, int) or count < 1:
        raise ValueError(f"{name} is {count!r}; it must be a whole number of at least 1, or None")
    return count


class Crew:
    """Workers of which the thread that calls is one.

    Args:
        threads: how many; None takes the cores that this process may use.

    Raises:
        ValueError: for a number that is not at least 1.
    """

    def __init__(self, threads: int | None = None) -> None:
        self.threads = check_workers(threads)
        # They start when they are first needed.
        self._others = ThreadPoolExecutor(max(1, self.threads - 1), thread_name_prefix="cloth")

    def run(self, count: int, job: Callable[[int, int], None]) -> None:
        """Call ``job(worker, i)`` for each i from 0 to below a count; a worker has one call at a time.

        The next number goes to whoever is free. All are called, even if some raise.

        Raises:
            Exception: what the call with the least number raised.
        """
        numbers, troubles = itertools.count(), dict[int, BaseException]()

        def work(worker: int) -> None:
            with cores.alone():
                for i in iter(numbers.__next__, None):
                    if i >= count:
                        return
                    try:
                        job(worker, i)
                    except BaseException as trouble:
                        troubles[i] = trouble

        if self.threads == 1 or count == 1:
            work(0)
        else:
            others = [self._others.submit(work, worker) for worker in range(1, min(self.threads, count))]
            work(0)
            for other in others:
                other.result()
        if troubles:
            raise troubles[min(troubles)]

    def close(self) -> None:
        """End the threads."""
        self._others.shutdown()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
