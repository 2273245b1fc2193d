# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Candidates timed in turns, so that what else the machine does falls on all alike."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping

import attrs

#: Turns that each candidate gets at least: a median of fewer says little.
FEWEST_TURNS = 5


@attrs.frozen
class Turns:
    """Times of candidates that took turns: one a round each [s]."""

    seconds: dict[str, list[float]]

    def median(self, name: str) -> float:
        """Median time of a candidate [s]."""
        return statistics.median(self.seconds[name])

    def ratio(self, name: str, other: str) -> float:
        """How many times as long as `other` a candidate takes: the median over the rounds, each a fair comparison."""
        pairs = zip(self.seconds[name], self.seconds[other], strict=True)
        return statistics.median(mine / theirs for mine, theirs in pairs)


def take_turns(
    candidates: Mapping[str, Callable[[], None]], *, seconds: float, clock: Callable[[], float] = time.perf_counter
) -> Turns:
    """Time candidates round by round for about so many seconds, and `FEWEST_TURNS` rounds at least.

    A round before these, in which they warm up, is not counted.

    Args:
        candidates: what is timed, by name.
        seconds: wall time of it all.
        clock: what tells a turn's time [s]: the wall clock, or for work on one thread `time.thread_time`, which stands
            still while others have the core.
    """
    for candidate in candidates.values():
        candidate()
    times: dict[str, list[float]] = {name: [] for name in candidates}
    end, rounds = time.perf_counter() + seconds, 0
    while rounds < FEWEST_TURNS or time.perf_counter() < end:
        for name, candidate in candidates.items():
            start = clock()
            candidate()
            times[name].append(clock() - start)
        rounds += 1
    return Turns(times)
