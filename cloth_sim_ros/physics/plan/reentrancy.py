# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Guard against re-entrant calls of a plan.

Two calls at a time may come from two threads, or from a Python force that calls its own plan.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
from typing import Concatenate, ParamSpec, Protocol, TypeVar

from cloth_sim_ros.engine.binding import REENTRY_REFUSAL


class HasCallLock(Protocol):
    """An object that allows one call at a time; a call holds the lock."""

    call_lock: threading.Lock


_Self = TypeVar("_Self", bound=HasCallLock)
_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


def non_reentrant(
    method: Callable[Concatenate[_Self, _Arguments], _Result],
) -> Callable[Concatenate[_Self, _Arguments], _Result]:
    """Refuse a second call of a method while one is running: both would write into the same memory.

    Raises:
        RuntimeError: for the second call.
    """

    @functools.wraps(method)
    def alone(self: _Self, *arguments: _Arguments.args, **named: _Arguments.kwargs) -> _Result:
        if not self.call_lock.acquire(False):
            raise RuntimeError(REENTRY_REFUSAL)
        try:
            return method(self, *arguments, **named)
        finally:
            self.call_lock.release()

    return alone
