# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A frame takes every command that has arrived when it begins, however little time frames leave for messages."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from geometry_msgs.msg import PoseStamped
from support.clocked_cloth import ClockedCloth
from support.ros_client import Client, pose

from cloth_sim_ros.ros.io.commands import CommandSubscriptions


@pytest.fixture
def client(ros_domain: int) -> Iterator[Client]:
    with Client() as client:
        yield client


def test_a_frame_takes_all_that_has_come(client: Client) -> None:
    with ClockedCloth(client, {"cloth.resolution": [5, 5]}) as cloth:
        targets = client.publisher(PoseStamped, "/cloth_sim/gripper/target")
        cloth.target("gripper", (0.5, 0.0, 0.5))
        cloth.tick()
        for index in range(8):
            targets.publish(pose(0.5, 0.0, 0.5 + 0.01 * index))
        begun = cloth.simulation.frame

        def newest() -> bool:
            cloth.tick()
            return bool(cloth.position("gripper")[2] > 0.565)

        client.spin_until(newest, description="the newest target")
        # The eight targets arrive almost together, and the executor hands over one a turn. A frame waits for several
        # turns, so they need fewer than eight frames.
        assert cloth.simulation.frame - begun < 8


def commands_of(received: list[int]) -> CommandSubscriptions:
    """Return Commands that receive `received[k]` more messages before the k-th call of `settled`."""
    commands = CommandSubscriptions.__new__(CommandSubscriptions)
    # private: restarts the count of spins
    commands.received = commands._received_before = commands._busy_spins = 0
    coming = iter(received)

    def settled() -> bool:
        commands.received += next(coming)
        return CommandSubscriptions.is_drained(commands)

    commands.is_drained = settled  # type: ignore[method-assign]
    return commands


def test_a_frame_waits_for_commands_but_not_for_a_flood() -> None:
    commands = commands_of([0, 3, 1, 0, 0])
    assert [commands.is_drained() for _ in range(5)] == [True, False, False, True, True]
    flooded = commands_of([1] * 30)
    turns = [flooded.is_drained() for _ in range(30)]
    assert [call for call, settled in enumerate(turns) if settled] == [10, 21]
