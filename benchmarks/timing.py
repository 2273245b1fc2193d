# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Interleaved timing: candidates run in turns, so that background load affects all alike."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Hashable, Mapping
from functools import partial
from typing import TypeVar

import attrs

K = TypeVar("K", bound=Hashable)
T = TypeVar("T")

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

    def differences(self, name: str, baseline: str) -> list[float]:
        """Return the time of `name` less that of `baseline`, by round [s]."""
        return [time - shorter for time, shorter in zip(self.seconds[name], self.seconds[baseline], strict=True)]


def time_interleaved(
    candidates: Mapping[str, Callable[[], object]], *, seconds: float, clock: Callable[[], float] = time.perf_counter
) -> InterleavedTimes:
    """Time candidates by `run_interleaved`.

    Args:
        candidates: functions to time, by name.
        seconds: wall time of all rounds [s].
        clock: clock of a turn [s]: the wall clock, or `time.thread_time` for work on one thread. The latter excludes
            the time of other processes on the core.
    """

    def timed(candidate: Callable[[], object]) -> float:
        start = clock()
        candidate()
        return clock() - start

    timers = {name: partial(timed, candidate) for name, candidate in candidates.items()}
    return InterleavedTimes(run_interleaved(timers, seconds=seconds))


def run_interleaved(candidates: Mapping[K, Callable[[], T]], *, seconds: float) -> dict[K, list[T]]:
    """Run candidates round by round for about `seconds`, and at least `MIN_ROUNDS` rounds; return their results.

    The results of a warm-up round before these are left out.
    """
    for candidate in candidates.values():
        candidate()
    results: dict[K, list[T]] = {name: [] for name in candidates}
    end, rounds = time.perf_counter() + seconds, 0
    while rounds < MIN_ROUNDS or time.perf_counter() < end:
        for name, candidate in candidates.items():
            results[name].append(candidate())
        rounds += 1
    return results


def repeated(function: Callable[[], object], count: int) -> Callable[[], None]:
    """Return a function that calls another one several times."""

    def run() -> None:
        for _ in range(count):
            function()

    return run
