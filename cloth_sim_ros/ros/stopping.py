# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""SIGINT, SIGTERM and SIGHUP as a request to stop, not as an exception out of nowhere."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class StopRequestedError(Exception):
    """A signal asked to stop while something long was running that allows to be interrupted."""


class StopSignals:
    """Takes note of signals. `ros2 launch` sends SIGINT twice on Ctrl-C: the second one changes nothing.

    rclpy's own handlers would shut the context down at once, with a recording still open and frames still to publish;
    Python's would raise anywhere. Here the loop looks at `requested`, and only what is `interruptible` is interrupted.
    """

    def __init__(self) -> None:
        self.requested: signal.Signals | None = None
        self._interruptible = False

    def install(self) -> None:
        """Take over the signals; from the main thread only."""
        for number in _SIGNALS:
            signal.signal(number, self._handle)

    def ignore(self) -> None:
        """Ignore the signals from now on, the interpreter's own end included: it would put their defaults back."""
        for number in _SIGNALS:
            signal.signal(number, signal.SIG_IGN)

    @contextmanager
    def interruptible(self) -> Iterator[None]:
        """Within, the first signal raises `StopRequestedError`.

        Raises:
            StopRequestedError: also at once, if a signal came before.
        """
        self._interruptible = True
        try:
            if self.requested is not None:
                raise StopRequestedError(self.requested.name)
            yield
        finally:
            self._interruptible = False

    def _handle(self, number: int, _frame: FrameType | None) -> None:
        first = self.requested is None
        self.requested = signal.Signals(number)
        if first and self._interruptible:
            raise StopRequestedError(self.requested.name)
