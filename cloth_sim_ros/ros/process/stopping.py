# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Signal handling: SIGINT, SIGTERM and SIGHUP request a stop."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class StopRequestedError(Exception):
    """Error: a signal requested a stop during an interruptible computation or wait."""


class StopSignals:
    """Handlers of SIGINT, SIGTERM and SIGHUP that only record the signal; loops and waits poll `requested`.

    `ros2 launch` sends SIGINT twice on Ctrl-C; the second one changes nothing.

    rclpy's handlers would shut the context down at once, with a recording still open and frames still to publish.
    Python's handlers would raise anywhere. These handlers raise nothing.
    """

    def __init__(self) -> None:
        self.requested: signal.Signals | None = None
        self._exits_at_once = False

    def install(self) -> None:
        """Install the handlers of SIGINT, SIGTERM and SIGHUP; call it in the main thread."""
        for signum in _SIGNALS:
            signal.signal(signum, self._on_signal)

    def ignore(self) -> None:
        """Ignore stop signals from now on, also in the interpreter's shutdown, which would restore the defaults."""
        for signum in _SIGNALS:
            signal.signal(signum, signal.SIG_IGN)

    def name(self) -> str:
        """Return the name of the signal that was received, e.g. SIGINT; empty if none was."""
        return "" if self.requested is None else self.requested.name

    @contextmanager
    def exiting_at_once(self) -> Iterator[None]:
        """Context in which the first signal ends the process at once, with status 0: nothing needs a shutdown yet.

        Used during imports: an exception there may be mistaken for a missing library and leaves partial modules.
        """
        self._exits_at_once = True
        try:
            yield
        finally:
            self._exits_at_once = False

    def report_early_stop(self) -> None:
        """Print to standard error that a signal stopped the node while it was starting."""
        name = self.requested.name if self.requested else "a signal"
        print(f"cloth_sim: {name}: stopped while starting", file=sys.stderr, flush=True)

    def _on_signal(self, signum: int, _frame: FrameType | None) -> None:
        self.requested = signal.Signals(signum)
        if self._exits_at_once:
            # Not by print: the signal may have come during one.
            os.write(2, f"cloth_sim: {self.requested.name}: stopped while starting\n".encode())
            os._exit(0)
