# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Interleaved timing: candidates run in turns, so that background load affects all alike."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping

import attrs

#: Minimum rounds of each candidate, for a meaningful median.
MIN_ROUNDS = 5


@attrs.frozen
class InterleavedTimes:
    """Interleaved run times: one per candidate and round [s]."""

    seconds: dict[str, list[float]]

    def median(self, name: str) -> float:
        """Median time of a candidate [s]."""
        return statistics.median(self.seconds[name])

    def ratio(self, name: str, baseline: str) -> float:
        """Return the median over the rounds of the time of `name` over that of `baseline`."""
        pairs = zip(self.seconds[name], self.seconds[baseline], strict=True)
        return statistics.median(candidate / reference for candidate, reference in pairs)


def time_interleaved(
    candidates: Mapping[str, Callable[[], object]], *, seconds: float, clock: Callable[[], float] = time.perf_counter
) -> InterleavedTimes:
    """Time candidates round by round for about `seconds`, and at least `MIN_ROUNDS` rounds.

    A warm-up round before these is not counted.

    Args:
        candidates: functions to time, by name.
        seconds: wall time of all rounds [s].
        clock: clock of a turn [s]: the wall clock, or `time.thread_time` for work on one thread. The latter excludes
            the time of other processes on the core.
    """
    for candidate in candidates.values():
        candidate()
    times: dict[str, list[float]] = {name: [] for name in candidates}
    end, rounds = time.perf_counter() + seconds, 0
    while rounds < MIN_ROUNDS or time.perf_counter() < end:
        for name, candidate in candidates.items():
            start = clock()
            candidate()
            times[name].append(clock() - start)
        rounds += 1
    return InterleavedTimes(times)
