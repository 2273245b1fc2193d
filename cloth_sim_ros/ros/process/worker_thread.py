# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A worker thread that keeps the main thread responsive to signals.

Python runs signal handlers between two instructions of the main thread. While that thread is inside the engine, signals
wait. Therefore the main thread waits for the worker thread instead, and polls for signals.
A handler raises nothing: an exception within a callback of rclpy or of the garbage collector is printed and lost.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable
from queue import Empty, SimpleQueue
from typing import Any, NoReturn, TypeVar

from cloth_sim_ros.ros.process.stopping import StopRequestedError

T = TypeVar("T")
#: Period at which a waiting thread polls for signals [s].
_SIGNAL_POLL_PERIOD = 0.1


def run_inline(job: Callable[[], T]) -> T:
    """Run a job in the calling thread and return its result; for nodes whose process handles no stop signals."""
    return job()


class InterruptibleLock:
    """A reentrant lock: a thread that waits for it can be interrupted by SIGINT, SIGTERM or SIGHUP.

    Args:
        signal_name: returns the name of the signal that has come; empty if none has.
    """

    def __init__(self, signal_name: Callable[[], str]) -> None:
        self._signal_name = signal_name
        self._lock = threading.RLock()

    def __enter__(self) -> None:
        """Wait for the lock and take it; raise StopRequestedError if a stop signal came and it is not free in 0.1 s.

        Raises:
            StopRequestedError: if a signal has come and the lock is not free within 0.1 s.
        """
        while not self._lock.acquire(timeout=_SIGNAL_POLL_PERIOD):
            name = self._signal_name()
            if name and not self._lock.acquire(timeout=_SIGNAL_POLL_PERIOD):
                raise StopRequestedError(name)
            if name:
                return

    def __exit__(self, *_: object) -> None:
        self._lock.release()


class WorkerThread:
    """Thread that runs one job at a time, while the main thread waits and polls for stop signals.

    Jobs of other threads run in the calling thread.

    Args:
        signal_name: returns the name of the signal that has come; empty if none has.
    """

    def __init__(self, signal_name: Callable[[], str]) -> None:
        self._signal_name = signal_name
        self._jobs: SimpleQueue[Callable[[], Any]] = SimpleQueue()
        self._results: SimpleQueue[tuple[Any, BaseException | None]] = SimpleQueue()
        self._thread: threading.Thread | None = None
        self._running = False

    @property
    def is_abandoned(self) -> bool:
        """True while a job runs: after `run` was left by a signal, it goes on, and its objects must not be read."""
        return self._running

    def run(self, job: Callable[[], T]) -> T:
        """Run a job in the worker thread and wait for it; return or raise what it does; StopRequestedError on a signal.

        Outside the main thread, which handles signals, the job runs in the caller's thread.

        Raises:
            StopRequestedError: if a signal came before the job, or comes and the job does not end within 0.1 s. A job
                that has begun is abandoned.
        """
        if threading.current_thread() is not threading.main_thread():
            # The main thread handles signals meanwhile.
            return job()
        if self._signal_name():
            raise StopRequestedError(self._signal_name())
        if self._thread is None:
            # A daemon thread does not delay the end of the process.
            self._thread = threading.Thread(target=self._run_jobs, name="frames", daemon=True)
            self._thread.start()
        self._running = True
        self._jobs.put(job)
        result, error = self._wait()
        self._running = False
        if error is not None:
            raise error
        returned: T = result
        return returned

    def _wait(self) -> tuple[Any, BaseException | None]:
        while True:
            name = self._signal_name()
            try:
                return self._results.get(timeout=_SIGNAL_POLL_PERIOD)
            except Empty:
                if name:
                    raise StopRequestedError(name) from None

    def abandon(self) -> None:
        """Set `is_abandoned`, because the pacer's thread still computes a frame."""
        self._running = True

    def end_process(self, status: int) -> NoReturn:
        """End the process at once, without the interpreter's shutdown.

        An abandoned job may still be inside the engine, and the interpreter's own shutdown would free memory that the
        job uses.
        """
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)

    def _run_jobs(self) -> None:
        while True:
            job = self._jobs.get()
            try:
                self._results.put((job(), None))
            except BaseException as error:
                # The caller raises it, whatever it is.
                self._results.put((None, error))
