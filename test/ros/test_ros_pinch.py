# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pinching grippers over topics and services: answers to closing, pad markers, and replay."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import WrenchStamped
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_srvs.srv import SetBool, Trigger
from support.clocked_cloth import ClockedCloth
from support.ros_client import Client
from visualization_msgs.msg import Marker, MarkerArray

from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.verify.run import verify

LATCHED = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
#: A sheet of which the pads just hold a corner.
PINCH: dict[str, Any] = {
    "gripper.mode": "pinch",
    "gripper.pad_size": [0.15, 0.02, 0.15],
    "gripper.opening": 0.02,
    "gripper.force": 2.0,
    "cloth.resolution": [6, 6],
    "cloth.size": [0.3, 0.3],
    "cloth.position": [0.0, 0.0, 0.15],
    "tolerance": 1e-3,
}
CORNER = np.array([0.15, 0.0, 0.0])


def off_corner(x: float, y: float, z: float) -> np.ndarray:
    """A position beside the lower right corner."""
    return np.add(CORNER, (x, y, z))


@pytest.fixture
def client(ros_domain: int) -> Iterator[Client]:
    with Client() as client:
        yield client


def calling(client: Client, service: str, request: Any) -> Any:
    """Return the future of a service call; the service exists."""
    caller = client.node.create_client(SetBool, service)
    client.spin_until(caller.service_is_ready, description=f"the service {service}")
    return caller.call_async(request)


def close_to_the_end(cloth: ClockedCloth, client: Client, *, closed: bool = True) -> tuple[Any, int]:
    """Call ~/gripper/close and run frames until it answers; return the answer and the frames."""
    future = calling(client, "/cloth_sim/gripper/close", SetBool.Request(data=closed))
    client.spin_until(lambda: len(cloth.node.stepper.queue), description="the event")
    frames = 0
    while not future.done() and frames < 60:
        cloth.tick()
        frames += 1
        # The answer of the last frame may still be in transit.
        for _ in range(5):
            client.executor.spin_once(timeout_sec=0.002)
    client.spin_until(future.done, description="an answer")
    return future.result(), frames


def test_closing_answer_waits_for_pads_and_wrench_is_contact(client: Client) -> None:
    wrenches: list[WrenchStamped] = []
    states: list[DiagnosticStatus] = []
    client.node.create_subscription(WrenchStamped, "/cloth_sim/gripper/wrench", wrenches.append, 10)
    client.node.create_subscription(DiagnosticStatus, "/cloth_sim/gripper/state", states.append, LATCHED)
    with ClockedCloth(client, PINCH) as cloth:
        cloth.target("gripper", CORNER)
        cloth.tick()
        answer, frames = close_to_the_end(cloth, client)
        assert answer.success
        assert answer.message == "holds 4 particles"
        # 7 mm at 0.05 m/s take 8 frames.
        assert frames > 8
        client.spin_until(lambda: states and states[-1].message == "closed, holds 4 particles", description="its state")
        assert not [state for state in states if state.message.startswith("closed, holds nothing")]
        cloth.tick()
        # Out of its plane: pushed within its plane, a flat sheet would slip through the pads instead of bending.
        for k in range(31):
            cloth.target("gripper", off_corner(0.0, -0.003 * k, 0.001 * k))
            cloth.tick()
        cloth.tick(60)
        # The cloth below the pads, and a part of that beside them, pulls at them.
        assert -0.2 * 0.3 * 0.3 * 9.81 < wrenches[-1].wrench.force.z < -1e-3
        target = off_corner(0.0, -0.09, 0.03)
        assert np.linalg.norm(cloth.simulation.positions[-1] - target) < 1e-3
        answer, frames = close_to_the_end(cloth, client, closed=False)
        assert answer.success
        assert frames <= 2
        cloth.tick(20)
        assert np.linalg.norm(cloth.simulation.positions[-1] - target) > 0.01


def test_closing_on_nothing_is_answered_when_pads_meet(client: Client) -> None:
    with ClockedCloth(client, PINCH) as cloth:
        cloth.target("gripper", (0.0, 1.0, 0.0))
        cloth.tick()
        answer, _ = close_to_the_end(cloth, client)
        assert not answer.success
        assert answer.message == "holds 0 particles: its pads closed with no particle between them"


@pytest.mark.parametrize("instead", ["opened", "reset"])
def test_interrupted_closing_is_answered(client: Client, instead: str) -> None:
    with ClockedCloth(client, PINCH) as cloth:
        cloth.target("gripper", CORNER)
        cloth.tick()
        future = calling(client, "/cloth_sim/gripper/close", SetBool.Request(data=True))
        client.spin_until(lambda: len(cloth.node.stepper.queue), description="the event")
        cloth.tick(3)
        assert not future.done()
        if instead == "opened":
            cloth.grasp("gripper", False)
        else:
            reset = client.node.create_client(Trigger, "/cloth_sim/reset")
            client.spin_until(reset.service_is_ready, description="~/reset")
            reset.call_async(Trigger.Request())
            client.spin_until(lambda: len(cloth.node.stepper.queue), description="the event")
        cloth.tick()
        client.spin_until(future.done, description="an answer")
        assert not future.result().success
        assert future.result().message == f"holds 0 particles: {instead} before its pads came to rest"


def test_pads_are_shown_where_they_are(client: Client) -> None:
    arrays: list[MarkerArray] = []
    client.node.create_subscription(MarkerArray, "/cloth_sim/obstacles", arrays.append, LATCHED)
    with ClockedCloth(client, PINCH) as cloth:
        cloth.tick()
        cloth.target("gripper", CORNER)
        cloth.tick()
        client.spin_until(lambda: arrays and len(arrays[-1].markers) == 2, description="two pads")
        left, right = arrays[-1].markers
        assert left.ns == "/cloth_sim/gripper.left_pad"
        assert (left.type, left.scale.y) == (Marker.CUBE, 0.02)
        # Half the opening, and half a pad.
        assert left.pose.position.y == pytest.approx(0.02, abs=2e-4)
        assert right.pose.position.y == pytest.approx(-0.02, abs=2e-4)
        close_to_the_end(cloth, client)
        cloth.tick()
        client.spin_until(lambda: arrays[-1].markers[0].pose.position.y < 0.0135, description="closed pads")
        assert arrays[-1].markers[0].pose.position.y > 0.01


def test_a_recorded_pinch_runs_again_to_the_last_bit(client: Client, tmp_path: Path) -> None:
    values = {**PINCH, "record.enabled": True, "record.folder": str(tmp_path)}
    with ClockedCloth(client, values) as cloth:
        cloth.target("gripper", CORNER)
        cloth.tick()
        close_to_the_end(cloth, client)
        for k in range(20):
            cloth.target("gripper", off_corner(0.001 * k, 0.0, 0.002 * k))
            cloth.tick()
        assert cloth.simulation.grasped_count(0) == 4
    (session,) = tmp_path.glob("*.mcap")
    verdict = verify([session])
    assert verdict.same, verdict.first_reason
    assert verdict.frames > 25


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"gripper.mode": "grab"}, "gripper.mode is 'grab'; it must be one of attach, pinch"),
        ({"gripper.force": -1.0}, "gripper.force is -1.0 N; it must be above 0.0 N"),
        ({"gripper.speed": 0.0}, "gripper.speed is 0.0 m/s; it must be at least 0.0001 m/s"),
        ({"gripper.friction": [0.1, 0.2]}, "has friction 0.1 at rest and 0.2 in motion"),
    ],
)
def test_parameters_that_prevent_pinching_are_refused(client: Client, values: dict[str, Any], words: str) -> None:
    with pytest.raises(ParameterError) as caught:
        ClockedCloth(client, {**PINCH, **values})
    assert words in str(caught.value)


def test_opening_that_pads_exceed_is_refused_live(client: Client) -> None:
    with ClockedCloth(client, PINCH) as cloth:
        cloth.target("gripper", off_corner(0.0, 0.2, 0.0))
        cloth.tick(2)
        (result,) = cloth.node.node.set_parameters([Parameter("gripper.opening", value=0.005)])
        assert not result.successful
        assert "gripper.opening is 0.005 m; it would leave the pads of 'gripper'" in result.reason
        assert cloth.node.node.get_parameter("gripper.opening").value == 0.02
