# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A node's sessions: all content is compared or listed, and falsified content is found or listed."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from rclpy.parameter import Parameter
from std_srvs.srv import SetBool, Trigger
from support.clocked_cloth import ClockedCloth
from support.falsifier import (
    DIAGNOSTICS,
    FRAME,
    NODE,
    Falsification,
    Messages,
    alter_messages,
    edit,
    falsifications,
    falsify,
)
from support.ros_client import Client, pose

pytest.importorskip("mcap")

from cloth_sim_ros.session import old_keys
from cloth_sim_ros.session.reader import SessionReader
from cloth_sim_ros.verify.main import describe
from cloth_sim_ros.verify.run import Verdict, verify

#: Falsifications of content that only a node records; test/verify has the others, without ROS.
WAYS = {
    name: alteration
    for name, alteration in falsifications("left", busy=False).items()
    if alteration.needs != FRAME or name in ("clouds moved and published 1 ns later", "received target inserted")
}
STATE_OF_LEFT = f"{NODE}/left/state"
SECOND = 1_000_000_000
CORNER = (0.5, 0.0, 0.5)
SCENE: dict[str, Any] = {
    "grippers": ["left", "right"],
    "gripper.radius": 0.2,
    "diagnostics.energy": True,
    "obstacles": ["ball", "floor"],
    "ball.shape": "capsule",
    "ball.size": [0.05, 0.2],
    "ball.position": [0.0, 0.5, 0.3],
    "floor.shape": "plane",
    "floor.position": [0.0, 0.0, -2.0],
}


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        folder = tmp_path_factory.mktemp("sessions")
        with Client() as client:
            play(client, folder)
        (path,) = folder.glob("*.mcap")
        yield path


def call(cloth: ClockedCloth, kind: Any, name: str, request: Any = None) -> None:
    """Call a service that takes effect with the next frame."""
    answer = cloth.client.node.create_client(kind, f"/cloth_sim/{name}")
    cloth.client.spin_until(answer.service_is_ready, description=name)
    future = answer.call_async(request or kind.Request())
    waiting = len(cloth.node.stepper.queue)
    cloth.client.spin_until(
        lambda: len(cloth.node.stepper.queue) > waiting or future.done(), description=f"{name} to be taken"
    )


def change(cloth: ClockedCloth, **values: Any) -> None:
    """Set parameters together."""
    parameters = [Parameter(name, value=value) for name, value in values.items()]
    assert cloth.node.node.set_parameters_atomically(parameters).successful


def play(client: Client, folder: Path, **more: Any) -> None:
    """Cause every kind of record of a node, in a few frames."""
    values = {**SCENE, "record.enabled": True, "record.folder": str(folder), **more}
    with ClockedCloth(client, values) as cloth:
        act(cloth)


def act(cloth: ClockedCloth) -> None:
    cloth.tick(2)
    for k in range(6):
        cloth.target("left", (CORNER[0] - 0.02 * k, CORNER[1], CORNER[2]))
        cloth.target("left", (CORNER[0] - 0.01 * k, CORNER[1], CORNER[2]), stamp=cloth.now)
        cloth.target("ball", (0.0, 0.5 - 0.005 * k, 0.3))
        if k == 1:
            cloth.grasp("left", True)
        cloth.tick()
    # Refused: not finite, too far ahead, older than the newest, in an unknown frame.
    cloth.target("left", (float("nan"), 0.0, 0.0))
    cloth.target("left", CORNER, stamp=cloth.now + 5 * SECOND)
    cloth.target("left", CORNER, stamp=cloth.now - SECOND // 2)
    cloth.send("right/target", pose(0.1, 0.2, 0.3, frame_id="nowhere"))
    cloth.tick(2)
    # This one waits for its stamp.
    cloth.target("left", (0.4, 0.0, 0.5), stamp=cloth.now + 3 * SECOND // 60)
    cloth.tick(5)
    call(cloth, SetBool, "pause", SetBool.Request(data=True))
    cloth.publish_clock(cloth.now)
    cloth.tick_index += 1
    cloth.client.spin_until(lambda: cloth.simulation.paused, description="the pause")
    call(cloth, Trigger, "step")
    cloth.tick()
    call(cloth, SetBool, "pause", SetBool.Request(data=False))
    cloth.tick(2)
    cloth.grasp("left", False)
    change(cloth, obstacles=["ball"])
    cloth.tick(3)
    change(cloth, **{"obstacles": ["ball", "post"], "post.shape": "box", "post.size": [0.1, 0.1, 0.1],
                     "post.position": [0.0, 1.0, 0.0]})  # fmt: skip
    cloth.tick(2)
    cloth.target("post", (0.0, 1.01, 0.0))
    cloth.tick(2)
    change(cloth, **{"obstacles": ["ball"], "points.velocity": True})
    cloth.tick(2)
    change(cloth, **{"points.velocity": False})
    call(cloth, SetBool, "right/close", SetBool.Request(data=True))
    cloth.tick(2)
    call(cloth, Trigger, "reset")
    cloth.tick(3)
    cloth.node.reporting.diagnostics.send()
    cloth.tick(2)


def check(verdict: Verdict) -> None:
    assert verdict.same, describe(verdict)
    assert (verdict.missing, verdict.absent) == ([], [])


def test_every_message_of_a_node_is_compared_or_listed(session: Path) -> None:
    verdict = verify([session])
    check(verdict)
    kinds = ("cloud", "wrench", "topology", "gripper state", "state", "marker message", "command")
    assert all(verdict.compared[kind] for kind in (*kinds, "diagnostics message"))
    with SessionReader(session) as reader:
        counts: dict[str, int] = {}
        for message in reader.messages():
            counts[message.topic] = counts.get(message.topic, 0) + 1
    commands = sum(count for topic, count in counts.items() if topic.endswith(("/target", "/grasp", "/point")))
    left = sum(count for (topic, _), count in verdict.not_compared.items() if topic.endswith(("/target", "/grasp")))
    assert verdict.compared["command"] + left == commands
    assert verdict.clouds == counts["/cloth_sim/points"] == counts["/cloth_sim/frame"] == verdict.frames
    assert verdict.compared["marker message"] == counts["/cloth_sim/obstacles"]
    # The states inactive (until /clock has come) and finalized depend on the node's clock and end.
    assert verdict.compared["state"] == counts["/cloth_sim/state"] - 2


@pytest.mark.parametrize("corruption", WAYS)
def test_falsified_session_of_a_node_is_found_or_listed(session: Path, tmp_path: Path, corruption: str) -> None:
    falsification = WAYS[corruption]
    with SessionReader(session) as reader:
        if not any(True for _ in reader.messages([falsification.needs])):
            pytest.skip("without tf2_msgs a node sends no transforms")
    verdict = verify([falsify(session, tmp_path / "false.mcap", falsification)])
    assert falsification.is_shown(verdict), describe(verdict)


def test_unaltered_copy_of_a_node_comes_out_the_same(session: Path, tmp_path: Path) -> None:
    check(verify([falsify(session, tmp_path / "copy.mcap", Falsification())]))


def test_old_and_current_keys_are_compared_alike(session: Path, tmp_path: Path) -> None:
    tables = {DIAGNOSTICS: old_keys.DIAGNOSTICS, STATE_OF_LEFT: old_keys.GRIPPER_STATE}
    both = verify([session])
    for absent in ("current", "old"):

        def strip(messages: Messages, absent: str = absent) -> Messages:
            for topic, table in tables.items():
                removed = set(table if absent == "old" else table.values())
                messages = alter_messages(topic, edit(functools.partial(remove_keys, removed)))(messages)
            return messages

        verdict = verify([falsify(session, tmp_path / f"{absent}.mcap", Falsification(strip))])
        check(verdict)
        assert (verdict.compared, verdict.not_compared) == (both.compared, both.not_compared)


def remove_keys(removed: set[str], content: Any) -> None:
    for status in getattr(content, "status", [content]):
        pairs = [pair for pair in status.values if pair.key not in removed]
        assert len(pairs) < len(status.values)
        status.values = pairs


def test_recording_begun_amid_the_motion_comes_out_the_same(ros_domain: int, tmp_path: Path) -> None:
    with Client() as client, ClockedCloth(client, {**SCENE, "record.folder": str(tmp_path)}) as cloth:
        cloth.target("left", CORNER)
        cloth.target("ball", (0.0, 0.45, 0.3))
        cloth.grasp("left", True)
        cloth.tick(4)
        cloth.target("left", (0.45, 0.0, 0.5), stamp=cloth.now + SECOND // 20)
        for _ in range(2):
            client.call(SetBool, "/cloth_sim/record", SetBool.Request(data=True))
            act(cloth)
            client.call(SetBool, "/cloth_sim/record", SetBool.Request(data=False))
    paths = sorted(tmp_path.glob("*.mcap"))
    assert len(paths) == 2
    for path in paths:
        check(verify([path]))


def test_equal_targets_for_later_frames_come_out_the_same(ros_domain: int, tmp_path: Path) -> None:
    values = {**SCENE, "record.enabled": True, "record.folder": str(tmp_path)}
    with Client() as client, ClockedCloth(client, values) as cloth:
        cloth.tick(2)
        for _ in range(3):
            for frames in range(4):
                cloth.target("left", CORNER, stamp=cloth.now + frames * SECOND // 60)
            cloth.tick(4)
    (path,) = tmp_path.glob("*.mcap")
    verdict = verify([path])
    check(verdict)
    assert verdict.compared["command"] > 8


def test_recording_of_a_clock_that_goes_back_comes_out_the_same(ros_domain: int, tmp_path: Path) -> None:
    values = {**SCENE, "record.enabled": True, "record.folder": str(tmp_path)}
    with Client() as client, ClockedCloth(client, values) as cloth:
        for back in (30, 300):
            act(cloth)
            cloth.target("left", CORNER)
            cloth.grasp("left", True)
            cloth.tick_index -= back
            cloth.tick()
        act(cloth)
    (path,) = tmp_path.glob("*.mcap")
    check(verify([path]))


def test_split_recording_comes_out_the_same(ros_domain: int, tmp_path: Path) -> None:
    values = {**SCENE, "record.enabled": True, "record.folder": str(tmp_path), "record.split": 20_000}
    with Client() as client, ClockedCloth(client, values) as cloth:
        act(cloth)
        # Private: nothing but the recorder itself knows its bytes before the next frame splits the file.
        # private: falsifies what it writes
        recorder = cloth.node.recording.session._recorder
        assert recorder is not None
        client.spin_until(lambda: recorder.wants_split, description="the file to be large enough")
        act(cloth)
    paths = sorted(tmp_path.glob("*.mcap"))
    assert len(paths) > 1
    check(verify(paths))
    for path in paths[:-1]:
        verdict = verify([path])
        assert verdict.same, describe(verdict)
        # The other files are not verified then, and the verdict says so.
        assert (verdict.missing, verdict.absent) == ([f"the session goes on in another file after {path.name}"], [])
    check(verify(paths[-1:]))
