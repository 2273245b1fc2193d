# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Start of obstacles that follow TF frames: where their frames are, never by a way through the cloth."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from support.clocked_cloth import ClockedCloth
from support.ros_client import Client
from support.tf2_stub import stub_tf2

from cloth_sim_ros.ros.process.stopping import StopRequestedError
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.simulation.events import Reset
from cloth_sim_ros.verify.run import verify

#: A ball beside the hanging cloth, and a TF frame at (x, 0, 0) on the other side.
BALL: dict[str, Any] = {
    "obstacles": ["ball"],
    "ball.shape": "sphere",
    "ball.size": [0.1],
    "ball.position": [-2.0, 0.0, 1.0],
    "ball.frame": "mocap",
}


@pytest.fixture
def client(ros_domain: int) -> Iterator[Client]:
    with Client() as client:
        yield client


def ball_of(cloth: ClockedCloth) -> np.ndarray:
    assert cloth.simulation.obstacles is not None
    return cloth.simulation.obstacles.poses()[0]


def test_obstacle_starts_at_its_tf_frame(client: Client, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    x_of = {"mocap": 2.0}
    stub_tf2(monkeypatch, x_of)
    recorded = {"record.enabled": True, "record.folder": str(tmp_path)}
    with ClockedCloth(client, {**BALL, **recorded}) as cloth:
        assert list(ball_of(cloth)) == [2.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
        cloth.tick(3)
        assert list(ball_of(cloth)) == [2.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
        x_of["mocap"] = 2.01
        cloth.tick(3)
        assert ball_of(cloth)[0] == pytest.approx(2.01)
    (path,) = tmp_path.glob("*.mcap")
    verdict = verify([path])
    assert verdict.same, verdict


def test_start_waits_for_frames_of_obstacles(
    client: Client, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    x_of: dict[str, float] = {}
    stub_tf2(monkeypatch, x_of)
    timer = threading.Timer(0.6, x_of.update, [{"mocap": 2.0}])
    timer.start()
    with ClockedCloth(client, BALL) as cloth:
        assert ball_of(cloth)[0] == 2.0
    timer.join()
    text = "waiting for the TF frames of obstacles: 'ball' follows frame 'mocap': no transform from 'mocap' to"
    assert text in capfd.readouterr().err


def test_signal_ends_the_wait_for_frames(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    stub_tf2(monkeypatch, {})
    with pytest.raises(StopRequestedError, match="SIGINT"):
        ClockedCloth(client, BALL, signal_name=lambda: "SIGINT")


#: A cloth that lies in the plane z = 0.
LYING: dict[str, Any] = {"cloth.orientation": [0.0, 0.0, 0.0, 1.0], "cloth.position": [0.0, 0.0, 0.0]}


def test_frame_in_the_cloth_refuses_the_start(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    stub_tf2(monkeypatch, {"mocap": 0.0})
    with pytest.raises(ValueError, match=r"inside obstacle 'ball'.*; 'ball' starts at TF frame 'mocap' \(ball.frame\)"):
        ClockedCloth(client, {**BALL, **LYING})


def test_position_in_the_cloth_does_not_matter_beside_a_frame(
    client: Client, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    stub_tf2(monkeypatch, {"mocap": 2.0})
    recorded = {"record.enabled": True, "record.folder": str(tmp_path)}
    with ClockedCloth(client, {**BALL, **LYING, **recorded, "ball.position": [0.0, 0.0, 0.0]}) as cloth:
        cloth.tick(2)
        assert ball_of(cloth)[0] == 2.0
        assert list(cloth.node.node.get_parameter("ball.position").value) == [2.0, 0.0, 0.0]
    (path,) = tmp_path.glob("*.mcap")
    assert verify([path]).same


def test_initial_state_does_not_place_a_follower(
    client: Client, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    x_of = {"mocap": 2.0}
    stub_tf2(monkeypatch, x_of)
    recorded = {"record.enabled": True, "record.folder": str(tmp_path)}
    with ClockedCloth(client, {**BALL, **recorded}) as cloth:
        cloth.tick(2)
    (path,) = tmp_path.glob("*.mcap")
    x_of["mocap"] = 3.0
    with ClockedCloth(client, {**BALL, "initial_state": f"{path}@1"}) as cloth:
        assert ball_of(cloth)[0] == 3.0


def test_joined_obstacle_starts_at_its_frame_without_pull(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    stub_tf2(monkeypatch, {"mocap": 2.0})
    joined = {"cloth.anchors": [""], "cloth.joints": ["top-ball"], "gravity": [0.0, 0.0, 0.0]}
    with ClockedCloth(client, {**BALL, **joined}) as cloth:
        assert list(cloth.simulation.scene.joined_obstacles) == ["ball"]
        before = cloth.simulation.positions
        # Joints begin where their particles are; a reset leaves both where they started.
        cloth.tick(2)
        cloth.node.stepper.queue.put(Reset())
        cloth.tick(2)
        assert ball_of(cloth)[0] == 2.0
        assert np.abs(cloth.simulation.positions - before).max() < 1e-9


def test_own_frame_is_refused_at_the_start(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    stub_tf2(monkeypatch, {})
    published = {"ball.frame": "cloth_sim/gripper", "tf.publish": True}
    with pytest.raises(ParameterError, match=r"ball\.frame is 'cloth_sim/gripper', a frame that this node publishes"):
        ClockedCloth(client, {**BALL, **published})


@pytest.mark.parametrize("frame", ["", "nowhere"])
def test_reset_returns_a_follower_without_frame_to_its_start(
    client: Client, monkeypatch: pytest.MonkeyPatch, frame: str
) -> None:
    x_of = {"mocap": 2.0}
    stub_tf2(monkeypatch, x_of)
    with ClockedCloth(client, BALL) as cloth:
        cloth.tick(2)
        x_of["mocap"] = 2.01
        cloth.tick(3)
        cloth.node.node.set_parameters([Parameter("ball.frame", value=frame)])
        cloth.node.stepper.queue.put(Reset())
        cloth.tick(2)
        assert ball_of(cloth)[0] == 2.0


def test_reset_beside_a_new_frame_starts_there(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    stub_tf2(monkeypatch, {"mocap": 2.0, "hand": -3.0})
    with ClockedCloth(client, BALL) as cloth:
        cloth.tick(2)
        cloth.node.node.set_parameters([Parameter("ball.frame", value="hand")])
        cloth.node.stepper.queue.put(Reset())
        cloth.tick(2)
        assert ball_of(cloth)[0] == -3.0


def test_clock_that_goes_back_returns_a_follower_to_its_start(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    x_of = {"mocap": 2.0}
    stub_tf2(monkeypatch, x_of)
    with ClockedCloth(client, BALL) as cloth:
        cloth.tick(3)
        x_of.clear()
        cloth.tick_index -= 100
        cloth.tick(3)
        assert ball_of(cloth)[0] == 2.0


def test_clock_that_goes_back_in_the_wait_clears_transforms(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    x_of: dict[str, float] = {}
    listening = stub_tf2(monkeypatch, x_of)
    publisher = client.node.create_publisher(Clock, "/clock", 10)

    def publish() -> None:
        # The clock goes to and fro until the node has noticed it while it waits.
        for k in range(500):
            publisher.publish(Clock(clock=Time(sec=10 if k // 5 % 2 else 100)))
            time.sleep(0.02)
            if listening and listening[0].n_cleared:
                noticed.append(k)
                break
        x_of["mocap"] = 2.0

    noticed: list[int] = []
    thread = threading.Thread(target=publish)
    thread.start()
    with ClockedCloth(client, BALL):
        thread.join()
    assert noticed


def test_start_without_tf2_leaves_obstacles_in_place(
    client: Client, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "tf2_ros", None)
    with ClockedCloth(client, BALL) as cloth:
        cloth.tick(2)
        assert ball_of(cloth)[0] == -2.0
    assert "'ball' can't follow frame 'mocap'" in capfd.readouterr().err


def test_live_frame_moves_the_obstacle_there(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    stub_tf2(monkeypatch, {"mocap": -1.98})
    with ClockedCloth(client, {**BALL, "ball.frame": "", "ball.position": [-2.0, 0.0, 0.0]}) as cloth:
        cloth.tick()
        cloth.node.node.set_parameters([Parameter("ball.frame", value="mocap")])
        cloth.tick(4)
        assert ball_of(cloth)[0] == pytest.approx(-1.98)


def set_at_once(cloth: ClockedCloth, **values: Any) -> SetParametersResult:
    parameters = [Parameter(name.replace("__", "."), value=value) for name, value in values.items()]
    return cloth.node.node.set_parameters_atomically(parameters)


def test_live_obstacle_starts_at_its_tf_frame(client: Client, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    x_of = {"mocap": 2.0}
    stub_tf2(monkeypatch, x_of)
    recorded = {"record.enabled": True, "record.folder": str(tmp_path)}
    with ClockedCloth(client, {**BALL, **recorded, "obstacles": [""]}) as cloth:
        cloth.tick(2)
        assert set_at_once(cloth, obstacles=["ball"]).successful
        for _ in range(3):
            cloth.tick()
            assert list(ball_of(cloth)) == [2.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
        assert list(cloth.node.node.get_parameter("ball.position").value) == [2.0, 0.0, 0.0]
        x_of["mocap"] = 2.01
        cloth.tick(3)
        assert ball_of(cloth)[0] == pytest.approx(2.01)
        assert set_at_once(cloth, obstacles=[""]).successful
        x_of["mocap"] = 3.0
        assert set_at_once(cloth, obstacles=["ball"]).successful
        cloth.tick()
        assert ball_of(cloth)[0] == 3.0
    (path,) = tmp_path.glob("*.mcap")
    verdict = verify([path])
    assert verdict.same, verdict


def test_obstacle_described_live_starts_at_its_frame(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    stub_tf2(monkeypatch, {"mocap": 2.0})
    with ClockedCloth(client) as cloth:
        cloth.tick()
        described = {"ball__shape": "sphere", "ball__size": [0.1], "ball__position": [-2.0, 0.0, 1.0]}
        assert set_at_once(cloth, **described, ball__frame="mocap", obstacles=["ball"]).successful
        cloth.tick()
        assert ball_of(cloth)[0] == 2.0


def test_live_obstacle_needs_its_tf_frame(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    x_of: dict[str, float] = {}
    listening = stub_tf2(monkeypatch, x_of)
    with ClockedCloth(client, {**BALL, "obstacles": [""]}) as cloth:
        # TF is there before the obstacle comes.
        assert len(listening) == 1
        cloth.tick()
        result = set_at_once(cloth, obstacles=["ball"])
        text = "obstacle 'ball' starts at TF frame 'mocap' (ball.frame), which is not known: no transform from 'mocap'"
        assert (result.successful, result.reason[: len(text)]) == (False, text)
        assert list(cloth.node.node.get_parameter("ball.position").value) == [-2.0, 0.0, 1.0]
        x_of["mocap"] = 2.0
        assert set_at_once(cloth, obstacles=["ball"]).successful
        cloth.tick()
        assert ball_of(cloth)[0] == 2.0


def test_live_obstacle_at_frame_in_cloth_is_refused(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    x_of = {"mocap": 0.0}
    stub_tf2(monkeypatch, x_of)
    with ClockedCloth(client, {**BALL, **LYING, "obstacles": [""]}) as cloth:
        cloth.tick()
        result = set_at_once(cloth, obstacles=["ball"])
        assert not result.successful
        assert "'ball'" in result.reason
        cloth.tick()
        assert cloth.simulation.obstacles is None


def test_live_obstacle_without_tf2_starts_in_place(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "tf2_ros", None)
    with ClockedCloth(client, {**BALL, "obstacles": [""]}) as cloth:
        cloth.tick()
        assert set_at_once(cloth, obstacles=["ball"]).successful
        cloth.tick(2)
        assert ball_of(cloth)[0] == -2.0
