# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A frame takes every command that has arrived when it begins, however little time frames leave for messages."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from geometry_msgs.msg import PoseStamped
from rclpy.parameter import Parameter
from ros_client import Client, pose
from std_msgs.msg import Bool

from cloth_sim_ros.ros import measure_latency
from cloth_sim_ros.ros.clock import Due
from cloth_sim_ros.ros.node import ClothNode


class HandPacer:
    """Frames when the test says so."""

    period = 16_666_667

    def __init__(self, _node: Any, *, rate: float, on_due: Any) -> None:
        self.on_due = on_due

    def start(self) -> None:
        pass

    def stop(self) -> None:
        pass


@pytest.fixture
def client(ros_domain: int) -> Iterator[Client]:
    with Client() as client:
        yield client


@pytest.fixture
def cloth(client: Client, monkeypatch: pytest.MonkeyPatch) -> Iterator[ClothNode]:
    """A cloth that no executor serves: nothing reaches it but what a frame takes."""
    monkeypatch.setattr("cloth_sim_ros.ros.node.WallPacer", HandPacer)
    cloth = ClothNode(
        "cloth_sim", context=client.context, parameter_overrides=[Parameter("cloth.resolution", value=[5, 5])]
    )
    cloth.start()
    yield cloth
    cloth.close()
    cloth.node.destroy_node()


def late_frame(cloth: ClothNode) -> int:
    """Let a frame be due a whole period ago; return how many commands it took."""
    before = cloth._commands.received
    due = cloth.node.get_clock().now().nanoseconds - HandPacer.period
    cloth._pacer.on_due(Due(stamp=due, lateness=HandPacer.period, skipped=0))  # type: ignore[union-attr]
    return cloth._commands.received - before


def test_a_late_frame_takes_all_that_has_come(cloth: ClothNode, client: Client) -> None:
    targets = client.publisher(PoseStamped, "/cloth_sim/gripper/target")
    # A best-effort target is sure to arrive once either side has met the other.
    client.spin_until(lambda: cloth.node.count_publishers("/cloth_sim/gripper/target"), what="the publisher seen")
    grippers = cloth.simulation.grippers

    def first() -> bool:
        targets.publish(pose(0.5, 0.0, 0.5))
        taken = late_frame(cloth)
        # What came after the frame was due, yet before it began, is not left to the next one.
        assert grippers.is_placed(0) == bool(taken)
        return bool(taken)

    client.spin_until(first, what="a frame that takes a target")
    for number in range(8):
        targets.publish(pose(0.5, 0.0, 0.5 + 0.01 * number))
    client.publisher(Bool, "/cloth_sim/gripper/grasp").publish(Bool(data=True))
    begun = cloth.simulation.frame

    def newest() -> bool:
        late_frame(cloth)
        return bool(grippers.poses()[0, 2] > 0.565)

    client.spin_until(newest, what="the newest target")
    # They arrive together or nearly so: not one a frame.
    assert cloth.simulation.frame - begun < 8


def test_latencies_are_found(ros_domain: int) -> None:
    """Whatever they are on a busy machine: the measurement itself."""
    import rclpy

    rclpy.init(args=[])
    try:
        found = measure_latency.measure(resolution=(8, 8), rate=60.0, stream=100.0, seconds=0.5)
    finally:
        rclpy.try_shutdown()
    assert found.particles == 64
    assert len(found.seconds) > 10
    assert (found.seconds > 0.0).all()
    assert found.summary()["integrator_why"]
    quick = measure_latency.Latencies(particles=1, rate=60.0, seconds=found.seconds * 0.0 + 0.001, diagnostics={})
    slow = measure_latency.Latencies(particles=1, rate=60.0, seconds=found.seconds * 0.0 + 0.019, diagnostics={})
    assert quick.met
    assert not slow.met
