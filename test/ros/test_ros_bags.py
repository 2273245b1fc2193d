# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Topics for bags: a bag of a live node runs again to the last bit."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rclpy.parameter import Parameter
from std_msgs.msg import String
from std_srvs.srv import Trigger
from support.bag_recorder import BagRecorder
from support.clocked_cloth import ClockedCloth
from support.ros_client import Client

from cloth_sim_ros.session.cdr import decode_string
from cloth_sim_ros.session.frame_record import FrameRecord
from cloth_sim_ros.verify.bag import verify_bag
from cloth_sim_ros.verify.main import main, status_of
from cloth_sim_ros.verify.run import verify
from cloth_sim_ros.verify.verdict import Verdict

NODE = "/cloth_sim"
PARAMETERS: dict[str, Any] = {"record.topics": True}


@pytest.fixture
def client(ros_domain: int) -> Iterator[Client]:
    with Client() as client:
        yield client


def record(
    client: Client,
    cloth: ClockedCloth,
    path: Path,
    motion: Callable[[], None],
    *,
    keeps: Callable[[str, int], bool] = lambda _topic, _index: True,
    n_without_cloud: int = 0,
) -> BagRecorder:
    """Record a motion of the cloth until all messages have come; `n_without_cloud`: frames that send no cloud."""
    with BagRecorder(client.node, path, keeps=keeps) as recorder:
        topic, outputs = f"{NODE}/frame", cloth.node.outputs.cloth
        assert cloth.node.recording.session.bag_topics is not None
        client.spin_until(lambda: recorder.discover() or topic in recorder.counts, description="the frames' topic")
        client.spin_until(lambda: outputs.points.has_subscribers, description="the recorder as a subscriber")
        motion()
        last = cloth.simulation.frame
        cloth.tick()
        client.spin_until(
            lambda: (
                recorder.counts[topic] and recorder.counts[f"{NODE}/points"] + n_without_cloud >= recorder.counts[topic]
            ),
            description=f"the messages of frame {last}",
        )
    return recorder


def verify_one(path: Path) -> Verdict:
    (verdict,) = verify_bag(path)
    return verdict


def carry(cloth: ClockedCloth) -> None:
    """Grasp a corner, move it, change a parameter, reset, pause and step."""
    corner = cloth.simulation.positions[-1]
    cloth.target("gripper", corner)
    cloth.grasp("gripper", True)
    cloth.tick(3)
    for k in range(1, 5):
        cloth.target("gripper", corner + np.array([0.0, -0.01 * k, 0.01 * k]))
        cloth.tick()
    cloth.node.node.set_parameters_atomically([Parameter("air.drag", value=0.4)])
    cloth.tick(3)
    cloth.client.call(Trigger, f"{NODE}/reset")
    cloth.tick(2)


def test_bag_of_a_live_node_is_the_same_to_the_last_bit(client: Client, tmp_path: Path) -> None:
    with ClockedCloth(client, PARAMETERS) as cloth:
        cloth.tick(4)
        recorder = record(client, cloth, tmp_path / "bag.mcap", lambda: carry(cloth))
    verdict = verify_one(tmp_path / "bag.mcap")
    assert (verdict.same, status_of(verdict), verdict.missing) == (True, 0, [])
    # All but those between the match of the frames' subscription and its snapshot.
    assert verdict.frames >= recorder.counts[f"{NODE}/frame"] - 2 > 10
    assert verdict.compared["topology"] == 1
    assert verdict.compared["wrench"] == verdict.clouds == verdict.frames
    assert main([str(tmp_path / "bag.mcap")]) == 0


def test_snapshots_repeat_and_resume_after_a_lost_frame(client: Client, tmp_path: Path) -> None:
    # Ten frames between two snapshots.
    energy = {"diagnostics.energy": True}
    with ClockedCloth(client, PARAMETERS | energy | {"record.snapshot_period": 10 / 60}) as cloth:
        missing = (f"{NODE}/frame", 5)
        record(client, cloth, tmp_path / "bag.mcap", lambda: cloth.tick(30), keeps=lambda *message: message != missing)
    verdict = verify_one(tmp_path / "bag.mcap")
    assert (verdict.same, status_of(verdict), len(verdict.missing)) == (True, 2, 1)
    assert verdict.missing[0].startswith("1 record between frames ")
    assert "; the run goes on with frame " in verdict.missing[0]
    assert verdict.frames >= 20


def test_second_recorder_receives_its_own_snapshot(client: Client, tmp_path: Path) -> None:
    with ClockedCloth(client, PARAMETERS | {"record.snapshot_period": 0.0}) as cloth:
        record(client, cloth, tmp_path / "first.mcap", lambda: cloth.tick(3))
        # Nobody subscribes meanwhile.
        client.spin_until(lambda: not cloth.node.outputs.cloth.points.has_subscribers, description="no subscriber")
        cloth.tick(3)
        record(client, cloth, tmp_path / "second.mcap", lambda: cloth.tick(5))
    for name in ("first.mcap", "second.mcap"):
        verdict = verify_one(tmp_path / name)
        assert (verdict.same, status_of(verdict), verdict.missing) == (True, 0, [])
        assert verdict.frames >= 2


def test_session_and_bag_of_one_run_are_verified(client: Client, tmp_path: Path) -> None:
    parameters = PARAMETERS | {"record.enabled": True, "record.folder": str(tmp_path), "record.least_free_space": 0}
    with ClockedCloth(client, parameters) as cloth:
        record(client, cloth, tmp_path / "bag.mcap", lambda: carry(cloth))
        cloth.node.close(timeout=10.0)
    (session,) = tmp_path.glob("cloth_sim_*.mcap")
    verdict = verify([session])
    assert (verdict.same, status_of(verdict)) == (True, 0), verdict.first_reason
    assert status_of(verify_one(tmp_path / "bag.mcap")) == 0


def test_failed_frame_begins_new_numbers(client: Client, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("CLOTH_SIM_ROS_RAISE", raising=False)
    with ClockedCloth(client, PARAMETERS) as cloth:

        def motion() -> None:
            cloth.tick(4)
            # The record is published before the cloud fails.
            send = cloth.node.outputs.cloth.send
            monkeypatch.setattr(cloth.node.outputs.cloth, "send", lambda *_, **__: 1 / 0)
            cloth.publish_clock(cloth.now)
            cloth.tick_index += 1
            client.spin_until(lambda: cloth.node.failure.reason, description="the failure")
            monkeypatch.setattr(cloth.node.outputs.cloth, "send", send)
            future = client.node.create_client(Trigger, f"{NODE}/reset").call_async(Trigger.Request())
            cloth.publish_clock(cloth.now)
            cloth.tick_index += 1
            client.spin_until(future.done, description="the reset")
            cloth.tick(4)

        record(client, cloth, tmp_path / "bag.mcap", motion, n_without_cloud=1)
    verdict = verify_one(tmp_path / "bag.mcap")
    assert (verdict.same, status_of(verdict)) == (True, 0), verdict.missing
    assert verdict.frames >= 8


def test_frames_are_published_for_subscribers_only(client: Client) -> None:
    with ClockedCloth(client, PARAMETERS) as cloth:
        topics = cloth.node.recording.session.bag_topics
        sent: list[bytes] = []
        topics.publish = sent.append
        cloth.tick(3)
        assert sent == []
        looking = client.node.create_subscription(String, f"{NODE}/frame", lambda _: None, 10)
        # private: has no public name
        client.spin_until(lambda: topics._frames.has_subscribers, description="the subscriber")
        cloth.tick(2)
        assert [FrameRecord.from_json(decode_string(data)).extras["sequence"] for data in sent] == [3, 4]
        client.node.destroy_subscription(looking)


@pytest.fixture
def published_snapshots(client: Client, ros_domain: int) -> Iterator[tuple[ClockedCloth, list[int], Any]]:
    """Yield a cloth whose frames have a subscriber, the frames before which it published snapshots, and its topics."""
    frames: list[int] = []
    with ClockedCloth(client, PARAMETERS | {"record.snapshot_period": 1000.0}) as cloth:
        topics = cloth.node.recording.session.bag_topics
        subscription = client.node.create_subscription(String, f"{NODE}/frame", lambda _: None, 10)
        # private: has no public name
        topics._snapshots.publish = lambda _: frames.append(cloth.simulation.frame)
        client.spin_until(lambda: topics._frames.has_subscribers, description="the subscriber")
        yield cloth, frames, topics
        client.node.destroy_subscription(subscription)


def test_shorter_period_of_snapshots_holds_at_once(
    published_snapshots: tuple[ClockedCloth, list[int], Any],
) -> None:
    cloth, frames, _ = published_snapshots
    cloth.tick(4)
    cloth.node.node.set_parameters_atomically([Parameter("record.snapshot_period", value=3 / 60)])
    cloth.tick(8)
    assert len(frames) >= 3
    assert set(np.diff(frames[1:])) == {3}


def test_snapshot_without_memory_does_not_stop_the_cloth(
    published_snapshots: tuple[ClockedCloth, list[int], Any], capfd: pytest.CaptureFixture[str]
) -> None:
    cloth, frames, topics = published_snapshots

    def fail() -> None:
        raise MemoryError

    # private: memory that runs out while a snapshot is taken
    topics._take_snapshot = fail
    before = cloth.simulation.frame
    cloth.tick(4)
    assert (cloth.simulation.frame - before, cloth.node.failure.reason, frames) == (4, "", [])
    assert "~/snapshot: no memory is left" in capfd.readouterr().err


def test_node_loads_optional_topics_late() -> None:
    optional = ["cloth_sim_ros.ros.recording.bag_topics", "cloth_sim_ros.ros.io.ground_truth"]
    script = f"import sys, cloth_sim_ros.ros.node; print([name for name in {optional} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True)
    assert done.stdout == "[]\n"


def test_node_without_the_parameter_has_no_topics_for_bags(client: Client) -> None:
    with ClockedCloth(client) as cloth:
        assert cloth.node.recording.session.bag_topics is None
        names = {entry.topic_name for entry in cloth.node.node.publishers}
        assert not names & {f"{NODE}/frame", f"{NODE}/snapshot"}


def test_missing_library_is_named_and_the_node_runs(
    client: Client, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == "mcap" or "snapshot_message" in name]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "mcap", None)
    with ClockedCloth(client, PARAMETERS) as cloth:
        cloth.tick(2)
        assert cloth.node.recording.session.bag_topics is None
    assert "record.topics needs mcap" in capfd.readouterr().err
