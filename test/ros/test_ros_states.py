# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Latched states for late subscribers, and the TF frames of the cloth and the grippers."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseArray
from lifecycle_msgs.msg import State
from rclpy.parameter import Parameter
from std_srvs.srv import SetBool, Trigger
from support.clocked_cloth import ClockedCloth
from support.ros_client import Client

from cloth_sim_ros import Scene
from cloth_sim_ros.ros.io.output import LATCHED_QOS
from cloth_sim_ros.ros.io.tf_broadcaster import transforms_bytes
from cloth_sim_ros.scene.parameters.declare import ParameterError

CORNER = (0.5, 0.0, 0.5)


@pytest.fixture
def client(ros_domain: int) -> Iterator[Client]:
    with Client() as client:
        yield client


class LatchedTopic:
    """The newest message of a latched topic for a new subscriber."""

    def __init__(self, client: Client, kind: Any, topic: str) -> None:
        self.messages: list[Any] = []
        client.node.create_subscription(kind, topic, self.messages.append, LATCHED_QOS)
        client.spin_until(lambda: self.messages, description=topic)

    @property
    def values(self) -> dict[str, str]:
        return {entry.key: entry.value for entry in self.messages[-1].values}


def gripper_state(client: Client, name: str = "gripper") -> LatchedTopic:
    return LatchedTopic(client, DiagnosticStatus, f"/cloth_sim/{name}/state")


def test_gripper_state_reaches_late_subscribers(client: Client) -> None:
    with ClockedCloth(client, {"grippers": ["left", "right"]}) as cloth:
        first = gripper_state(client, "left")
        counts = {"grasped_count": "0", "held": "0"}
        assert first.values == {"closed": "false", **counts, "frame": "0", "simulated_time": "0.000000"}
        assert first.messages[-1].message == "open"
        cloth.target("left", CORNER)
        cloth.tick()
        cloth.grasp("left", True)
        cloth.tick(3)
        for topic in (first, gripper_state(client, "left")):
            client.spin_until(lambda topic=topic: topic.values["closed"] == "true", description="the grasp")
            status = topic.messages[-1]
            assert [topic.values[key] for key in ("grasped_count", "held", "frame")] == ["1", "1", "2"]
            assert (status.level, status.message) == (DiagnosticStatus.OK, "closed, holds 1 particle")
            assert (status.name, status.hardware_id) == ("cloth_sim: left", "none")
        assert len(first.messages) == 2, "said once for each grasp, not each frame"
        assert gripper_state(client, "right").values["closed"] == "false"
        # A closing without a change is published too.
        cloth.grasp("left", True)
        cloth.tick()
        client.spin_until(lambda: len(first.messages) == 3, description="an answer")
        assert "it is closed already" in first.messages[-1].message
        reset = client.node.create_client(Trigger, "/cloth_sim/reset")
        client.spin_until(reset.service_is_ready, description="reset")
        future = reset.call_async(Trigger.Request())
        client.spin_until(lambda: len(cloth.node.stepper.queue) == 1, description="the reset to wait")
        cloth.tick()
        client.spin_until(lambda: first.values["closed"] == "false", description="what the reset let go")
        client.spin_until(future.done, description="the reset's answer")


def test_closing_on_nothing_is_published_with_reason(client: Client) -> None:
    with ClockedCloth(client) as cloth:
        topic = gripper_state(client)
        cloth.target("gripper", (3.0, 3.0, 3.0))
        cloth.tick()
        cloth.grasp("gripper", True)
        cloth.tick()
        client.spin_until(lambda: topic.values["closed"] == "true", description="the grasp")
        assert topic.messages[-1].level == DiagnosticStatus.WARN
        assert topic.messages[-1].message.startswith("closed, holds nothing: no particle within 0.05 m")


def test_automatic_release_is_published(client: Client) -> None:
    with ClockedCloth(client, {"gripper.timeout": 0.05}) as cloth:
        topic = gripper_state(client)
        cloth.target("gripper", CORNER)
        cloth.tick()
        cloth.grasp("gripper", True)
        cloth.tick(10)
        client.spin_until(
            lambda: [m.message for m in topic.messages[1:]] == ["closed, holds 1 particle", "open"], description="it"
        )


def test_node_state_follows_managed_node_ids(client: Client) -> None:
    with ClockedCloth(client) as cloth:
        cloth.tick(3)
        topic = LatchedTopic(client, State, "/cloth_sim/state")
        assert [(m.id, m.label) for m in topic.messages] == [(State.PRIMARY_STATE_ACTIVE, "active")]
        service = client.node.create_client(SetBool, "/cloth_sim/pause")
        client.spin_until(service.service_is_ready, description="pause")
        service.call_async(SetBool.Request(data=True))
        client.spin_until(lambda: len(cloth.node.stepper.queue) == 1, description="the pause to wait")
        cloth.publish_clock(cloth.now)
        client.spin_until(lambda: len(topic.messages) == 2, description="inactive")
        assert topic.messages[-1].label == "inactive"
        cloth.tick_index += 1
        cloth.publish_clock(cloth.now)
    client.spin_until(lambda: len(topic.messages) == 3, description="the end")
    assert (topic.messages[-1].id, topic.messages[-1].label) == (State.PRIMARY_STATE_FINALIZED, "finalized")


def test_states_are_recorded_from_the_beginning_of_a_recording(client: Client, tmp_path: Path) -> None:
    pytest.importorskip("mcap")
    from cloth_sim_ros.session.reader import SessionReader

    with ClockedCloth(client, {"record.folder": str(tmp_path)}) as cloth:
        cloth.tick(5)
        cloth.node.recording.switch(True, lambda *_: None)
        cloth.tick(2)
    (path,) = tmp_path.glob("*.mcap")
    with SessionReader(path) as reader:
        topics = [message.topic for message in reader.messages()]
    assert topics.index("/cloth_sim/gripper/state") < topics.index("/cloth_sim/frame")
    assert topics.count("/cloth_sim/state") == 2, "active at the beginning, finalized at the end"


# TF


@pytest.fixture
def tf2_msgs(monkeypatch: pytest.MonkeyPatch) -> type:
    """A stub of tf2_msgs, which is not on PyPI: messages use another type and are read as bytes."""
    kind = type("TFMessage", (PoseArray,), {"__module__": "tf2_msgs.msg"})
    module, messages = ModuleType("tf2_msgs"), ModuleType("tf2_msgs.msg")
    messages.TFMessage = kind  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "tf2_msgs", module)
    monkeypatch.setitem(sys.modules, "tf2_msgs.msg", messages)
    return kind


def read(data: bytes) -> dict[str, Any]:
    """Return the transforms of a message by frame name."""
    types = pytest.importorskip("rosbags.typesys")
    store = types.get_typestore(types.Stores.ROS2_JAZZY)
    message = store.deserialize_cdr(data, "tf2_msgs/msg/TFMessage")
    assert bytes(store.serialize_cdr(message, "tf2_msgs/msg/TFMessage")) == data
    return {transform.child_frame_id: transform for transform in message.transforms}


@pytest.mark.parametrize("names", [[], ["a"], ["ab", "abc"], ["abcd", "abcde", "left_arm/towel/gripper"]], ids=len)
def test_transform_bytes_match_ros_serialization(names: list[str]) -> None:
    frames = [(name, [0.1 + k, 2.0, 3.0, 0.0, 0.0, 0.6, 0.8]) for k, name in enumerate(names)]
    transforms = read(transforms_bytes(frames, frame_id="world", stamp=5_000_000_007))
    assert list(transforms) == names
    for k, transform in enumerate(transforms.values()):
        assert transform.header.frame_id == "world"
        assert (transform.header.stamp.sec, transform.header.stamp.nanosec) == (5, 7)
        assert transform.transform.translation.x == 0.1 + k
        assert (transform.transform.rotation.z, transform.transform.rotation.w) == (0.6, 0.8)


def test_grippers_and_cloth_are_frames(client: Client, tf2_msgs: type) -> None:
    got: list[bytes] = []
    client.node.create_subscription(tf2_msgs, "/tf", got.append, 100, raw=True)
    with ClockedCloth(client, {"tf.publish": True, "grippers": ["left", "right"], "frame_id": "base"}) as cloth:
        cloth.target("left", CORNER)
        cloth.tick()
        client.spin_until(lambda: client.node.count_publishers("/tf"), description="the frames")
        cloth.tick(2)
        client.spin_until(lambda: len(got) >= 2, description="/tf")
        transforms = read(got[-1])
        # The right gripper has no pose yet.
        assert set(transforms) == {"cloth_sim/cloth", "cloth_sim/left"}
        assert {transform.header.frame_id for transform in transforms.values()} == {"base"}
        translation = transforms["cloth_sim/left"].transform.translation
        assert (translation.x, translation.y, translation.z) == CORNER
        cloth.tick(3)
        client.spin_until(lambda: len(got) >= 5, description="those of five frames")
        simulation = cloth.simulation
        weights = simulation.model.masses / simulation.model.masses.sum()
        centre = weights @ simulation.positions
        translation = read(got[-1])["cloth_sim/cloth"].transform.translation
        np.testing.assert_allclose((translation.x, translation.y, translation.z), centre, atol=1e-3)
        # Off again: no further messages.
        cloth.node.node.set_parameters([Parameter("tf.publish", value=False)])
        cloth.tick()
        sent = cloth.node.outputs.transforms.output
        assert sent is not None
        sent.send = lambda *_: pytest.fail("sent though it is off")
        cloth.tick(2)


def test_missing_tf2_is_logged_and_node_goes_on(
    client: Client, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "tf2_msgs", None)
    with ClockedCloth(client, {"tf.publish": True}) as cloth:
        cloth.tick(5)
    said = capfd.readouterr().err
    assert said.count("tf.publish is set, and tf2_msgs is not installed: no frames are sent") == 1


def test_tf2_is_not_loaded_unless_requested(client: Client) -> None:
    with ClockedCloth(client) as cloth:
        cloth.tick(2)
        assert cloth.node.outputs.transforms.output is None
        assert "tf2_msgs" not in sys.modules


def test_gripper_named_cloth_is_refused() -> None:
    with pytest.raises(ParameterError, match="a gripper is named 'cloth', as the cloth's own frame is"):
        Scene.from_parameters({"grippers": ["cloth"], "tf.publish": True})
