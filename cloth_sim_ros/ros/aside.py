# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A thread for what may take long, so that a signal is heard meanwhile.

Python handles signals between two instructions of the main thread: while that is inside the engine, they wait. A
main thread that waits for another one hears them, and looks now and then whether one has come. Nothing is raised out
of a signal's handler: where that happens amid a callback of rclpy's or of the garbage collection's, it is printed and
forgotten.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable
from queue import Empty, SimpleQueue
from typing import Any, NoReturn, TypeVar

from cloth_sim_ros.ros.stopping import StopRequestedError

T = TypeVar("T")
#: How often the waiting thread looks up [s].
_GLANCE = 0.1


def at_once(job: Callable[[], T]) -> T:
    """Run a job here and now: what a node does whose process nobody stops by a signal."""
    return job()


class Turn:
    """A lock that its holder may take again. Who waits for it hears signals.

    Args:
        stopped: returns the name of the signal that has come, empty while none has.
    """

    def __init__(self, stopped: Callable[[], str]) -> None:
        self._stopped = stopped
        self._lock = threading.RLock()

    def __enter__(self) -> None:
        """Take it.

        Raises:
            StopRequestedError: if a signal has come and the lock is not free soon.
        """
        while not self._lock.acquire(timeout=_GLANCE):
            stopped = self._stopped()
            if stopped and not self._lock.acquire(timeout=_GLANCE):
                raise StopRequestedError(stopped)
            if stopped:
                return

    def __exit__(self, *_: object) -> None:
        self._lock.release()


class Aside:
    """Runs one job at a time in a thread of its own while the caller, the main thread, waits; those of other threads
    here and now.

    Args:
        stopped: returns the name of the signal that has come, empty while none has.
    """

    def __init__(self, stopped: Callable[[], str]) -> None:
        self._stopped = stopped
        self._jobs: SimpleQueue[Callable[[], Any]] = SimpleQueue()
        self._outcomes: SimpleQueue[tuple[Any, BaseException | None]] = SimpleQueue()
        self._thread: threading.Thread | None = None
        self._running = False

    @property
    def left(self) -> bool:
        """Whether a signal came before a job ended: it goes on alone, and what it works on is not to be read."""
        return self._running

    def run(self, job: Callable[[], T]) -> T:
        """Run a job and return what it returns, or raise what it raises.

        Raises:
            StopRequestedError: if a signal came before, or comes and the job is not done soon; one that had begun is
                left to itself.
        """
        if threading.current_thread() is not threading.main_thread():
            # Which hears signals meanwhile.
            return job()
        if self._stopped():
            raise StopRequestedError(self._stopped())
        if self._thread is None:
            # A daemon: it must not hold up the end of the process.
            self._thread = threading.Thread(target=self._work, name="frames", daemon=True)
            self._thread.start()
        self._running = True
        self._jobs.put(job)
        result, error = self._wait()
        self._running = False
        if error is not None:
            raise error
        outcome: T = result
        return outcome

    def _wait(self) -> tuple[Any, BaseException | None]:
        while True:
            stopped = self._stopped()
            try:
                return self._outcomes.get(timeout=_GLANCE)
            except Empty:
                if stopped:
                    raise StopRequestedError(stopped) from None

    def leave(self) -> None:
        """Take note that a frame of another thread goes on alone."""
        self._running = True

    def end_process(self, status: int) -> NoReturn:
        """End the process at once.

        An abandoned job may still be inside the engine, and the interpreter's own shutdown would free memory that the
        job uses.
        """
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)

    def _work(self) -> None:
        while True:
            job = self._jobs.get()
            try:
                self._outcomes.put((job(), None))
            except BaseException as error:
                # The caller's to handle, whatever it is.
                self._outcomes.put((None, error))
