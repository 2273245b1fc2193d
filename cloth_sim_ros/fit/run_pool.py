# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Process pool for the simulations of a fit."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self, TypeVar

from cloth_sim_ros.fit.parameters import FitError
from cloth_sim_ros.session.child_process import exit_with_parent, overrides, safe_imports

if TYPE_CHECKING:
    from loky import ProcessPoolExecutor

Job = TypeVar("Job")
Result = TypeVar("Result")


class RunPool:
    """Context manager of processes for simulations; they start at the first `map`, and end with the context.

    Args:
        workers: number of processes; 1 uses this process, None starts one per core.
        initializer: called in each process at its start; a function of a module.
        arguments: its arguments.
    """

    def __init__(
        self,
        workers: int | None = None,
        *,
        initializer: Callable[..., None] | None = None,
        arguments: tuple[Any, ...] = (),
    ) -> None:
        self.workers = workers or len(os.sched_getaffinity(0))
        #: Number of simulations so far.
        self.n_runs = 0
        self._initializer, self._arguments = initializer, arguments
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._pool is not None:
            # After an error, pending simulations are useless.
            self._pool.shutdown(wait=kind is None, kill_workers=kind is not None)

    def map(
        self,
        function: Callable[[Job], Result],
        jobs: Sequence[Job],
        *,
        local_function: Callable[[Job], Result] | None = None,
    ) -> list[Result]:
        """Call a function for each job in parallel processes; return the results in order. Raises FitError.

        Args:
            function: a function of a module, called in the processes.
            jobs: its argument in each call.
            local_function: called in its place in this process, which the initializer did not see.

        Raises:
            FitError: if a worker process was killed, or loky is not installed.
        """
        self.n_runs += len(jobs)
        if self.workers == 1 or len(jobs) == 1:
            return [(local_function or function)(job) for job in jobs]
        try:
            from loky.process_executor import BrokenProcessPool, ProcessPoolExecutor
        except ImportError as error:
            remedy = "pip install 'cloth_sim_ros[batch]', or use --workers 1"
            raise FitError(f"{self.workers} processes need loky: {remedy}") from error

        try:
            with safe_imports():
                if self._pool is None:
                    # The standard library's processes would run the user's program again at their start.
                    settings = {
                        "initializer": _start_worker,
                        "initargs": (os.getpid(), self._initializer, self._arguments),
                    }
                    self._pool = ProcessPoolExecutor(self.workers, **settings, env=overrides())
                return list(self._pool.map(function, jobs))
        except BrokenProcessPool as error:
            raise FitError("a worker process was killed, possibly out of memory; use --workers 1") from error


def _start_worker(parent: int, initializer: Callable[..., None] | None, arguments: tuple[Any, ...]) -> None:
    exit_with_parent(parent)
    # Ctrl-C reaches all processes. The parent process stops its workers.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if initializer is not None:
        initializer(*arguments)
