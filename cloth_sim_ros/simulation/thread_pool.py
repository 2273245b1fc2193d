# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Thread pool that steps many cloths.

The engine releases the interpreter lock while it computes, therefore each thread uses a core.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Self

import numpy as np

from cloth_sim_ros.physics.plan import thread_limit


def resolve_worker_count(count: Any, name: str = "threads") -> int:
    """Return a checked number of threads or processes, by default one per available core; raise ValueError below 1.

    Args:
        count: the number; None for the default.
        name: name of the parameter, for the error text.

    Raises:
        ValueError: if the number is not a whole number of at least 1.
    """
    if count is None:
        return len(os.sched_getaffinity(0))
    if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < 1:
        raise ValueError(f"{name} is {count!r}; it must be a whole number of at least 1, or None")
    return int(count)


class ThreadPool:
    """Pool of threads for `run`, in which the calling thread is worker 0; `close` ends it.

    Args:
        threads: number of threads; None takes one per core that this process may use.

    Raises:
        ValueError: if the number is not at least 1.
    """

    def __init__(self, threads: int | None = None) -> None:
        self.threads = resolve_worker_count(threads)
        # The executor starts its threads at their first use.
        self._executor = ThreadPoolExecutor(max(1, self.threads - 1), thread_name_prefix="cloth")

    def run(self, count: int, job: Callable[[int, int], None]) -> None:
        """Call ``job(worker, i)`` for each i in range(count), in parallel; wait for all, then raise the first error.

        A free worker takes the next index, and each worker executes one call at a time. All indices are processed, even
        if calls raise.

        Raises:
            Exception: the exception of the lowest index.
        """
        indices, errors = itertools.count(), dict[int, BaseException]()

        def work(worker: int) -> None:
            with thread_limit.single_threaded():
                for i in iter(indices.__next__, None):
                    if i >= count:
                        return
                    try:
                        job(worker, i)
                    except BaseException as error:
                        errors[i] = error

        if self.threads == 1 or count == 1:
            work(0)
        else:
            tasks = [self._executor.submit(work, worker) for worker in range(1, min(self.threads, count))]
            work(0)
            for task in tasks:
                task.result()
        if errors:
            raise errors[min(errors)]

    def close(self) -> None:
        """Wait for the threads and stop them; the pool can't run jobs in parallel afterwards."""
        self._executor.shutdown()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
