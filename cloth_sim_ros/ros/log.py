# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Logging that a flood of bad input can't flood."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

#: Kinds of message that are told apart; names of grippers are part of a kind, so this is far above what is needed.
_MOST_KINDS = 1000


class ThrottledLog:
    """Logs each kind of message at most once in a while, and says how many it left out.

    Args:
        logger: a node's logger.
        seconds: least time between two messages of one kind [s].
        clock: seconds of a clock that never goes back.
    """

    def __init__(self, logger: Any, *, seconds: float = 1.0, clock: Callable[[], float] = time.monotonic) -> None:
        self._logger = logger
        self._seconds = seconds
        self._clock = clock
        self._last: dict[str, float] = {}
        self._left_out: dict[str, int] = {}

    def info(self, kind: str, message: str) -> None:
        """Log what is worth knowing."""
        text = self._pass(kind, message)
        if text is not None:
            self._logger.info(text)

    def warn(self, kind: str, message: str) -> None:
        """Log what someone should look at."""
        text = self._pass(kind, message)
        if text is not None:
            self._logger.warning(text)

    def error(self, kind: str, message: str) -> None:
        """Log what went wrong."""
        text = self._pass(kind, message)
        if text is not None:
            self._logger.error(text)

    def _pass(self, kind: str, message: str) -> str | None:
        now = self._clock()
        last = self._last.get(kind)
        if last is not None and now - last < self._seconds:
            self._left_out[kind] = self._left_out.get(kind, 0) + 1
            return None
        if last is None and len(self._last) >= _MOST_KINDS:
            self._last.clear()
        self._last[kind] = now
        left_out = self._left_out.pop(kind, 0)
        return f"{message} ({left_out} more of this kind since the last message)" if left_out else message
