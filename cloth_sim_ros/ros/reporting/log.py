# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Log that repeats each kind of message at most once in a period."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.logging import LoggingSeverity

#: Largest number of distinct kinds of message. Kinds contain gripper names; this is far above what is needed.
_MAX_KINDS = 1000
#: Longest line [characters]. Names in received messages may have any length.
_MAX_LINE_LENGTH = 1000
_INFO, _WARN, _ERROR = "info", "warn", "error"


class ThrottledLog:
    """Log of each kind of message at most once in a period, with the number of messages omitted since.

    Args:
        logger: a node's logger.
        seconds: shortest time between two messages of one kind [s].
        clock: monotonic clock [s].
    """

    def __init__(self, logger: Any, *, seconds: float = 1.0, clock: Callable[[], float] = time.monotonic) -> None:
        self._logger, self._seconds, self._clock = logger, seconds, clock
        self._last: dict[str, float] = {}
        #: True if DEBUG lines are logged; `flush` updates it, because a query takes microseconds.
        self.debugging = False
        #: For each kind the number of omitted messages, the newest of them, and its severity.
        self._left_out: dict[str, tuple[int, str, str]] = {}

    def debug(self, message: Callable[[], str]) -> None:
        """Log a DEBUG line, unthrottled; `message` builds its text and is called only while the level is DEBUG."""
        if self.debugging:
            self._logger.debug(message())

    def info(self, kind: str, message: str) -> None:
        """Log a message at level INFO, or count it as omitted if one of its kind was logged within the period."""
        self._log(kind, message, _INFO)

    def warn(self, kind: str, message: str) -> None:
        """Log a message at level WARN, or count it as omitted if one of its kind was logged within the period."""
        self._log(kind, message, _WARN)

    def error(self, kind: str, message: str) -> None:
        """Log a message at level ERROR, or count it as omitted if one of its kind was logged within the period."""
        self._log(kind, message, _ERROR)

    def flush(self) -> None:
        """Log the newest omitted message of each kind whose period is over, and update whether DEBUG is logged.

        Call it periodically.
        """
        self.debugging = bool(self._logger.is_enabled_for(LoggingSeverity.DEBUG))
        now = self._clock()
        for kind in [kind for kind in self._left_out if now - self._last.get(kind, now) >= self._seconds]:
            count, message, severity = self._left_out.pop(kind)
            self._last[kind] = now
            self._write(f"{message}{_more(count - 1)}", severity)

    def _log(self, kind: str, message: str, severity: str) -> None:
        now, message = self._clock(), shorten_lines(message)
        last = self._last.get(kind)
        if last is not None and now - last < self._seconds:
            count = self._left_out[kind][0] if kind in self._left_out else 0
            self._left_out[kind] = (count + 1, message, severity)
            return
        if last is None and len(self._last) >= _MAX_KINDS:
            self._last.clear()
            self._left_out.clear()
        self._last[kind] = now
        count = self._left_out.pop(kind)[0] if kind in self._left_out else 0
        self._write(f"{message}{_more(count)}", severity)

    def _write(self, text: str, severity: str) -> None:
        # One call each: rclpy allows one severity per line of code.
        if severity == _INFO:
            self._logger.info(text)
        elif severity == _WARN:
            self._logger.warning(text)
        else:
            self._logger.error(text)


def shorten_lines(text: str) -> str:
    """Return a text with the middle of each line of more than 1000 characters left out."""
    if len(text) <= _MAX_LINE_LENGTH:
        return text
    half = _MAX_LINE_LENGTH // 2
    return "\n".join(
        line
        if len(line) <= _MAX_LINE_LENGTH
        else f"{line[:half]} ... ({len(line) - 2 * half} characters left out) ... {line[-half:]}"
        for line in text.split("\n")
    )


def _more(count: int) -> str:
    return f" ({count} more of this kind since the last message)" if count else ""
