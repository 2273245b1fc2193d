# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The node's log of commands, and its DEBUG lines, which a service switches on."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.msg import LoggerLevel
from rcl_interfaces.srv import GetLoggerLevels, SetLoggerLevels
from support.clocked_cloth import ClockedCloth
from support.line_log import LineLog
from support.ros_client import Client, pose

from cloth_sim_ros.ros.reporting.log import ThrottledLog
from cloth_sim_ros.ros.timing.event_queue import MAX_QUEUED_EVENTS, EventQueue
from cloth_sim_ros.simulation.events import Grasp, Target

DEBUG, INFO = 10, 20


@pytest.fixture
def client(ros_domain: int) -> Iterator[Client]:
    with Client() as client:
        yield client


def lines_with(output: str, words: str) -> list[str]:
    return [line for line in output.splitlines() if words in line]


def test_left_out_messages_are_counted_after_the_last(client: Client) -> None:
    log, now = LineLog(), [0.0]
    throttled = ThrottledLog(log, seconds=1.0, clock=lambda: now[0])
    for index in range(5):
        throttled.warn("a", f"a{index}")
    throttled.flush()
    assert log.lines == ["a0"]
    now[0] = 1.0
    throttled.flush()
    throttled.flush()
    assert log.lines == ["a0", "a4 (3 more of this kind since the last message)"]
    # A single omitted message is logged as it is, and another kind has its own period.
    throttled.warn("a", "a5")
    now[0] = 2.0
    throttled.flush()
    assert log.lines[2:] == ["a5"]


def test_old_command_warning_has_gripper_age_and_count(client: Client, capfd: pytest.CaptureFixture[str]) -> None:
    with ClockedCloth(client) as cloth:
        cloth.tick(2)
        for _ in range(4):
            cloth.target("gripper", (0.5, 0.0, 0.5), stamp=cloth.now)
            cloth.target("gripper", (0.5, 0.0, 0.5), stamp=cloth.now - 100_000_000)
        assert cloth.refused == (0, 4)

        def messages() -> list[str]:
            out.append(capfd.readouterr().err)
            return lines_with("".join(out), "is dropped")

        out: list[str] = []
        lines = client.spin_until(
            lambda: len(counted := messages()) == 2 and counted, description="the count of old targets"
        )
    assert "target of 'gripper' is dropped: its stamp is 0.100 s older than that of the newest command" in lines[0]
    assert "; 1 of 'gripper' so far" in lines[0]
    assert "; 4 of 'gripper' so far" in lines[1]


def test_evicted_targets_are_counted() -> None:
    queue = EventQueue()
    for index in range(MAX_QUEUED_EVENTS + 3):
        queue.put(Target("g", (float(index), 0.0, 0.0)))
    assert queue.n_evicted == 3
    queue.put(Grasp("g", True))
    assert queue.n_evicted == 4


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (pose(float("nan"), 0.0, 0.0), "it is [nan, 0.0, 0.0]; it must be 3 finite numbers"),
        (pose(0.0, 0.0, 2e4), "it is [0.0, 0.0, 20000.0] m; no coordinate may be beyond 10000 m"),
        (pose(0.0, 0.0, 0.0, w=0.0), "orientation [0.0, 0.0, 0.0, 0.0] is no quaternion"),
        (pose(0.0, 0.0, 0.0, frame_id="/world"), "its frame_id is '/world'; tf2 takes no name that begins with '/'"),
        (pose(0.0, 0.0, 0.0, frame_id="world "), "its frame_id is 'world '; a frame's name has no blanks around it"),
        (pose(0.0, 0.0, 0.0, frame_id="/"), "its frame_id is '/'; tf2 takes no name that begins with '/'"),
    ],
    ids=["nan", "far", "orientation", "slash", "blank", "slash alone"],
)
def test_refusal_of_a_target_names_it_once(
    client: Client, capfd: pytest.CaptureFixture[str], message: PoseStamped, words: str
) -> None:
    with ClockedCloth(client) as cloth:
        cloth.send("gripper/target", message)
        cloth.tick()
        assert cloth.refused == (1, 0)
    (line,) = lines_with(capfd.readouterr().err, "refused")
    assert f"target of 'gripper' is refused: {words}" in line
    assert line.count("target of") == 1


def test_debug_lines_come_and_go_with_the_level(client: Client, capfd: pytest.CaptureFixture[str]) -> None:
    with ClockedCloth(client) as cloth:

        def set_level(level: int) -> None:
            request = SetLoggerLevels.Request(levels=[LoggerLevel(name="cloth_sim", level=level)])
            assert client.call(SetLoggerLevels, "/cloth_sim/set_logger_levels", request).results[0].successful
            response = client.call(
                GetLoggerLevels, "/cloth_sim/get_logger_levels", GetLoggerLevels.Request(names=["cloth_sim"])
            )
            assert response.levels[0].level == level

        def debug_lines() -> list[str]:
            cloth.target("gripper", (0.5, 0.0, 0.5))
            cloth.grasp("gripper", True)
            cloth.tick(2)
            return lines_with(capfd.readouterr().err, "[DEBUG]")

        try:
            assert debug_lines() == []
            set_level(DEBUG)
            # The node reads the level four times a second.
            lines = client.spin_until(debug_lines, description="DEBUG lines") + debug_lines()
        finally:
            set_level(INFO)
        client.spin_until(lambda: debug_lines() == [], description="the end of DEBUG lines")
    for words in ("command received, for now: Target(", "applies Target(", "applies Grasp(", "integrator "):
        assert [line for line in lines if words in line], words


def test_start_says_nothing_of_the_material(client: Client, capfd: pytest.CaptureFixture[str]) -> None:
    with ClockedCloth(client):
        pass
    said = capfd.readouterr().err
    assert "grippers: gripper" in said
    assert "Poisson" not in said


def test_long_names_of_messages_are_shortened(client: Client, capfd: pytest.CaptureFixture[str]) -> None:
    with ClockedCloth(client) as cloth:
        cloth.send("gripper/target", pose(0.0, 0.0, 0.0, frame_id="x" * 100_000))
        cloth.tick()
    (line,) = [line for line in capfd.readouterr().err.splitlines() if "xxx" in line]
    assert len(line) < 1200
    assert "characters left out) ..." in line
    # The remedy is at the end.
    assert "give poses in 'world'" in line or "no transform" in line
