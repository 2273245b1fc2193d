# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Commands of a session that drive a node again: frame by frame, and as `ros2 bag play` plays them."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pytest
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from rosbags.rosbag2 import Reader
from std_msgs.msg import Bool
from support.bag_player import play, qos_of
from support.clocked_cloth import ClockedCloth
from support.ros_client import Client, pose

from cloth_sim_ros.ros.node import ClothNode
from cloth_sim_ros.session.reader import SessionReader
from cloth_sim_ros.simulation import events
from cloth_sim_ros.simulation.events import Grasp, Target

COMMANDS = ("/cloth_sim/gripper/target", "/cloth_sim/gripper/grasp")
CLOTH = {"cloth.resolution": [6, 7]}
CORNER = 41
#: Time [s] and position [m] of the gripper: to the corner, up and away, then at rest.
WAYPOINTS = ((0.0, (0.6, -0.2, 0.4)), (0.3, (0.5, 0.0, 0.5)), (0.5, (0.5, 0.0, 0.5)), (1.2, (0.3, -0.3, 0.9)))
CLOSED_AT, END, PACE = 0.4, 1.5, 0.01


@attrs.frozen
class Run:
    """Final position of a grasp and its session."""

    path: Path
    held: list[int]
    position: np.ndarray
    corner: np.ndarray


@pytest.fixture
def client(ros_domain: int) -> Iterator[Client]:
    with Client() as client:
        yield client


def cloth_node(client: Client, folder: Path, **parameters: Any) -> ClothNode:
    values = {**CLOTH, "record.enabled": True, "record.folder": str(folder), **parameters}
    cloth = ClothNode(context=client.context, parameter_overrides=[Parameter(k, value=v) for k, v in values.items()])
    client.executor.add_node(cloth.node)
    cloth.warm_up()
    cloth.start()
    return cloth


def end(client: Client, cloth: ClothNode) -> Run:
    """Wait until the gripper has reached its last target, stop the node, and return the result."""
    client.spin_until(
        lambda: np.allclose(cloth.simulation.grippers.poses()[0, :3], WAYPOINTS[-1][1], atol=1e-9),
        description="the gripper at its last target",
    )
    run = Run(
        path=Path(cloth.recording.session.status().path),  # type: ignore[union-attr]
        held=cloth.simulation.grippers.grasped_particles(0).tolist(),
        position=cloth.simulation.grippers.poses()[0],
        corner=cloth.simulation.positions[CORNER],
    )
    client.executor.remove_node(cloth.node)
    assert cloth.close()
    cloth.node.destroy_node()
    return run


def grasp_live(client: Client, folder: Path) -> Run:
    """Grasp the corner of a live cloth as a robot would, and record a session."""
    cloth = cloth_node(client, folder)
    target, grasp = client.publisher(type(pose(0, 0, 0)), COMMANDS[0]), client.publisher(Bool, COMMANDS[1])
    times, places = zip(*WAYPOINTS, strict=True)
    begun, closed, sent = time.monotonic(), False, 0
    while (elapsed := time.monotonic() - begun) < END:
        client.executor.spin_once(timeout_sec=0.002)
        if elapsed < sent * PACE:
            continue
        where = [float(np.interp(elapsed, times, [waypoint[i] for waypoint in places])) for i in range(3)]
        target.publish(pose(*where, stamp=client.node.get_clock().now().nanoseconds))
        if elapsed > CLOSED_AT and not closed:
            grasp.publish(Bool(data=True))
            closed = True
        sent += 1
    target.publish(pose(*WAYPOINTS[-1][1], stamp=client.node.get_clock().now().nanoseconds))
    client.executor.spin_once(timeout_sec=0.05)
    run = end(client, cloth)
    assert run.held == [CORNER]
    assert np.linalg.norm(run.corner - WAYPOINTS[-1][1]) < 0.02
    return run


def test_played_session_commands_drive_a_node(client: Client, tmp_path: Path) -> None:
    live = grasp_live(client, tmp_path / "live")
    check_profiles_let_them_be_played(live)
    check_the_frames_of_wall_time_are_those_of_the_clock(client, live, tmp_path / "clock")
    check_bag_play_grasps_again(client, live, tmp_path / "played")
    check_bag_play_with_its_clock_grasps_again(client, live, tmp_path / "clocked")


def check_profiles_let_them_be_played(live: Run) -> None:
    with Reader(live.path) as reader:
        profiles = {connection.topic: qos_of(connection) for connection in reader.connections}
    assert profiles[COMMANDS[0]].reliability == ReliabilityPolicy.BEST_EFFORT
    # A best-effort player would not reach the node's reliable subscription.
    assert profiles[COMMANDS[1]].reliability == ReliabilityPolicy.RELIABLE
    assert profiles["/cloth_sim/points"].reliability == ReliabilityPolicy.RELIABLE
    assert profiles["/cloth_sim/topology"].durability == DurabilityPolicy.TRANSIENT_LOCAL


def check_the_frames_of_wall_time_are_those_of_the_clock(client: Client, live: Run, folder: Path) -> None:
    """The events of each frame, sent over topics to a cloth that follows /clock, give the same state bit for bit."""
    with SessionReader(live.path) as reader:
        records = list(reader.frames())
    # A busy machine skips frames.
    assert len(records) > 20
    with ClockedCloth(client, {**CLOTH, "record.folder": str(folder)}) as cloth:
        for record in records:
            for event in (events.from_dict(dict(entry)) for entry in record.events):
                if isinstance(event, Target):
                    assert event.orientation is not None
                    message = pose(*event.position)
                    q = message.pose.orientation
                    q.x, q.y, q.z, q.w = event.orientation
                    cloth.send("gripper/target", message)
                else:
                    assert isinstance(event, Grasp)
                    cloth.grasp(event.gripper, event.closed)
            cloth.tick()
            assert cloth.simulation.state.digest() == record.digest, f"frame {record.frame}"


def check_bag_play_grasps_again(client: Client, live: Run, folder: Path) -> None:
    cloth = cloth_node(client, folder)
    sent = play(live.path, client, topics=COMMANDS)
    check_same_grasp(live, end(client, cloth), sent)


def check_bag_play_with_its_clock_grasps_again(client: Client, live: Run, folder: Path) -> None:
    cloth = cloth_node(client, folder, use_sim_time=True)
    sent = play(live.path, client, topics=COMMANDS, clock=True)
    check_same_grasp(live, end(client, cloth), sent)


def check_same_grasp(live: Run, again: Run, sent: int) -> None:
    assert again.held == live.held
    np.testing.assert_allclose(again.position, live.position, atol=1e-6)
    np.testing.assert_allclose(again.corner, live.corner, atol=0.01)
    for topic in COMMANDS:
        first, second = (list(commands_in(run.path, topic)) for run in (live, again))
        # Targets are best effort: on a busy machine a few may be missing. The others arrive in order, byte for byte.
        following = iter(first)
        assert all(command in following for command in second)
        assert len(second) > 0.8 * len(first)
    assert second == first, "no grasp is ever lost"
    assert sent == sum(len(list(commands_in(live.path, topic))) for topic in COMMANDS)


def commands_in(path: Path, topic: str) -> Iterator[bytes]:
    with Reader(path) as reader:
        chosen = [connection for connection in reader.connections if connection.topic == topic]
        for _, _, data in reader.messages(connections=chosen):
            yield bytes(data)
