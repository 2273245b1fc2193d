# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Simulated time: the cloth follows /clock exactly, stands with it, and survives its jumps."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from rosgraph_msgs.msg import Clock
from std_srvs.srv import SetBool
from support.ros_client import Client, pose, positions, stamp_of, start_cloth

from cloth_sim_ros import Scene, Simulation
from cloth_sim_ros.ros.io.services import FRAME_TIMEOUT

SECOND = 1_000_000_000


class ClockedClient(Client):
    """A client that publishes /clock."""

    def set_time(self, seconds: float) -> None:
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(round(seconds * SECOND), SECOND)
        self.publisher(Clock, "/clock").publish(message)

    def advance_to(self, seconds: float) -> None:
        """Set the time, and wait for the last cloud due at it."""
        last = int(seconds * 60.0 + 1e-6) * SECOND // 60
        self.set_time(seconds)
        self.spin_until(
            lambda: self.clouds and stamp_of(self.clouds[-1]) == last, description=f"the cloud of {seconds} s"
        )


def test_the_cloth_follows_the_clock(ros_domain: int, start_process: Callable[..., Any]) -> None:
    process = start_cloth(start_process, "use_sim_time:=true", "cloth.resolution:=[10, 10]", wait="Hz of /clock")
    with ClockedClient() as client:
        client.node.create_subscription(PoseStamped, "unused", lambda _: None, 1)
        client.publisher(Clock, "/clock")
        check_nothing_happens_without_a_clock(client)
        check_frame_stamps_follow_clock(client)
        check_it_stands_when_the_clock_stands(client)
        check_jump_forward_is_caught_up(client, process)
        check_a_jump_back_resets(client, process)
    assert process.interrupt() == 0
    assert "Traceback" not in process.output


def check_nothing_happens_without_a_clock(client: ClockedClient) -> None:
    client.node.create_subscription(*cloud_subscription(client))
    answer = client.call(SetBool, "/cloth_sim/gripper/close", SetBool.Request(data=True))
    assert not answer.success
    assert f"no frame was due within {FRAME_TIMEOUT:g} s: /clock stands still" in answer.message
    assert client.clouds == []


def cloud_subscription(client: ClockedClient) -> tuple[Any, ...]:
    from sensor_msgs.msg import PointCloud2

    return PointCloud2, "/cloth_sim/points", client.clouds.append, 1000


def check_frame_stamps_follow_clock(client: ClockedClient) -> None:
    # Even if /clock comes rarely, every frame is computed, with the stamp of its tick.
    client.advance_to(100.0)
    for seconds in (100.1, 100.11, 100.5, 101.0):
        client.advance_to(seconds)
    stamps = [stamp_of(cloud) for cloud in client.clouds]
    assert stamps == [(6000 + index) * SECOND // 60 for index in range(61)]
    # They equal the frames of the simulation without ROS; the gripper closed on nothing in the first.
    simulation = Simulation(Scene.from_parameters({"cloth.resolution": (10, 10)}))
    for cloud in client.clouds:
        simulation.advance()
        np.testing.assert_array_equal(positions(cloud), simulation.positions.astype(np.float32))


def check_it_stands_when_the_clock_stands(client: ClockedClient) -> None:
    count = len(client.clouds)
    target = client.publisher(PoseStamped, "/cloth_sim/gripper/target")
    for _ in range(20):
        target.publish(pose(0.0, 0.0, 0.0))
        client.set_time(101.0)
        client.executor.spin_once(timeout_sec=0.02)
    assert len(client.clouds) == count


def check_jump_forward_is_caught_up(client: ClockedClient, process: Any) -> None:
    count = len(client.clouds)
    client.advance_to(200.0)
    stamps = [stamp_of(cloud) for cloud in client.clouds[count:]]
    assert len(stamps) == 60
    assert stamps[0] == (12000 - 59) * SECOND // 60
    assert "5880 frames skipped" in process.output


def check_a_jump_back_resets(client: ClockedClient, process: Any) -> None:
    client.advance_to(150.0)
    process.wait_for_output("/clock went back from 200.000 s to 150.000 s: the cloth is reset")
    simulation = Simulation(Scene.from_parameters({"cloth.resolution": (10, 10)}))
    simulation.advance()
    np.testing.assert_array_equal(positions(client.clouds[-1]), simulation.positions.astype(np.float32))
    client.advance_to(150.2)
    assert [stamp_of(cloud) for cloud in client.clouds[-2:]] == [9011 * SECOND // 60, 9012 * SECOND // 60]
