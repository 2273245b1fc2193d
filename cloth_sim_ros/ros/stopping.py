# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""SIGINT, SIGTERM and SIGHUP as a request to stop, not as an exception out of nowhere."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class StopRequestedError(Exception):
    """A signal asked to stop while something long was running that allows to be interrupted."""


class StopSignals:
    """Takes note of signals. `ros2 launch` sends SIGINT twice on Ctrl-C: the second one changes nothing.

    rclpy's own handlers would shut the context down at once, with a recording still open and frames still to publish;
    Python's would raise anywhere. Here those who loop or wait look at `requested`; nothing is raised.
    """

    def __init__(self) -> None:
        self.requested: signal.Signals | None = None
        self._ending = False

    def install(self) -> None:
        """Take over the signals; from the main thread only."""
        for number in _SIGNALS:
            signal.signal(number, self._handle)

    def ignore(self) -> None:
        """Ignore the signals from now on, the interpreter's own end included: it would put their defaults back."""
        for number in _SIGNALS:
            signal.signal(number, signal.SIG_IGN)

    def name(self) -> str:
        """Name of the signal that has come; empty while none has."""
        return "" if self.requested is None else self.requested.name

    @contextmanager
    def ending(self) -> Iterator[None]:
        """Within, the first signal ends the process at once, in order: nothing has begun yet that would need an end.

        For the time of imports: an exception amid them may be taken for a missing library, and leaves halves behind.
        """
        self._ending = True
        try:
            yield
        finally:
            self._ending = False

    def tell_early_end(self) -> None:
        """Say in one line that a signal came before the node ran."""
        name = self.requested.name if self.requested else "a signal"
        print(f"cloth_sim: {name}: stopped while starting", file=sys.stderr, flush=True)

    def _handle(self, number: int, _frame: FrameType | None) -> None:
        self.requested = signal.Signals(number)
        if self._ending:
            # Not by print: the signal may have come amid one.
            os.write(2, f"cloth_sim: {self.requested.name}: stopped while starting\n".encode())
            os._exit(0)
