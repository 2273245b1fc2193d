# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The deadline monitor: late frames are logged when they start and end, not one by one."""

from __future__ import annotations

from cloth_sim_ros.ros.reporting.log import ThrottledLog
from cloth_sim_ros.ros.timing.deadline_monitor import RECOVERY_WINDOWS, REPORT_WINDOWS, DeadlineMonitor

PERIOD = 1.0 / 60.0
WINDOW = 120


class Log:
    def __init__(self) -> None:
        self.lines: list[str] = []

    def info(self, text: str) -> None:
        self.lines.append(text)

    def warning(self, text: str) -> None:
        self.lines.append(text)


def lateness() -> tuple[DeadlineMonitor, Log]:
    log = Log()
    return DeadlineMonitor(period=PERIOD, log=ThrottledLog(log, seconds=0.0)), log


def run(monitor: DeadlineMonitor, windows: int, *, late: int, seconds: float) -> None:
    """Add windows of frames, with a number of late ones in each."""
    for _ in range(windows):
        for index in range(WINDOW):
            monitor.add(late=int(index < late), skipped=0, seconds=seconds)


def test_single_late_frames_are_not_logged() -> None:
    monitor, log = lateness()
    run(monitor, 100, late=3, seconds=0.0034)
    assert log.lines == []


def test_lateness_is_logged_at_start_end_and_intervals() -> None:
    monitor, log = lateness()
    run(monitor, 1, late=60, seconds=0.0034)
    assert log.lines == [
        "frames come late: 60 of 120 missed their period; one takes 3.4 ms of 16.7 ms: other processes use the machine"
    ]
    run(monitor, REPORT_WINDOWS - 1, late=60, seconds=0.02)
    assert len(log.lines) == 1
    run(monitor, 1, late=60, seconds=0.02)
    assert log.lines[1].endswith("one takes 20.0 ms of 16.7 ms: the cloth is too slow for this machine and rate")
    run(monitor, RECOVERY_WINDOWS - 1, late=0, seconds=0.0034)
    assert len(log.lines) == 2
    run(monitor, 1, late=0, seconds=0.0034)
    assert log.lines[2:] == [f"frames are on time again; {60 * (REPORT_WINDOWS + 1)} frames late or skipped"]
    run(monitor, 10, late=0, seconds=0.0034)
    assert len(log.lines) == 3


def test_skipped_ticks_count_as_late() -> None:
    monitor, log = lateness()
    for _ in range(WINDOW // 2):
        monitor.add(late=1, skipped=1, seconds=0.03)
    (line,) = log.lines
    assert line.startswith("frames come late: 60 of 120 ")


def pass_window(monitor: DeadlineMonitor, *, seconds: float, skipped: int) -> None:
    """Add a window of frames, each with skipped ticks before it."""
    for _ in range(WINDOW // (1 + skipped)):
        monitor.add(late=1 + skipped, skipped=skipped, seconds=seconds)


def test_slow_cloth_names_its_factor_and_the_remedy() -> None:
    monitor, log = lateness()
    pass_window(monitor, seconds=0.05, skipped=2)
    (line,) = log.lines
    assert line.endswith(
        "the cloth is too slow for this machine and rate; the real-time factor is 0.33: a smaller cloth.resolution, a "
        "lower rate, a larger tolerance, or overload: relax reduces the load"
    )


def test_first_contact_restarts_window_and_logs_slowdown() -> None:
    monitor, log = lateness()
    # On time so far: frames before the contact do not count.
    run(monitor, 1, late=0, seconds=0.003)
    for _ in range(WINDOW // 2):
        monitor.add(late=0, skipped=0, seconds=0.003)
    monitor.begin_contact("'table'")
    pass_window(monitor, seconds=0.025, skipped=1)
    assert "the real-time factor is 0.5 since the cloth touches 'table':" in log.lines[0]
    # The same factor is not logged again; a much smaller one is, before a minute has passed.
    monitor.begin_contact("'floor'")
    pass_window(monitor, seconds=0.025, skipped=1)
    assert len(log.lines) == 1
    monitor.begin_contact("'gripper'")
    pass_window(monitor, seconds=0.09, skipped=5)
    assert len(log.lines) == 2
    assert "the real-time factor is 0.17 since the cloth touches 'gripper':" in log.lines[1]
    pass_window(monitor, seconds=0.09, skipped=5)
    assert len(log.lines) == 2
