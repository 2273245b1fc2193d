# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Exclusive access to a simulation from several threads."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
from typing import Concatenate, ParamSpec, TypeVar

from cloth_sim_ros.physics.plan.uncopyable import Uncopyable

_Self = TypeVar("_Self", bound="ExclusiveAccess")
_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


class ExclusiveAccess(Uncopyable):
    """Base of objects whose guarded methods run one at a time.

    If another thread's call is running, a call waits for its end. Results are therefore those of some sequence of
    calls. A call within a call of the same thread is refused.
    """

    copy_refusal = (
        "a simulation owns memory of the engine, and can't be copied or pickled; make another one of its scene, and "
        "restore this one's snapshot() in it"
    )

    def __init__(self) -> None:
        # Reentrant, so that a second call of the same thread finds `_is_running` set instead of a deadlock.
        self._lock = threading.RLock()
        self._is_running = False


def exclusive(
    method: Callable[Concatenate[_Self, _Arguments], _Result],
) -> Callable[Concatenate[_Self, _Arguments], _Result]:
    """Decorate a method: it waits for other threads' guarded calls, and raises RuntimeError in one of its own thread.

    Raises:
        RuntimeError: for a call within another one of the same thread, e.g. by a force or by a signal's handler.
    """

    @functools.wraps(method)
    def guarded(self: _Self, *arguments: _Arguments.args, **named: _Arguments.kwargs) -> _Result:
        with self._lock:
            if self._is_running:
                raise RuntimeError(
                    f"{type(self).__name__}.{method.__name__} was called while another call of this simulation runs in "
                    "the same thread (by a force, or by a signal's handler); call it after that one has returned, or "
                    "make a simulation of its own for it"
                )
            self._is_running = True
            try:
                return method(self, *arguments, **named)
            finally:
                self._is_running = False

    return guarded


def between_frames(
    method: Callable[Concatenate[_Self, _Arguments], _Result],
) -> Callable[Concatenate[_Self, _Arguments], _Result]:
    """Decorate a read-only method: it waits for other threads' calls, and runs within a call of the same thread."""

    @functools.wraps(method)
    def guarded(self: _Self, *arguments: _Arguments.args, **named: _Arguments.kwargs) -> _Result:
        with self._lock:
            return method(self, *arguments, **named)

    return guarded
