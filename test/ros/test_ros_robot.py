# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Links of a robot in the graph: start, joint states, refusals, silence, stops, and a recording that runs again."""

from __future__ import annotations

import json
import math
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import attrs
import numpy as np
import pytest
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger
from support.clocked_cloth import SECOND, ClockedCloth
from support.robots import ARM, ARM_JOINTS, robot_scene
from support.ros_client import Client
from support.tf2_stub import stub_tf2

from cloth_sim_ros.ros.io.robot_start import link_poses, mount_of
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.session.cdr import decode
from cloth_sim_ros.session.reader import SessionReader
from cloth_sim_ros.simulation.events import Pause, Reset, SetParameters
from cloth_sim_ros.verify.markers import MARKERS
from cloth_sim_ros.verify.run import verify

AT: dict[str, Any] = {"robot.enabled": True, "robot.position": [1.1, 0.0, 0.5]}
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


@pytest.fixture
def client(ros_domain: int) -> Iterator[Client]:
    with Client() as client:
        yield client


@pytest.fixture
def description(tmp_path: Path) -> str:
    path = tmp_path / "arm.urdf"
    path.write_text(ARM)
    return str(path)


def state(positions: Any, names: Any = ARM_JOINTS, *, stamp: int = 0) -> JointState:
    message = JointState(name=list(names), position=[float(value) for value in positions])
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, SECOND)
    return message


@contextmanager
def repeated(client: Client, *messages: JointState | bytes, topic: str = "/joint_states") -> Iterator[None]:
    """Publish joint states until the context ends, because a starting node misses those before its subscription."""
    publisher, done = client.node.create_publisher(JointState, topic, 10), threading.Event()

    def publish() -> None:
        while not done.wait(0.02):
            for message in messages:
                publisher.publish(message)

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()
        client.node.destroy_publisher(publisher)


@contextmanager
def arm(client: Client, positions: Any, values: dict[str, Any]) -> Iterator[ClockedCloth]:
    """A cloth beside an arm that stood at joint positions while the node started."""
    with repeated(client, state(positions)):
        cloth = ClockedCloth(client, {**AT, **values})
    # States of the start that are still on their way would count as those of a test.
    commands, received = cloth.node.inputs.commands, -1
    while received != commands.received:
        received = commands.received
        for _ in range(5):
            client.executor.spin_once(timeout_sec=0.02)
    with cloth:
        yield cloth


def send(cloth: ClockedCloth, message: JointState) -> None:
    """Publish a joint state, and wait until the node has received it."""
    commands, publisher = cloth.node.inputs.commands, cloth.client.publisher(JointState, "/joint_states")
    received = commands.received
    publisher.publish(message)
    cloth.client.spin_until(lambda: commands.received > received, description="the joint state to be taken")


def poses(cloth: ClockedCloth) -> np.ndarray:
    assert cloth.simulation.obstacles is not None
    return cloth.simulation.obstacles.poses()


def test_links_follow_joint_states_in_the_next_frame(client: Client, description: str) -> None:
    links = robot_scene(ARM, AT)[1]
    with arm(client, (0.1, 0.2, 0.3, 0.01), {"robot.description_file": description}) as cloth:
        assert cloth.simulation.scene.link_names == list(links.names)
        assert np.abs(poses(cloth) - links.poses(np.array([0.1, 0.2, 0.3, 0.01]))).max() < 1e-15
        cloth.tick(2)
        send(cloth, state((0.12, 0.2, 0.3, 0.01)))
        cloth.tick()
        assert np.abs(poses(cloth) - links.poses(np.array([0.12, 0.2, 0.3, 0.01]))).max() < 1e-15
        # One joint alone, by another publisher; the others stay.
        send(cloth, state([0.02], ["finger"]))
        cloth.tick()
        assert np.abs(poses(cloth) - links.poses(np.array([0.12, 0.2, 0.3, 0.02]))).max() < 1e-15
        names = [name for name, _ in client.node.get_topic_names_and_types()]
        assert not [name for name in names if "hand" in name], "links have no topics of their own"


def test_description_comes_from_its_latched_topic(client: Client, capfd: pytest.CaptureFixture[str]) -> None:
    client.node.create_publisher(String, "/robot_description", LATCHED).publish(String(data=ARM))
    values = {"robot.frame": "", "robot.links": ["hand"], "robot.joint_states_topic": "/arm/joint_states"}
    with repeated(client, state((0.0, 0.0, 0.0, 0.0)), topic="/arm/joint_states"):
        cloth = ClockedCloth(client, {**AT, **values})
    with cloth:
        assert cloth.simulation.scene.obstacle_names == ["hand"]
        assert "1 collision shapes of 1 links are obstacles" in capfd.readouterr().err


def test_start_takes_latched_joint_states_by_override(client: Client, description: str) -> None:
    client.node.create_publisher(JointState, "/joint_states", LATCHED).publish(state((0.1, 0.2, 0.3, 0.01)))
    prefix = "qos_overrides./joint_states.subscription"
    overrides = {f"{prefix}.durability": "transient_local", f"{prefix}.reliability": "reliable"}
    ended = threading.Event()
    timer = threading.Timer(20.0, ended.set)
    timer.start()
    values = {**AT, "robot.description_file": description, **overrides}
    with ClockedCloth(client, values, signal_name=lambda: "TIMEOUT" if ended.is_set() else "") as cloth:
        timer.cancel()
        expected = robot_scene(ARM, AT)[1].poses(np.array([0.1, 0.2, 0.3, 0.01]))
        assert np.abs(poses(cloth) - expected).max() < 1e-15


def test_invalid_bytes_and_new_description_are_reported(client: Client, capfd: pytest.CaptureFixture[str]) -> None:
    description = client.node.create_publisher(String, "/robot_description", LATCHED)
    description.publish(String(data=ARM))
    invalid = serialize_message(state((0.1,), ("shoulder",)))[:20]
    with repeated(client, invalid, state((0.0, 0.0, 0.0, 0.0))):
        cloth = ClockedCloth(client, {**AT, "robot.links": ["hand"]})
    with cloth:
        assert "bytes on /joint_states are no JointState; check the type" in capfd.readouterr().err
        log = ""

        def is_reported() -> bool:
            nonlocal log
            log += capfd.readouterr().err
            return "the robot's description on /robot_description has changed" in log

        for _ in range(3):
            description.publish(String(data=ARM.replace('name="arm"', 'name="other"')))
            cloth.client.spin_until(is_reported, description="the warning of a new description")
        cloth.tick()
        assert (log + capfd.readouterr().err).count("has changed") == 1


def test_unnamed_joint_stays_at_zero_with_a_warning(
    client: Client, description: str, capfd: pytest.CaptureFixture[str]
) -> None:
    with repeated(client, state((0.1, 0.2), ARM_JOINTS[:2])):
        cloth = ClockedCloth(client, {**AT, "robot.description_file": description})
    with cloth:
        assert "no joint state on /joint_states names wrist, finger: these joints stay at 0" in capfd.readouterr().err


def test_invalid_joint_states_are_refused_and_the_node_goes_on(
    client: Client, description: str, capfd: pytest.CaptureFixture[str]
) -> None:
    with arm(client, (0.1, 0.2, 0.3, 0.01), {"robot.description_file": description}) as cloth:
        cloth.tick()
        before = poses(cloth)
        send(cloth, state((float("nan"), 0.2, 0.3, 0.01)))
        send(cloth, state((0.1, 0.2)))
        send(cloth, state((0.3, 0.2, 0.3, 0.01), stamp=cloth.now + 5 * SECOND))
        send(cloth, state((), ()))
        send(cloth, state((0.3, 0.2, 0.3, 0.01), stamp=cloth.now))
        send(cloth, state((0.4, 0.2, 0.3, 0.01), stamp=cloth.now - SECOND // 10))
        log = capfd.readouterr().err
        assert "a joint state is refused: the position of joint 'shoulder' is nan; it must be finite" in log
        # A second refusal of one kind waits for a second.
        assert "a joint state is refused: its stamp is 5.0" in log
        assert "a joint state is dropped: its stamp is 0.100 s older" in log
        assert cloth.refused == (3, 1)
        assert np.array_equal(poses(cloth), before)
        cloth.tick()
        assert not np.array_equal(poses(cloth), before)


def test_silence_of_joint_states_is_reported_once(
    client: Client, description: str, capfd: pytest.CaptureFixture[str]
) -> None:
    with arm(client, (0.1, 0.2, 0.3, 0.01), {"robot.description_file": description, "rate": 10.0}) as cloth:
        cloth.tick()
        send(cloth, state((0.11, 0.2, 0.3, 0.01)))
        cloth.tick(20)
        assert capfd.readouterr().err.count("no joint state has come on /joint_states for 1 s") == 1
        send(cloth, state((0.12, 0.2, 0.3, 0.01)))
        cloth.tick()
        assert "joint states come on /joint_states again" in capfd.readouterr().err


def test_silence_of_some_joints_is_reported_once(
    client: Client, description: str, capfd: pytest.CaptureFixture[str]
) -> None:
    with arm(client, (0.1, 0.2, 0.3, 0.01), {"robot.description_file": description, "rate": 10.0}) as cloth:
        cloth.tick()
        # One publisher for the arm, and one for the finger, which stops.
        send(cloth, state((0.01,), ARM_JOINTS[3:]))
        for k in range(20):
            send(cloth, state((0.11 + 0.001 * k, 0.2, 0.3), ARM_JOINTS[:3]))
            cloth.tick()
        log = capfd.readouterr().err
        assert log.count(f"no joint state on /joint_states names {ARM_JOINTS[3]} for 1 s") == 1
        assert "the robot's links stand" not in log
        send(cloth, state((0.2, 0.2, 0.3, 0.01)))
        cloth.tick()
        assert capfd.readouterr().err.count("joint states come on /joint_states again") == 1


def test_silence_from_the_start_on_is_reported(
    client: Client, description: str, capfd: pytest.CaptureFixture[str]
) -> None:
    with arm(client, (0.1, 0.2, 0.3, 0.01), {"robot.description_file": description, "rate": 10.0}) as cloth:
        cloth.tick(20)
        assert capfd.readouterr().err.count("no joint state has come on /joint_states for 1 s") == 1


def test_gripper_follows_a_link_without_tf(client: Client, description: str) -> None:
    values = {"robot.description_file": description, "gripper.frame": "hand"}
    with arm(client, (0.1, 0.2, 0.3, 0.01), values) as cloth:
        cloth.tick()
        send(cloth, state((0.2, 0.2, 0.3, 0.01)))
        cloth.tick()
        expected = robot_scene(ARM, AT)[1].link_pose("hand", np.array([0.2, 0.2, 0.3, 0.01]))
        assert np.abs(cloth.position("gripper") - expected[:3]).max() < 1e-15
        # Wall time is set back.
        cloth.node.inputs.limit_times(SECOND)
        # private: the stamp of the joint states
        assert cloth.node.inputs._frames.newest("hand")[2] == SECOND


def test_link_in_the_cloth_refuses_the_start(client: Client, description: str) -> None:
    values = {**AT, "robot.description_file": description, "robot.position": [0.0, 0.0, 0.5]}
    with (
        repeated(client, state((0.0, 0.0, 0.0, 0.0))),
        pytest.raises(ValueError, match=r"obstacle 'base' comes through the cloth|is inside obstacle"),
    ):
        ClockedCloth(client, values)


def test_tf_without_tf2_is_refused_with_the_remedy(
    client: Client, description: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "tf2_ros", None)
    for values in ({"robot.source": "tf"}, {"robot.frame": "platform"}):
        with pytest.raises(ParameterError, match=f"{next(iter(values))} needs tf2_ros.*sudo apt install"):
            ClockedCloth(client, {**AT, "robot.description_file": description, **values})


def test_mount_may_be_the_frame_of_the_root_link(
    client: Client, description: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    x_of = {"base": 1.0}
    listening = stub_tf2(monkeypatch, x_of)
    values = {"robot.description_file": description, "robot.frame": "base", "robot.position": [0.1, 0.0, 0.5]}
    with arm(client, (0.1, 0.2, 0.3, 0.01), {**values, "gripper.frame": "hand"}) as cloth:
        cloth.tick(2)
        links, positions = robot_scene(ARM, AT)[1], np.array([0.1, 0.2, 0.3, 0.01])
        assert np.abs(poses(cloth) - links.poses(positions)).max() < 1e-15
        assert np.abs(cloth.position("gripper") - links.link_pose("hand", positions)[:3]).max() < 1e-15
        # The buffer of the start has the transforms already.
        assert len(listening) == 1
        # The mount moves, but no joint.
        x_of["base"] = 1.2
        cloth.tick(2)
        expected = links.link_pose("hand", positions)[:3] + np.array([0.2, 0.0, 0.0])
        assert np.abs(cloth.position("gripper") - expected).max() < 1e-12
        cloth.node.stepper.queue.put(Reset())
        cloth.tick(2)
        assert np.abs(cloth.position("gripper") - expected).max() < 1e-12


def test_pads_stop_at_a_new_thickness(client: Client, description: str) -> None:
    values = {"robot.description_file": description, "robot.pads": ["left_finger", "right_finger"]}
    with arm(client, (0.0, 0.0, 0.0, 0.02), values) as cloth:
        cloth.tick()
        cloth.node.stepper.queue.put(SetParameters({"contact.thickness": 0.008}))
        cloth.tick()
        for _ in range(2):
            send(cloth, state((0.0, 0.0, 0.0, 0.0)))
            cloth.tick(3)
        by_name = dict(zip(cloth.simulation.scene.obstacle_names, poses(cloth), strict=True))
        gap = np.linalg.norm((by_name["left_finger"] - by_name["right_finger"])[:3]) - 0.02
        assert gap == pytest.approx(1.4 * 0.008, rel=0.1)


def test_fingers_close_after_a_state_beyond_bounds(client: Client, description: str) -> None:
    values = {"robot.description_file": description, "robot.pads": ["left_finger", "right_finger"]}
    with arm(client, (0.1, 0.2, 0.3, 0.03), values) as cloth:
        cloth.tick()
        before = poses(cloth)
        send(cloth, state((0.1, 0.2, 0.3, 1e5)))
        cloth.tick()
        assert np.array_equal(poses(cloth), before)
        send(cloth, state((0.1, 0.2, 0.3, 0.0)))
        cloth.tick()
        names = cloth.node.simulation.scene.obstacle_names
        moved = np.linalg.norm(poses(cloth)[names.index("left_finger"), :3] - before[names.index("left_finger"), :3])
        assert 0.02 < moved < 0.03


def test_reset_without_tf_keeps_the_newest_poses(
    client: Client, description: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    x_of = {"platform": 1.0}
    stub_tf2(monkeypatch, x_of)
    values = {"robot.description_file": description, "robot.frame": "platform", "robot.position": [0.1, 0.0, 0.5]}
    with arm(client, (0.1, 0.2, 0.3, 0.01), values) as cloth:
        cloth.tick()
        send(cloth, state((0.2, 0.2, 0.3, 0.01)))
        cloth.tick()
        expected = poses(cloth)
        del x_of["platform"]
        cloth.node.stepper.queue.put(Reset())
        cloth.tick(3)
        assert np.array_equal(poses(cloth), expected)
        x_of["platform"] = 1.1
        cloth.tick(2)
        assert np.abs(poses(cloth)[:, 0] - expected[:, 0] - 0.1).max() < 1e-12


def test_poses_of_links_and_mount_come_from_tf() -> None:
    scene, links = robot_scene(ARM, {**AT, "robot.frame": "platform"})
    # Both frames are turned by 90 degrees about z, at x = 1 m.
    half = 0.5**0.5
    frames: Any = SimpleNamespace(newest=lambda frame: ((1.0, 0.0, 0.0), (0.0, 0.0, half, half), 0))
    positions = np.zeros(4)
    mounted = link_poses(links, positions, frames, scene.robot)
    # (1.1, 0, 0.5) in the platform's frame is (1, 1.1, 0.5).
    assert np.abs(mounted[0] - [1.0, 1.1, 0.5, 0.0, 0.0, half, half]).max() < 1e-15
    by_tf = link_poses(links, positions, frames, attrs.evolve(scene.robot, source="tf"))
    upper_arm = by_tf[links.names.index("upper_arm")]
    assert np.abs(upper_arm - [1.0, 0.0, 0.15, 0.0, 0.0, half, half]).max() < 1e-15
    frames.newest = lambda frame: ((1.0, 0.0, 0.0), (0.0, 0.0, half, half), 7)
    assert mount_of(frames, scene.robot)[1] == 7


def test_reset_leaves_links_where_the_robot_is(client: Client, description: str) -> None:
    with arm(client, (0.1, 0.2, 0.3, 0.01), {"robot.description_file": description}) as cloth:
        cloth.tick()
        send(cloth, state((0.2, 0.2, 0.3, 0.01)))
        cloth.tick()
        expected = poses(cloth)
        cloth.node.stepper.queue.put(Reset())
        for _ in range(3):
            cloth.tick()
            assert np.array_equal(poses(cloth), expected)


def test_link_that_comes_back_is_where_the_robot_is(client: Client, description: str) -> None:
    with arm(client, (0.1, 0.2, 0.3, 0.01), {"robot.description_file": description}) as cloth:
        names = cloth.simulation.scene.obstacle_names
        node = cloth.node.node
        assert node.set_parameters([Parameter("obstacles", value=names[:-1])])[0].successful
        cloth.tick(2)
        send(cloth, state((0.4, 0.2, 0.3, 0.01)))
        cloth.tick(10)
        start = node.get_parameter(f"{names[-1]}.position").value
        assert node.set_parameters([Parameter("obstacles", value=names)])[0].successful
        cloth.tick()
        present = poses(cloth)
        assert math.dist(present[-1, :3], start) > 0.01
        cloth.tick(5)
        assert np.array_equal(poses(cloth), present)


def test_links_do_not_lag_while_time_stands(
    client: Client, description: str, capfd: pytest.CaptureFixture[str]
) -> None:
    with arm(client, (0.1, 0.2, 0.3, 0.01), {"robot.description_file": description}) as cloth:
        cloth.tick()
        cloth.node.stepper.queue.put(Pause(True))
        obstacles = cloth.simulation.obstacles
        assert obstacles is not None
        send(cloth, state((0.11, 0.2, 0.3, 0.01)))
        for k in range(10):
            cloth.publish_clock(cloth.now + k * SECOND // 10)
            client.executor.spin_once(timeout_sec=0.05)
        client.spin_until(lambda: bool(obstacles.lagging), description="the links to have a target")
        assert "lags behind its target" not in capfd.readouterr().err


def test_states_without_positions_say_nothing_at_the_start(
    client: Client, description: str, capfd: pytest.CaptureFixture[str]
) -> None:
    invalid = state((0.1, 0.2, 0.3, 0.01))
    invalid.header.stamp.sec = -5
    with repeated(client, state(()), invalid, state((0.0, 0.0, 0.0, 0.0))):
        cloth = ClockedCloth(client, {**AT, "robot.description_file": description})
    with cloth:
        log = capfd.readouterr().err
        assert "gives 0 positions" not in log
        assert "a joint state is refused: its stamp is -5 s" in log


def test_recorded_session_runs_again_without_description(client: Client, description: str, tmp_path: Path) -> None:
    values = {
        "robot.description_file": description,
        "robot.position": [0.75, 0.0, 0.6],
        "record.enabled": True,
        "record.folder": str(tmp_path / "sessions"),
    }
    with arm(client, (0.0, 0.0, 0.0, 0.02), values) as cloth:
        for frame in range(20):
            send(cloth, state((-0.02 * frame, 0.01 * frame, 0.0, 0.02)))
            cloth.tick()
    Path(description).unlink()
    (path,) = (tmp_path / "sessions").glob("*.mcap")
    with SessionReader([path]) as reader:
        messages = list(reader.messages())
    assert "/joint_states" in {message.topic for message in messages}
    # The markers show the links where they are.
    drawn = decode([message for message in messages if message.topic.endswith("/obstacles")][-1].data, MARKERS).markers
    (hand,) = [marker for marker in drawn if marker.ns.endswith("/hand")]
    expected = robot_scene(ARM, {**AT, "robot.position": [0.75, 0.0, 0.6]})[1].link_pose(
        "hand", np.array([-0.38, 0.19, 0.0, 0.02])
    )
    assert abs(hand.pose.position.x - expected[0]) < 0.02
    verdict = verify([path])
    assert verdict.same
    assert verdict.frames == 20


def ask_reset(cloth: ClockedCloth) -> Any:
    """Call ~/reset, let a frame pass, and return the answer."""
    caller = cloth.client.node.create_client(Trigger, "/cloth_sim/reset")
    cloth.client.spin_until(caller.service_is_ready, description="the service")
    request = caller.call_async(Trigger.Request())
    cloth.client.spin_until(lambda: len(cloth.node.stepper.queue) == 1, description="the request")
    cloth.tick()
    cloth.client.spin_until(request.done, description="the answer")
    return request.result()


#: Base of the arm from which the hand at the shoulder angle `INSIDE` is in the cloth as it starts.
BASE = [0.75, 0.0, 0.6]
INSIDE = (-1.2, 0.0, 0.0, 0.02)


def test_reset_with_a_link_in_the_cloth_is_refused(client: Client, description: str) -> None:
    values = {"robot.description_file": description, "robot.position": BASE}
    with arm(client, (0.0, 0.0, 0.0, 0.02), values) as cloth:
        cloth.tick()
        send(cloth, state(INSIDE))
        cloth.tick(40)
        answer = ask_reset(cloth)
        assert not answer.success
        assert "obstacle '" in answer.message
        assert "the cloth" in answer.message
        send(cloth, state((0.0, 0.0, 0.0, 0.02)))
        cloth.tick()
        assert ask_reset(cloth).success
        links = robot_scene(ARM, {**AT, "robot.position": BASE})[1]
        assert np.abs(poses(cloth) - links.poses(np.array([0.0, 0.0, 0.0, 0.02]))).max() < 1e-15


def test_jump_back_with_a_link_in_the_cloth_warns(
    client: Client, description: str, capfd: pytest.CaptureFixture[str]
) -> None:
    values = {"robot.description_file": description, "robot.position": BASE, "rate": 10.0}
    with arm(client, (0.0, 0.0, 0.0, 0.02), values) as cloth:
        start = poses(cloth)
        cloth.tick(2)
        cloth.node._on_jump_back(SECOND, 0)  # private: the reset of a jump, before the clock's next frame
        send(cloth, state(INSIDE))
        cloth.tick()
        assert np.array_equal(poses(cloth), start)
        assert "the reset starts links and followers of TF where the scene has them: " in capfd.readouterr().err


def test_jump_back_returns_links_to_their_start(client: Client, description: str) -> None:
    with arm(client, (0.1, 0.2, 0.3, 0.01), {"robot.description_file": description, "rate": 10.0}) as cloth:
        start = poses(cloth)
        cloth.tick()
        send(cloth, state((0.4, 0.2, 0.3, 0.01)))
        cloth.tick(3)
        assert not np.array_equal(poses(cloth), start)
        cloth.tick_index //= 2
        for _ in range(3):
            cloth.tick()
            assert np.array_equal(poses(cloth), start)
        # A state that comes between the jump and its frame counts in that frame.
        cloth.node._on_jump_back(SECOND, 0)  # private: see above
        send(cloth, state((0.3, 0.2, 0.3, 0.01)))
        cloth.tick()
        moved = poses(cloth)
        assert np.abs(moved - robot_scene(ARM, AT)[1].poses(np.array([0.3, 0.2, 0.3, 0.01]))).max() < 1e-15


def test_links_leave_the_poses_of_an_initial_state(client: Client, description: str, tmp_path: Path) -> None:
    values = {"robot.description_file": description}
    saved = tmp_path / "state.npz"
    with arm(client, (0.1, 0.2, 0.3, 0.01), values) as cloth:
        cloth.tick()
        saved.write_bytes(cloth.simulation.state.to_bytes())
        present = cloth.simulation.positions
    with arm(client, (0.3, 0.2, 0.3, 0.01), {**values, "initial_state": str(saved)}) as cloth:
        assert np.array_equal(cloth.simulation.positions, present)
        assert np.abs(poses(cloth) - robot_scene(ARM, AT)[1].poses(np.array([0.3, 0.2, 0.3, 0.01]))).max() < 1e-15


def test_recorded_reset_at_present_poses_runs_again(client: Client, description: str, tmp_path: Path) -> None:
    values = {
        "robot.description_file": description,
        "robot.position": BASE,
        "record.enabled": True,
        "record.folder": str(tmp_path / "sessions"),
        "record.split": 20_000,
        "record.compression": "none",
    }
    with arm(client, (0.0, 0.0, 0.0, 0.02), values) as cloth:
        # private: nothing but the recorder knows its bytes before the next frame splits the file
        recorder = cloth.node.recording.session._recorder
        assert recorder is not None
        for frame in range(60):
            if frame in (20, 45):
                client.spin_until(lambda: recorder.wants_split, description="the file to be large enough")
            send(cloth, state((-0.01 * (frame % 30), 0.01 * frame, 0.0, 0.02)))
            if frame in (15, 40):
                assert ask_reset(cloth).success
            else:
                cloth.tick()
    paths = sorted((tmp_path / "sessions").glob("*.mcap"))
    assert len(paths) > 2
    resets = []
    for path in paths:
        with SessionReader([path]) as reader:
            records = [
                json.loads(decode(message.data, message.type_name).data)
                for message in reader.messages()
                if message.topic.endswith("/frame")
            ]
        resets += [event for record in records for event in record["events"] if event["kind"] == "reset"]
    assert [len(event["obstacles"]) for event in resets] == [6, 6]
    assert resets[0]["poses"] != resets[1]["poses"]
    verdict = verify(paths)
    assert verdict.same
    assert verdict.frames == 60
