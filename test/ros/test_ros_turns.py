# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Executor cost of a frame: number of spins, and entities in the wait set of each."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
from geometry_msgs.msg import PoseStamped
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import Bool
from support.clocked_cloth import ClockedCloth
from support.ros_client import Client, pose

from cloth_sim_ros.ros.node import ClothNode

AT_REST = {"cloth.resolution": [5, 5], "gravity": [0.0, 0.0, 0.0]}


@pytest.fixture
def client(ros_domain: int) -> Iterator[Client]:
    with Client() as client:
        yield client


@pytest.mark.parametrize(("in_timer_thread", "most"), [(False, 1.5), (True, 0.5)], ids=["in the executor", "beside it"])
def test_uncommanded_frame_takes_at_most_one_spin(client: Client, in_timer_thread: bool, most: float) -> None:
    overrides = [Parameter(name, value=value) for name, value in (AT_REST | {"rate": 500.0}).items()]
    cloth = ClothNode(
        context=client.context, parameter_overrides=overrides, signal_name=str if in_timer_thread else None
    )
    client.executor.add_node(cloth.node)
    cloth.start()
    try:
        client.spin_until(lambda: cloth.simulation.frame > 50, description="frames")
        begun, turns = cloth.simulation.frame, 0
        while cloth.simulation.frame < begun + 200:
            client.executor.spin_once(timeout_sec=1.0)
            turns += 1
        # Little else: maintenance runs four times a second.
        assert turns < most * 200
    finally:
        client.executor.remove_node(cloth.node)
        cloth.close()
        cloth.node.destroy_node()


def test_wait_set_of_a_spin_is_small(client: Client) -> None:
    bare = len(list(client.node.waitables))
    with ClockedCloth(client, AT_REST) as cloth:
        assert len(list(cloth.node.node.timers)) == 1
        # Nothing for published topics; entries for the clock, the grasps, and the entities of every node.
        assert len(list(cloth.node.node.waitables)) <= bare + 3


def test_a_sleeping_frame_wakes_no_other_thread(client: Client) -> None:
    calls: list[int] = []

    def run_job(job: Callable[[], Any]) -> Any:
        calls.append(1)
        return job()

    overrides = [Parameter(name, value=value) for name, value in (AT_REST | {"use_sim_time": False}).items()]
    cloth = ClothNode(context=client.context, parameter_overrides=overrides, run_job=run_job)
    client.executor.add_node(cloth.node)
    cloth.start()
    try:
        client.spin_until(lambda: cloth.simulation.will_stay_asleep, description="sleep")
        before, frame = len(calls), cloth.simulation.frame
        client.spin_until(lambda: cloth.simulation.frame >= frame + 20, description="frames")
        assert len(calls) == before
    finally:
        client.executor.remove_node(cloth.node)
        cloth.close()
        cloth.node.destroy_node()


def test_incompatible_grasp_publisher_is_warned_of(client: Client, capfd: pytest.CaptureFixture[str]) -> None:
    with ClockedCloth(client, AT_REST):
        effort = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
        client.node.create_publisher(Bool, "/cloth_sim/gripper/grasp", effort)
        said = ""

        def is_logged() -> bool:
            nonlocal said
            said += capfd.readouterr().err
            return "a publisher of /cloth_sim/gripper/grasp offers best effort" in said

        client.spin_until(is_logged, description="a warning")


def test_commands_take_effect_in_timer_thread_frames(client: Client) -> None:
    overrides = [Parameter(name, value=value) for name, value in AT_REST.items()]
    cloth = ClothNode(context=client.context, parameter_overrides=overrides, signal_name=str)
    client.executor.add_node(cloth.node)
    cloth.start()
    try:
        corner = cloth.simulation.positions[-1]
        grasp = client.publisher(Bool, "/cloth_sim/gripper/grasp")
        targets = client.publisher(PoseStamped, "/cloth_sim/gripper/target")
        targets.publish(pose(*corner.tolist()))
        client.spin_until(lambda: cloth.simulation.grippers.is_placed(0), description="the target")
        grasp.publish(Bool(data=True))
        client.spin_until(lambda: cloth.simulation.grippers.grasped_particles(0).size, description="the grasp")
        begun = cloth.simulation.frame
        client.spin_until(lambda: cloth.simulation.frame > begun + 10, description="frames that nobody commands")
        corner[1] += 0.1
        targets.publish(pose(*corner.tolist()))
        client.spin_until(lambda: cloth.simulation.grippers.poses()[0, 1] > corner[1] - 0.01, description="the move")
    finally:
        client.executor.remove_node(cloth.node)
        cloth.close()
        cloth.node.destroy_node()


def test_executor_raises_errors_of_the_timer_thread(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    overrides = [Parameter(name, value=value) for name, value in AT_REST.items()]
    cloth = ClothNode(context=client.context, parameter_overrides=overrides, signal_name=str)

    def broken(*_: Any) -> None:
        raise ZeroDivisionError("in a frame")

    monkeypatch.setattr(cloth, "_frame", broken)
    client.executor.add_node(cloth.node)
    cloth.start()
    try:
        with pytest.raises(ZeroDivisionError, match="in a frame"):
            client.spin_until(lambda: False, description="a frame")
    finally:
        client.executor.remove_node(cloth.node)
        cloth.close()
        cloth.node.destroy_node()
