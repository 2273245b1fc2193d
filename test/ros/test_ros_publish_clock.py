# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`publish_clock`: the cloth's simulated time on /clock."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.clock import ROSClock
from rclpy.qos import qos_profile_sensor_data
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import SetBool, Trigger
from support.line_log import LineLog
from support.ros_client import Client, pose, stamp_of, start_cloth

from cloth_sim_ros.ros.reporting.log import ThrottledLog
from cloth_sim_ros.ros.timing.clock_publisher import ClockPublisher
from cloth_sim_ros.session.reader import SessionReader

SECOND = 1_000_000_000
SMALL = "cloth.resolution:=[6, 6]"


def end_of_frame(index: int) -> int:
    """Simulated time at the end of a frame of 60 Hz, in nanoseconds."""
    return round(Fraction(index * SECOND, 60))


def time_of(stamp: Time) -> int:
    return int(stamp.sec) * SECOND + int(stamp.nanosec)


class Follower(Client):
    """A client that receives /clock."""

    def __enter__(self) -> Follower:
        self.times: list[int] = []
        self.node.create_subscription(
            Clock, "/clock", lambda message: self.times.append(time_of(message.clock)), qos_profile_sensor_data
        )
        return self

    def wait_for_time(self, nanoseconds: int) -> None:
        self.spin_until(lambda: self.times and self.times[-1] >= nanoseconds, description=f"{nanoseconds} ns")


def test_messages_have_the_time_of_the_clock(ros_domain: int, start_process: Callable[..., Any]) -> None:
    process = start_cloth(start_process, "publish_clock:=true", SMALL)
    with Follower() as client:
        client.watch()
        client.wait_for_clouds(30)
        stamps = [stamp_of(cloud) for cloud in client.clouds]
        client.wait_for_time(stamps[-1])
        first = round(stamps[0] * 60 / SECOND)
        assert stamps == [end_of_frame(first + k) for k in range(len(stamps))]
        assert set(stamps[5:]) <= set(client.times)
        check_pause_and_steps(client)
        check_targets_have_the_same_time(client)
    assert process.interrupt() == 0
    assert "Traceback" not in process.output


def check_pause_and_steps(client: Follower) -> None:
    client.call(SetBool, "/cloth_sim/pause", SetBool.Request(data=True))
    client.spin_until(lambda: len(set(client.times[-5:])) == 1, description="a clock that stands")
    standing, count = client.times[-1], len(client.times)
    client.spin_until(lambda: len(client.times) > count + 5, description="a clock that is published")
    assert set(client.times[count:]) == {standing}
    assert client.call(Trigger, "/cloth_sim/step").success
    client.wait_for_time(standing + 1)
    assert client.times[-1] == end_of_frame(round(standing * 60 / SECOND) + 1)
    client.spin_until(lambda: stamp_of(client.clouds[-1]) == client.times[-1], description="the step's cloud")
    client.call(SetBool, "/cloth_sim/pause", SetBool.Request(data=False))


def check_targets_have_the_same_time(client: Follower) -> None:
    reports: list[DiagnosticArray] = []
    client.node.create_subscription(DiagnosticArray, "/diagnostics", reports.append, 10)
    targets = client.publisher(PoseStamped, "/cloth_sim/gripper/target")

    def refused() -> int:
        count = len(reports)
        client.spin_until(lambda: len(reports) > count + 1, description="diagnostics", limit=90.0)
        values = {value.key: value.value for status in reports[-1].status for value in status.values}
        return int(values["commands_refused"])

    targets.publish(pose(0.0, 0.0, 1.0, stamp=client.times[-1]))
    assert refused() == 0
    targets.publish(pose(0.0, 0.0, 1.0, stamp=client.times[-1] + 1000 * SECOND))
    assert refused() == 1
    assert 0 < time_of(reports[-1].header.stamp) < client.times[-1] + SECOND


def test_a_second_cloth_follows_in_step(ros_domain: int, start_process: Callable[..., Any], tmp_path: Path) -> None:
    names = ["-r", "__node:=follower"]
    follower = start_cloth(start_process, "use_sim_time:=true", SMALL, arguments=names, wait="Hz of /clock")
    leader = start_cloth(start_process, "publish_clock:=true", SMALL, "record.enabled:=true",
                         f"record.folder:={tmp_path}")  # fmt: skip
    with Follower() as client:
        followed: list[PointCloud2] = []
        client.node.create_subscription(PointCloud2, "/follower/points", followed.append, 10)
        client.watch()

        def common() -> set[int]:
            led = {stamp_of(cloud) // 1000 for cloud in client.clouds}
            return led & {stamp_of(cloud) // 1000 for cloud in followed}

        client.spin_until(lambda: len(common()) > 10, description="common frames of leader and follower")
    assert leader.interrupt() == 0
    assert follower.interrupt() == 0
    (path,) = tmp_path.glob("*.mcap")
    with SessionReader(path) as session:
        times = [message.log_time for message in session.messages(["/cloth_sim/points"])]
        frames = [round(frame.time * SECOND) for frame in session.frames()]
    assert len(times) > 20
    assert times == frames[: len(times)]


def test_another_publisher_of_the_clock_is_reported(ros_domain: int, start_process: Callable[..., Any]) -> None:
    with Client("other_simulator") as client:
        client.node.create_publisher(Clock, "/clock", 1)
        process = start_cloth(start_process, "publish_clock:=true", SMALL)
        process.wait_for_output("/other_simulator publishes /clock too")
    assert process.interrupt() == 0


def test_publishers_of_the_same_name_are_reported() -> None:
    publishers = [("cloth_sim", "/")]
    log = LineLog()
    node: Any = SimpleNamespace(
        create_publisher=lambda *_: None,
        get_clock=ROSClock,
        get_fully_qualified_name=lambda: "/cloth_sim",
        get_publishers_info_by_topic=lambda _: [
            SimpleNamespace(node_name=name, node_namespace=namespace) for name, namespace in publishers
        ],
    )
    clock = ClockPublisher(node, ThrottledLog(log, seconds=0.0), 0.0)  # type: ignore[arg-type]
    clock.check()
    assert log.lines == []
    publishers += [("cloth_sim", "/"), ("simulator", "/right"), ("simulator", "/right")]
    clock.check()
    assert log.lines[0].startswith("/right/simulator, another node /cloth_sim publishes /clock too")


@pytest.mark.parametrize("check", [False, True])
def test_a_follower_of_the_clock_publishes_none(
    ros_domain: int, start_process: Callable[..., Any], tmp_path: Path, check: bool
) -> None:
    path = tmp_path / "cloth.yaml"
    path.write_text("cloth_sim: {ros__parameters: {use_sim_time: true, publish_clock: true}}")
    arguments = ["--check", path] if check else ["--ros-args", "--params-file", path]
    process = start_process(["-m", "cloth_sim_ros.ros.main", *arguments])
    assert process.wait() == 1
    assert "a node can't follow the /clock that it publishes" in process.output
