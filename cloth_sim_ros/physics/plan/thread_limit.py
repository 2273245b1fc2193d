# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Thread limit for the frames of one cloth.

A pool that steps many cloths at once uses one thread a cloth.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Iterator

#: Most threads of a frame; more threads synchronise too often.
MAX_THREADS = 2


class _ThreadLimit(threading.local):
    is_single = False


_LIMIT = _ThreadLimit()


def available_threads() -> int:
    """Return how many threads a frame that the calling thread starts may use, at most 2; no bit depends on it."""
    return 1 if _LIMIT.is_single else min(MAX_THREADS, len(os.sched_getaffinity(0)))


@contextlib.contextmanager
def single_threaded() -> Iterator[None]:
    """Restrict frames that the calling thread starts to one thread, during a `with` block."""
    previous, _LIMIT.is_single = _LIMIT.is_single, True
    try:
        yield
    finally:
        _LIMIT.is_single = previous
