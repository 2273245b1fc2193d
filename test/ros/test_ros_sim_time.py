# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Simulated time of a node: invalid and missing messages on /clock."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

from builtin_interfaces.msg import Time
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2
from support.ros_client import Client, stamp_of, start_cloth

from cloth_sim_ros.ros.timing.sim_time import ClockSilence

SMALL = "cloth.resolution:=[5, 5]"
#: A second later than the time at which the first cloud was due [s].
SOME = 100_000
#: Last second that a stamp can hold.
LAST = 2**31 - 1
#: Invalid times: sec, nanosec, and the message.
NO_TIMES = [
    (-1, 0, "its time is -1.000 s (sec -1, nanosec 0), and must be at least 0 and below 2147483648 s"),
    (LAST, 2**32 - 1, f"(sec {LAST}, nanosec {2**32 - 1}), and must be at least 0 and below 2147483648 s"),
]


def test_clock_message_without_valid_time_is_ignored(ros_domain: int, start_process: Callable[..., Any]) -> None:
    process = start_cloth(start_process, "use_sim_time:=true", SMALL, wait="Hz of /clock")
    with Client() as client:
        clock = client.publisher(Clock, "/clock")

        def set_time(sec: int, nanosec: int = 0) -> None:
            clock.publish(Clock(clock=Time(sec=sec, nanosec=nanosec)))

        def shows(sec: int) -> bool:
            # /clock is best effort with depth one: missed messages are repeated.
            set_time(sec)
            client.executor.spin_once(timeout_sec=0.02)
            return bool(client.clouds) and stamp_of(client.clouds[-1]) == sec * 1_000_000_000

        client.node.create_subscription(PointCloud2, "/cloth_sim/points", client.clouds.append, 1000)
        # Each cloud is sent once: those before the match are missed, and a standing clock causes no other.
        seconds = itertools.count(1)
        client.spin_until(lambda: shows(next(seconds)) or client.clouds, description="a cloud")
        client.spin_until(lambda: shows(SOME), description="the last cloud before times that are none")
        for sec, nanosec, words in NO_TIMES:
            before = len(client.clouds)

            def is_logged(sec: int = sec, nanosec: int = nanosec, words: str = words) -> bool:
                set_time(sec, nanosec)
                return words in process.output

            client.spin_until(is_logged, description=f"'{words}' in the log")
            assert len(client.clouds) == before
        client.spin_until(lambda: shows(SOME + 1), description="the cloud of the next second")
        # The last valid time.
        client.spin_until(lambda: shows(LAST), description="the cloud of the last second")
        client.spin_until(lambda: shows(12), description="the cloud after it")
    assert process.interrupt() == 0
    assert "Traceback" not in process.output


def test_gripper_ignores_invalid_clock_message(ros_domain: int, start_process: Callable[..., Any]) -> None:
    command = ["-m", "cloth_sim_ros.ros.gripper_main", "--node", "/nowhere", "--wait", "60"]
    gripper = start_process([*command, "--ros-args", "-p", "use_sim_time:=true"])
    with Client() as client:
        clock = client.publisher(Clock, "/clock")

        def is_logged() -> bool:
            clock.publish(Clock(clock=Time(sec=-1)))
            return "a message on /clock is left out: its time is -1.000 s" in gripper.output

        client.spin_until(is_logged, description="a warning")
    gripper.interrupt()
    assert "Traceback" not in gripper.output


def test_silent_clock_is_warned_of_once_a_minute() -> None:
    now, lines = [100.0], []

    class Log:
        def warning(self, text: str) -> None:
            lines.append((now[0], text))

    silence = ClockSilence(Log(), seconds=lambda: now[0])
    for quarter in range(4 * 130):
        now[0] = 100.0 + quarter / 4
        silence.check()
    assert [when for when, _ in lines] == [105.25, 165.5, 225.75]
    assert lines[1][1].startswith("use_sim_time is set, and for 66 s nothing has come on /clock")
