# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Deadline monitor: logs when frames start and stop missing their period."""

from __future__ import annotations

import statistics

from cloth_sim_ros.ros.reporting.log import ThrottledLog
from cloth_sim_ros.session.plurals import pluralize
from cloth_sim_ros.simulation.simulation import Frame, Simulation

#: Smallest length of a window: time [s], and ticks.
WINDOW, MIN_TICKS = 2.0, 20
#: Fraction of late ticks in a window above which the cloth is late. /diagnostics counts single late frames.
LATE_FRACTION = 0.05
#: Number of windows between two warnings while the cloth is late.
REPORT_WINDOWS = 30
#: Number of consecutive windows in time before the recovery is logged.
RECOVERY_WINDOWS = 5
#: Above this fraction of the period, the computation is the cause of late frames.
BUSY_LOAD = 0.9
#: A new contact is reported if the real-time factor falls below this fraction of the last one reported.
WORSE_FACTOR = 0.8
#: Ways to make frames cheaper.
REMEDY = "a smaller cloth.resolution, a lower rate, a larger tolerance, or overload: relax reduces the load"
#: Name of self-contact.
_ITSELF = "itself"


class DeadlineMonitor:
    """Monitor that logs when frames due by wall time start and stop missing their period.

    Args:
        period: time between two frames [s].
        log: receives warnings and recoveries.
    """

    def __init__(self, *, period: float, log: ThrottledLog) -> None:
        self._period, self._log = period, log
        self._window_ticks = max(MIN_TICKS, round(WINDOW / period))
        self._is_late = False
        self._windows = 0
        self._on_time_windows = 0
        self._n_late_total = 0
        #: Last reported real-time factor.
        self._reported_factor = 1.0
        self._contact_text = ""
        self._begin_window()

    def begin_contact(self, names: str) -> None:
        """Restart the window of counted frames because contact has begun; a warning at its end names the contact.

        Args:
            names: of the contacts, as the end of a sentence.
        """
        self._contact_text = f" since the cloth touches {names}"
        self._begin_window()

    def count(self, *, lateness: int, skipped: int, seconds: float, follows_clock: bool) -> int:
        """Add a frame to the window, unless /clock makes frames due, and return its number of late ticks.

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
        """Add a frame to a window of at least 2 s; at its end, log if frames began or ceased to be late.

        Args:
            late: number of late ticks, the frame's own and those skipped before it.
            skipped: number of skipped ticks before the frame.
            seconds: wall time of the frame [s].
        """
        self._n_ticks += 1 + skipped
        self._n_late += late
        self._frame_times.append(seconds)
        if self._n_ticks >= self._window_ticks:
            self._evaluate()
            self._begin_window()

    def _begin_window(self) -> None:
        self._n_ticks, self._n_late = 0, 0
        self._frame_times: list[float] = []

    def _evaluate(self) -> None:
        if self._n_late > LATE_FRACTION * self._n_ticks:
            if not self._is_late:
                self._is_late, self._windows, self._n_late_total = True, 0, 0
            self._on_time_windows = 0
            self._n_late_total += self._n_late
            factor = len(self._frame_times) / self._n_ticks
            if self._windows % REPORT_WINDOWS == 0 or (
                self._contact_text and factor < WORSE_FACTOR * self._reported_factor
            ):
                self._report(factor)
                self._windows = 0
            self._windows += 1
        elif self._is_late:
            self._n_late_total += self._n_late
            self._on_time_windows += 1
            if self._on_time_windows == RECOVERY_WINDOWS:
                self._is_late, self._reported_factor = False, 1.0
                self._log.info(
                    "in time", f"frames are on time again; {pluralize(self._n_late_total, 'frame')} late or skipped"
                )
        self._contact_text = ""

    def _report(self, factor: float) -> None:
        median, period = statistics.median(self._frame_times), self._period
        if median > BUSY_LOAD * period:
            cause = "the cloth is too slow for this machine and rate"
        else:
            cause = "other processes use the machine"
        self._log.warn(
            "late",
            f"frames come late: {self._n_late} of {self._n_ticks} missed their period; one takes "
            f"{median * 1e3:.1f} ms of {period * 1e3:.1f} ms: {cause}{self._describe(factor, median)}",
        )
        self._reported_factor = factor

    def _describe(self, factor: float, median: float) -> str:
        """Return the real-time factor if it is below 1, and the remedy, as the end of a sentence."""
        if factor > 1.0 - LATE_FRACTION:
            return ""
        remedy = f": {REMEDY}" if median > BUSY_LOAD * self._period else ""
        return f"; the real-time factor is {factor:.2g}{self._contact_text}{remedy}"


class FirstContact:
    """Detector of the first contact of the cloth with each obstacle, with pads, and with itself.

    Args:
        simulation: the cloth.
    """

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self._reported: set[str] = set()

    def new_contacts(self, frame: Frame) -> str:
        """Return as text what a frame touched for the first time (obstacles, grippers, itself); empty if nothing."""
        contact = self._simulation.plan.contact
        if contact is None or not frame.moved or frame.advance is None or not frame.advance.steps:
            return ""
        scene = self._simulation.scene
        loads = zip(scene.obstacle_names, frame.obstacle_wrenches, strict=False)
        pressed = [name for name, load in loads if name not in self._reported and load.any()]
        if len(self._reported) < len(scene.pinching) + len(scene.obstacle_names):
            wrenches = zip(scene.gripper_names, frame.wrenches, strict=True)
            pinching = set(scene.pinching) - self._reported
            pressed += [name for name, load in wrenches if name in pinching and load.any()]
        new = [f"'{name}'" for name in pressed]
        # Self-contact takes longer to detect: once a second.
        is_sampled = contact.force.surface is not None and not frame.index % max(1, round(scene.rate))
        if is_sampled and _ITSELF not in self._reported and contact.self_gaps(self._simulation.state.x)[0]:
            pressed.append(_ITSELF)
            new.append(_ITSELF)
        self._reported.update(pressed)
        return ", ".join(new)
