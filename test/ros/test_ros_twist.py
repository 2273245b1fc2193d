# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Velocity commands of grippers, as servo nodes and teleoperation send them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import TwistStamped, WrenchStamped
from support.clocked_cloth import SECOND, ClockedCloth
from support.ros_client import Client

from cloth_sim_ros.ros.io.sensor_wrenches import sensor_wrench
from cloth_sim_ros.ros.timing.pacer import FrameTick
from cloth_sim_ros.simulation.events import Pause
from cloth_sim_ros.verify.run import verify

TWIST: dict[str, Any] = {"gripper.twist_max_speed": 1.0, "gripper.twist_timeout": 0.1}
PERIOD = 1.0 / 60.0
#: Frames within the timeout after a velocity came.
LASTING = 6


@pytest.fixture
def client(ros_domain: int) -> Iterator[Client]:
    with Client() as client:
        yield client


def twist(linear: Any = (0.0, 0.0, 0.0), angular: Any = (0.0, 0.0, 0.0), *, frame: str = "") -> TwistStamped:
    message = TwistStamped()
    message.header.frame_id = frame
    message.twist.linear.x, message.twist.linear.y, message.twist.linear.z = map(float, linear)
    message.twist.angular.x, message.twist.angular.y, message.twist.angular.z = map(float, angular)
    return message


def at_origin(cloth: ClockedCloth) -> None:
    cloth.target("gripper", (0.0, 0.0, 0.0))
    cloth.tick()


def test_velocity_moves_gripper_until_timeout(client: Client) -> None:
    with ClockedCloth(client, TWIST) as cloth:
        at_origin(cloth)
        cloth.send("gripper/twist", twist((0.3, 0.0, -0.6)))
        cloth.tick(3)
        np.testing.assert_allclose(cloth.position("gripper"), np.array([0.3, 0.0, -0.6]) * 3 * PERIOD, atol=1e-12)
        cloth.tick(10)
        stopped = cloth.position("gripper")
        np.testing.assert_allclose(stopped, np.array([0.3, 0.0, -0.6]) * LASTING * PERIOD, atol=0.6 * PERIOD)
        cloth.tick(5)
        assert (cloth.position("gripper") == stopped).all()


def test_timeouts_count_after_wall_time_is_set_back(client: Client) -> None:
    with ClockedCloth(client, {**TWIST, "gripper.timeout": 0.5}) as cloth:
        at_origin(cloth)
        cloth.grasp("gripper", True)
        cloth.tick()
        cloth.target("gripper", (0.0, 0.0, 9.0), stamp=cloth.now + SECOND // 2)
        cloth.send("gripper/twist", twist((0.1, 0.0, 0.0)))
        assert len(cloth.node.stepper.queue) == 1
        # As the pacer of wall time does, which the clock of the test replaces.
        start, positions = cloth.now - 10 * SECOND, []
        for k in range(80):
            stamp = start + round(k * PERIOD * SECOND)
            # private: the frame of a tick
            cloth.node._on_tick(FrameTick(stamp=stamp, lateness=0, skipped=0, now=stamp, is_set_back=k == 0))
            positions.append(cloth.position("gripper")[0])
        assert len(cloth.node.stepper.queue) == 0
        assert positions[2] < positions[3] < positions[LASTING]
        assert positions[LASTING + 3] == positions[-1]
        assert not cloth.simulation.grippers.is_closed(0)


def test_rotation_follows_angular_velocity(client: Client) -> None:
    with ClockedCloth(client, TWIST) as cloth:
        at_origin(cloth)
        cloth.send("gripper/twist", twist(angular=(0.0, 0.0, 1.5)))
        cloth.tick(4)
        half = 0.5 * 1.5 * 4 * PERIOD
        quaternion = cloth.simulation.grippers.poses()[0, 3:]
        np.testing.assert_allclose(quaternion, [0.0, 0.0, math.sin(half), math.cos(half)], atol=1e-9)


def test_velocity_beyond_limits_is_shortened(client: Client, capfd: pytest.CaptureFixture[str]) -> None:
    with ClockedCloth(client, {**TWIST, "gripper.twist_max_rate": 0.5}) as cloth:
        at_origin(cloth)
        cloth.send("gripper/twist", twist((0.0, 3.0, 4.0), (0.0, 6.0, 0.0)))
        cloth.tick()
        np.testing.assert_allclose(cloth.position("gripper"), np.array([0.0, 0.6, 0.8]) * PERIOD, atol=1e-12)
        angle = 2.0 * math.asin(cloth.simulation.grippers.poses()[0, 4])
        assert angle == pytest.approx(0.5 * PERIOD, rel=1e-6)
    said = capfd.readouterr().err
    assert "it is limited to 1 m/s (gripper.twist_max_speed)" in said
    assert "it is limited to 0.5 rad/s (gripper.twist_max_rate)" in said


def test_velocity_in_frame_of_gripper_is_turned(client: Client) -> None:
    with ClockedCloth(client, TWIST) as cloth:
        at_origin(cloth)
        half = math.pi / 4.0
        simulation = cloth.simulation
        cloth.node.stepper.queue.put(target := _turned(math.sin(half), math.cos(half)))
        cloth.tick(2)
        assert simulation.grippers.poses()[0, 5] == pytest.approx(target.orientation[2])
        cloth.send("gripper/twist", twist((0.5, 0.0, 0.0), frame="cloth_sim/gripper"))
        cloth.tick()
        # The axis x of the gripper is the axis y of the cloth's frame.
        np.testing.assert_allclose(cloth.position("gripper"), [0.0, 0.5 * PERIOD, 0.0], atol=1e-12)


def _turned(sine: float, cosine: float) -> Any:
    from cloth_sim_ros.simulation.events import Target

    return Target("gripper", (0.0, 0.0, 0.0), (0.0, 0.0, sine, cosine))


def test_target_ends_velocity(client: Client) -> None:
    with ClockedCloth(client, TWIST) as cloth:
        at_origin(cloth)
        cloth.send("gripper/twist", twist((0.5, 0.0, 0.0)))
        cloth.tick()
        cloth.target("gripper", (0.2, 0.1, 0.0))
        cloth.tick(3)
        np.testing.assert_allclose(cloth.position("gripper"), [0.2, 0.1, 0.0], atol=1e-12)


def test_pause_does_not_integrate_velocity(client: Client) -> None:
    with ClockedCloth(client, TWIST) as cloth:
        at_origin(cloth)
        cloth.node.stepper.queue.put(Pause(True))
        _run_paused(cloth, 2)
        assert cloth.simulation.paused
        cloth.send("gripper/twist", twist((0.5, 0.0, 0.0)))
        _run_paused(cloth, 10)
        cloth.node.stepper.queue.put(Pause(False))
        cloth.tick(3)
        # The velocity has expired meanwhile.
        assert not cloth.position("gripper").any()


def _run_paused(cloth: ClockedCloth, count: int) -> None:
    """Run frames in which no time passes."""
    tally = cloth.node.timing.tally
    for _ in range(count):
        before = tally.busy
        cloth.publish_clock(cloth.now)
        cloth.tick_index += 1
        cloth.client.spin_until(lambda before=before: tally.busy > before, description="a frame")


@pytest.mark.parametrize(
    ("values", "message", "words"),
    [
        ({}, twist((float("nan"), 0.0, 0.0)), "they must be finite"),
        ({}, twist((1.0, 0.0, 0.0), frame="/base"), "its frame_id is '/base'"),
        ({}, twist((1.0, 0.0, 0.0), frame="base"), "'base'"),
        ({"gripper.frame": "tool"}, twist((1.0, 0.0, 0.0)), "the gripper follows the TF frame 'tool' (gripper.frame)"),
    ],
)
def test_impossible_velocity_is_refused(
    client: Client, capfd: pytest.CaptureFixture[str], values: Any, message: TwistStamped, words: str
) -> None:
    with ClockedCloth(client, {**TWIST, **values}) as cloth:
        at_origin(cloth)
        cloth.send("gripper/twist", message)
        cloth.tick(2)
        assert cloth.refused == (1, 0)
        assert not cloth.position("gripper").any()
    said = capfd.readouterr().err
    assert "twist of 'gripper' is refused: " in said
    assert words in said


def test_velocity_before_first_target_is_refused(client: Client) -> None:
    with ClockedCloth(client, TWIST) as cloth:
        cloth.send("gripper/twist", twist((1.0, 0.0, 0.0)))
        cloth.tick()
        assert cloth.refused == (1, 0)


def test_session_with_velocities_runs_again(client: Client, tmp_path: Path) -> None:
    values = {**TWIST, "record.enabled": True, "record.folder": str(tmp_path), "gripper.radius": 0.2}
    with ClockedCloth(client, values) as cloth:
        cloth.target("gripper", cloth.simulation.positions[-1])
        cloth.tick()
        cloth.grasp("gripper", True)
        for k in range(10):
            cloth.send("gripper/twist", twist((0.2, 0.0, 0.05 * k), (0.0, 0.3, 0.0)))
            cloth.tick()
        cloth.target("gripper", cloth.position("gripper"))
        cloth.tick(3)
    verdict = verify(list(tmp_path.glob("*.mcap")))
    assert (verdict.different, verdict.first_reason) == (0, "")


def test_topics_exist_only_if_requested(client: Client) -> None:
    with ClockedCloth(client) as cloth:
        cloth.tick()
        names = [name for name, _ in client.node.get_topic_names_and_types()]
        assert not [name for name in names if name.endswith(("/twist", "/ft_sensor_wrench", "/gripper_cmd"))]
        assert cloth.node.inputs.commands.twists is None


def test_sensor_reports_wrench_in_its_own_frame(client: Client) -> None:
    plain: list[WrenchStamped] = []
    sensed: list[WrenchStamped] = []
    values = {"gripper.sensor_frame": "{gripper}_ft", "gripper.radius": 0.2}
    values |= {"gripper.sensor_position": [0.0, 0.0, 0.1], "gripper.sensor_orientation": [0.0, 0.0, 1.0, 0.0]}
    with ClockedCloth(client, values) as cloth:
        client.node.create_subscription(WrenchStamped, "/cloth_sim/gripper/wrench", plain.append, 100)
        client.node.create_subscription(WrenchStamped, "/cloth_sim/gripper/ft_sensor_wrench", sensed.append, 100)
        cloth.target("gripper", cloth.simulation.positions[-1])
        cloth.tick()
        cloth.grasp("gripper", True)
        cloth.tick(3)
        cloth.tick(5)
        client.spin_until(lambda: sensed and plain and len(sensed) > 5, description="wrenches")
        pose = cloth.simulation.grippers.poses()[0]
        stamps = {(m.header.stamp.sec, m.header.stamp.nanosec): m for m in plain}
    last = sensed[-1]
    assert last.header.frame_id == "gripper_ft"
    same = stamps[last.header.stamp.sec, last.header.stamp.nanosec]
    expected = sensor_wrench(_numbers(same), pose, (0.0, 0.0, 0.1), (0.0, 0.0, 1.0, 0.0))
    np.testing.assert_allclose(_numbers(last), expected, rtol=1e-12, atol=1e-15)
    # Half a turn about z changes the signs of x and y.
    np.testing.assert_allclose(_numbers(last)[:3], _numbers(same)[:3] * [-1.0, -1.0, 1.0], rtol=1e-12)
    assert abs(_numbers(last)[2]) > 1e-3


def test_sensor_wrench_moves_torque_to_sensor() -> None:
    wrench, pose = np.array([0.0, 2.0, 0.0, 0.0, 0.0, 0.0]), np.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0])
    sensed = sensor_wrench(wrench, pose, (0.5, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    np.testing.assert_allclose(sensed, [0.0, 2.0, 0.0, 0.0, 0.0, -1.0], atol=1e-15)


def _numbers(message: WrenchStamped) -> np.ndarray:
    force, torque = message.wrench.force, message.wrench.torque
    return np.array([force.x, force.y, force.z, torque.x, torque.y, torque.z])
