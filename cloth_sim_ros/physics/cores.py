# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How many threads the frames of one cloth may take: whoever steps many cloths at once has given each core its own."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Iterator

#: Most that a frame takes: more of them meet too often.
MOST = 2


class _Limit(threading.local):
    alone = False


_LIMIT = _Limit()


def available() -> int:
    """Threads that a frame which is called from this thread may take; no bit depends on it."""
    return 1 if _LIMIT.alone else min(MOST, len(os.sched_getaffinity(0)))


@contextlib.contextmanager
def alone() -> Iterator[None]:
    """Let frames that are called from this thread take no further one."""
    before, _LIMIT.alone = _LIMIT.alone, True
    try:
        yield
    finally:
        _LIMIT.alone = before
