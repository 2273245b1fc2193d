# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A live cloth end to end: node, gripper and subscriber as processes, and the session."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from support.ros_client import start_cloth

from cloth_sim_ros import Scene, Simulation, State
from cloth_sim_ros.scene.parameters import parameter_file
from cloth_sim_ros.session.cdr import decode, decode_cloud
from cloth_sim_ros.session.reader import SessionReader
from cloth_sim_ros.simulation import events
from cloth_sim_ros.simulation.gripper_script import GripperScript

PERIOD = 16_666_667
SUBSCRIBER = Path(__file__).parents[1] / "support" / "plain_subscriber.py"
#: A grasp of the lower right corner: approach, close, lift and carry, release.
SCRIPT = {
    "rate": 200.0,
    "steps": [
        {"time": 0.0, "position": [0.6, -0.2, 0.4]},
        {"time": 0.4, "position": [0.5, 0.0, 0.5]},
        {"time": 0.5, "position": [0.5, 0.0, 0.5], "close": True},
        {"time": 1.4, "position": [0.2, -0.5, 1.0], "orientation": [0.0, 0.0, 0.7071, 0.7071]},
        {"time": 1.5, "position": [0.2, -0.5, 1.0], "close": False},
        {"time": 2.2, "position": [0.2, -0.9, 1.0]},
    ],
}


@dataclass
class Session:
    """Results of one run."""

    received: list[bytes]
    path: Path
    log: str


@pytest.fixture
def session(ros_domain: int, start_process: Callable[..., Any], tmp_path: Path) -> Session:
    pytest.importorskip("mcap")
    pytest.importorskip("rosbags")
    received = tmp_path / "received"
    script = tmp_path / "script.yaml"
    script.write_text(yaml.safe_dump(SCRIPT))
    subscriber = start_process([sys.executable, SUBSCRIBER, "/cloth_sim/points", received])
    subscriber.wait_for_output("ready")
    cloth = start_cloth(start_process, "record.enabled:=true", f"record.folder:={tmp_path / 'sessions'}")
    # On a busy machine discovery takes seconds.
    subscriber.wait_for_output("receives")
    gripper = start_process(["-m", "cloth_sim_ros.ros.gripper_main", script])
    assert gripper.wait() == 0, gripper.output
    assert "targets sent; held 4 particles" in gripper.output
    assert cloth.interrupt() == 0, cloth.output
    subscriber.interrupt()
    (path,) = (tmp_path / "sessions").glob("*.mcap")
    return Session(received=_messages(received.read_bytes()), path=path, log=cloth.output)


def test_grasped_cloth_is_received_recorded_and_verified(session: Session) -> None:
    check_all_clouds_received_at_60_hz(session)
    check_corner_follows_the_gripper_and_falls(session)
    check_second_reader_agrees(session)
    check_runs_again(session)
    assert "holds" in session.log
    assert "Traceback" not in session.log


def check_all_clouds_received_at_60_hz(session: Session) -> None:
    from mcap.reader import make_reader

    with session.path.open("rb") as file:
        reader = make_reader(file)
        assert reader.get_header().profile == "ros2"
        recorded = [message.data for _, _, message in reader.iter_messages(topics=["/cloth_sim/points"])]
    # The subscriber may be matched a few frames after the first; from then on it has all of them, bit for bit.
    assert recorded[-len(session.received) :] == session.received
    stamps = np.array([decode_cloud(data).stamp for data in session.received])
    assert np.ptp(stamps) > 120 * PERIOD
    # Missed ticks are skipped: stamps stay on the grid of the period (1 % with clock drift).
    assert np.all(np.abs(np.diff(stamps) - np.rint(np.diff(stamps) / PERIOD) * PERIOD) <= PERIOD / 100)


def check_corner_follows_the_gripper_and_falls(session: Session) -> None:
    script = GripperScript.from_dict(SCRIPT)
    commanded = np.array([script.pose(time)[0] for time in np.arange(0.0, script.duration, 0.001)])
    target, held, followed, after = None, False, [], []
    with SessionReader(session.path) as reader:
        for recorded in reader.clouds():
            assert recorded.frame is not None
            for event in recorded.frame.events:
                if event["kind"] == "target":
                    target = np.array(event["position"])
                    # At up to 1.4 m/s, a millisecond between the samples.
                    assert np.min(np.linalg.norm(commanded - target, axis=1)) < 1e-3
                elif event["kind"] == "grasp":
                    held = event["closed"]
            corner = recorded.cloud.xyz[-1].astype(float)
            if held:
                assert target is not None
                # Within the compliance of the grip, in the frame in which the target took effect.
                assert np.linalg.norm(corner - target) < 0.02
                followed.append(corner)
            elif followed:
                after.append(corner)
    assert np.linalg.norm(followed[-1] - followed[0]) > 0.6
    assert min(corner[2] for corner in after) < followed[-1][2] - 0.2


def check_second_reader_agrees(session: Session) -> None:
    from mcap.reader import make_reader
    from rosbags.rosbag2 import Reader

    with session.path.open("rb") as file:
        first = sorted(
            (channel.topic, message.log_time, bytes(message.data))
            for _, channel, message in make_reader(file).iter_messages()
        )
    with Reader(session.path) as reader:
        second = sorted((connection.topic, time, bytes(data)) for connection, time, data in reader.messages())
    assert first == second
    topics = {topic for topic, _, _ in first}
    node_topics = (
        "points",
        "topology",
        "state",
        "frame",
        *(f"gripper/{leaf}" for leaf in ("wrench", "state", "target", "grasp")),
    )
    assert {"/rosout", "/diagnostics", *(f"/cloth_sim/{name}" for name in node_topics)} <= topics
    logged = [decode(data, "rcl_interfaces/msg/Log") for topic, _, data in first if topic == "/rosout"]
    assert {message.name for message in logged} == {"cloth_sim"}


def check_runs_again(session: Session) -> None:
    with SessionReader(session.path, strict=True) as reader:
        assert reader.complete
        scene = Scene.from_parameters(parameter_file.parse(reader.scene_yaml))
        simulation = Simulation(scene, State.from_bytes(reader.state))
        for record in reader.frames():
            frame = simulation.advance([events.from_dict(dict(event)) for event in record.events])
            assert (frame.index, simulation.state.digest()) == (record.frame, record.digest)
        clouds = list(reader.clouds())
        # The client changes nothing before the script: it only opens the gripper.
        grasps = [event["closed"] for record in reader.frames() for event in record.events if event["kind"] == "grasp"]
    assert grasps == [False, True, False]
    assert simulation.frame > 120
    np.testing.assert_array_equal(clouds[-1].cloud.xyz, simulation.positions.astype(np.float32))
    assert all(cloud.frame is not None for cloud in clouds)


def _messages(data: bytes) -> list[bytes]:
    messages, offset = [], 0
    while offset + 8 <= len(data):
        length = int.from_bytes(data[offset : offset + 8], "little")
        messages.append(data[offset + 8 : offset + 8 + length])
        offset += 8 + length
    return messages
