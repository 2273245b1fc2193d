# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Whether frames come late, told when that begins, now and then while it lasts, and when it ends."""

from __future__ import annotations

import statistics

from cloth_sim_ros.ros.log import ThrottledLog
from cloth_sim_ros.session.words import counted

#: A judgement is over at least so much time [s], and so many frames.
WINDOW, FEWEST = 2.0, 20
#: Share of a window's frames above which the cloth is late: single ones are the system's, /diagnostics counts them.
MANY = 0.05
#: While it lasts it is told again after so many windows.
AGAIN = 30
#: Windows in time before that is told.
CALM = 5
#: Above this share of the period it is computing that takes the time.
BUSY = 0.9
#: A contact that begins is reported if it makes the real-time factor smaller than this share of the last one reported.
WORSE = 0.8
#: What makes frames cheaper.
REMEDY = "a smaller cloth.resolution, a lower rate, a larger tolerance, or overload: relax gives it less to do"


class Lateness:
    """Follows frames that are due by wall time.

    Args:
        period: time between two frames [s].
        log: told.
    """

    def __init__(self, *, period: float, log: ThrottledLog) -> None:
        self._period = period
        self._log = log
        self._most = max(FEWEST, round(WINDOW / period))
        self._is_late = False
        self._windows = 0
        self._calm = 0
        self._sum = 0
        #: Real-time factor reported last.
        self._reported = 1.0
        self._since = ""
        self._begin()

    def begin_contact(self, names: str) -> None:
        """Restart the measurement, because the cloth has begun to touch something.

        Args:
            names: of what it touches, as the end of a sentence.
        """
        self._since = f" since the cloth touches {names}"
        self._begin()

    def count(self, *, lateness: int, skipped: int, seconds: float, follows_clock: bool) -> int:
        """Return the number of due times, a frame's and those skipped before it, that count as late.

        Args:
            lateness: how much later it began than it was due [ns].
            skipped: due times before this one that were left out.
            seconds: wall time that the frame took [s].
            follows_clock: whether /clock makes frames due: then real time promises nothing of a step but a period for
                each frame that is made up for, which `lateness` takes into account.
        """
        period = round(1e9 * self._period)
        if follows_clock:
            return int(lateness > period)
        late = skipped + (lateness + int(1e9 * seconds) > period)
        self.add(late=late, skipped=skipped, seconds=seconds)
        return late

    def add(self, *, late: int, skipped: int, seconds: float) -> None:
        """Take note of a frame.

        Args:
            late: number of due times, this frame's and those skipped before it, whose frame was not out a period later.
            skipped: due times before this one that were left out.
            seconds: wall time that the frame took [s].
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
                self._log.info("in time", f"frames come in time again; {counted(self._sum, 'frame')} late or left out")
        self._since = ""

    def _tell(self, factor: float) -> None:
        middle, period = statistics.median(self._taken), self._period
        if middle > BUSY * period:
            why = "the cloth takes more time than this machine has"
        else:
            why = "the machine had other things to do"
        self._log.warn(
            "late",
            f"frames come late: {self._late} of {self._due} were not there a period after they were due; one takes "
            f"{middle * 1e3:.1f} ms of {period * 1e3:.1f} ms: {why}{self._describe(factor, middle)}",
        )
        self._reported = factor

    def _describe(self, factor: float, middle: float) -> str:
        """Return the real-time factor, if it is below 1, and what would raise it, as the end of a sentence."""
        if factor > 1.0 - MANY:
            return ""
        remedy = f": {REMEDY}" if middle > BUSY * self._period else ""
        return f"; the real-time factor is {factor:.2g}{self._since}{remedy}"
