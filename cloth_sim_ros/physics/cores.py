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
MOST = 2


class _Limit(threading.local):
    alone = False


_LIMIT = _Limit()


def available() -> int:
    """Return the number of threads of a frame that the calling thread starts; no bit depends on it."""
    return 1 if _LIMIT.alone else min(MOST, len(os.sched_getaffinity(0)))


@contextlib.contextmanager
def alone() -> Iterator[None]:
    """Restrict frames that the calling thread starts to one thread."""
    before, _LIMIT.alone = _LIMIT.alone, True
    try:
        yield
    finally:
        _LIMIT.alone = before
