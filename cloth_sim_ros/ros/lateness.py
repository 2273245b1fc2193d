# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Deadline monitor: logs when frames start and stop missing their period."""

from __future__ import annotations

import statistics

from cloth_sim_ros.ros.log import ThrottledLog
from cloth_sim_ros.session.words import counted

#: Smallest length of a window: time [s], and ticks.
WINDOW, FEWEST = 2.0, 20
#: Fraction of late ticks in a window above which the cloth is late. /diagnostics counts single late frames.
MANY = 0.05
#: Number of windows between two warnings while the cloth is late.
AGAIN = 30
#: Number of consecutive windows in time before the recovery is logged.
CALM = 5
#: Above this fraction of the period, the computation is the cause of late frames.
BUSY = 0.9
#: A new contact is reported if the real-time factor falls below this fraction of the last one reported.
WORSE = 0.8
#: Ways to make frames cheaper.
REMEDY = "a smaller cloth.resolution, a lower rate, a larger tolerance, or overload: relax reduces the load"


class Lateness:
    """Monitors frames that are due by wall time.

    Args:
        period: time between two frames [s].
        log: receives warnings and recoveries.
    """

    def __init__(self, *, period: float, log: ThrottledLog) -> None:
        self._period = period
        self._log = log
        self._most = max(FEWEST, round(WINDOW / period))
        self._is_late = False
        self._windows = 0
        self._calm = 0
        self._sum = 0
        #: Last reported real-time factor.
        self._reported = 1.0
        self._since = ""
        self._begin()

    def begin_contact(self, names: str) -> None:
        """Restart the window, because a contact has begun.

        Args:
            names: of the contacts, as the end of a sentence.
        """
        self._since = f" since the cloth touches {names}"
        self._begin()

    def count(self, *, lateness: int, skipped: int, seconds: float, follows_clock: bool) -> int:
        """Return the number of late ticks: a frame's own and those skipped before it.

        Args:
            lateness: delay of the frame's start behind its tick [ns].
            skipped: number of skipped ticks before the frame.
            seconds: wall time of the frame [s].
            follows_clock: true if /clock makes frames due. Then each frame has one period of real time, which
                `lateness` takes into account.
        """
        period = round(1e9 * self._period)
        if follows_clock:
            return int(lateness > period)
        late = skipped + (lateness + int(1e9 * seconds) > period)
        self.add(late=late, skipped=skipped, seconds=seconds)
        return late

    def add(self, *, late: int, skipped: int, seconds: float) -> None:
        """Add a frame to the window.

        Args:
            late: number of late ticks, the frame's own and those skipped before it.
            skipped: number of skipped ticks before the frame.
            seconds: wall time of the frame [s].
        """
        self._due += 1 + skipped
        self._late += late
        self._taken.append(seconds)
        if self._due >= self._most:
            self._judge()
            self._begin()

    def _begin(self) -> None:
        self._due, self._late = 0, 0
        self._taken: list[float] = []

    def _judge(self) -> None:
        if self._late > MANY * self._due:
            if not self._is_late:
                self._is_late, self._windows, self._sum = True, 0, 0
            self._calm = 0
            self._sum += self._late
            factor = len(self._taken) / self._due
            if self._windows % AGAIN == 0 or (self._since and factor < WORSE * self._reported):
                self._tell(factor)
                self._windows = 0
            self._windows += 1
        elif self._is_late:
            self._sum += self._late
            self._calm += 1
            if self._calm == CALM:
                self._is_late, self._reported = False, 1.0
                self._log.info("in time", f"frames are on time again; {counted(self._sum, 'frame')} late or skipped")
        self._since = ""

    def _tell(self, factor: float) -> None:
        middle, period = statistics.median(self._taken), self._period
        if middle > BUSY * period:
            why = "the cloth is too slow for this machine and rate"
        else:
            why = "other processes use the machine"
        self._log.warn(
            "late",
            f"frames come late: {self._late} of {self._due} missed their period; one takes "
            f"{middle * 1e3:.1f} ms of {period * 1e3:.1f} ms: {why}{self._describe(factor, middle)}",
        )
        self._reported = factor

    def _describe(self, factor: float, middle: float) -> str:
        """Return the real-time factor if it is below 1, and the remedy, as the end of a sentence."""
        if factor > 1.0 - MANY:
            return ""
        remedy = f": {REMEDY}" if middle > BUSY * self._period else ""
        return f"; the real-time factor is {factor:.2g}{self._since}{remedy}"
