# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The ensemble beside a live cloth: its topic, its process, sessions, diagnostics and refusals."""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import SetBool
from support.clocked_cloth import SECOND, ClockedCloth
from support.ros_client import Client, stamp_of

from cloth_sim_ros.ros.ensemble.ensemble_jobs import EnsembleStart, EnsembleStep
from cloth_sim_ros.ros.ensemble.ensemble_topic import EnsembleTopic
from cloth_sim_ros.ros.ensemble.ensemble_worker import EnsembleWorker
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.session.cdr import decode_cloud
from cloth_sim_ros.session.reader import SessionReader
from cloth_sim_ros.simulation.ensemble import Ensemble, EnsembleFrame
from cloth_sim_ros.simulation.events import Event, Pause, Reset, SetParameters
from cloth_sim_ros.simulation.simulation import Simulation
from cloth_sim_ros.verify.run import verify

RATE = 60
PAGE = Path(__file__).resolve().parents[2] / "docs" / "node" / "uncertainty.md"


@pytest.fixture
def client(ros_domain: int) -> Iterator[Client]:
    with Client() as client:
        yield client


@pytest.fixture
def values(tmp_path: Path) -> dict[str, Any]:
    path = tmp_path / "distribution.yaml"
    path.write_text("parameters: [{name: air.drag, deviation: 0.4}, {name: material.density, deviation: 0.1}]")
    return {"cloth.anchors": ["top_left"], "ensemble.file": str(path)}


def ensemble_of(cloth: ClockedCloth) -> EnsembleTopic:
    ensemble = cloth.node.outputs.ensemble
    assert ensemble is not None
    return ensemble


class Received:
    """Messages of ~/ensemble, and frames of the cloth until one has come."""

    def __init__(self, client: Client) -> None:
        self._client, self.messages = client, list[PointCloud2]()
        client.node.create_subscription(
            PointCloud2, "/cloth_sim/ensemble", self.messages.append, QoSProfile(depth=1000)
        )

    def wait(self, cloth: ClockedCloth, count: int = 1) -> None:
        """Run frames until some further messages have come."""
        goal = len(self.messages) + count

        def has_come() -> bool:
            if len(self.messages) < goal:
                cloth.tick()
                self._client.executor.spin_once(timeout_sec=0.02)
            return len(self.messages) >= goal

        self._client.spin_until(has_come, description=f"{count} messages of the ensemble")


def put(cloth: ClockedCloth, *events: Event) -> int:
    """Queue events, run their frame, and return its number."""
    for event in events:
        cloth.node.stepper.queue.put(event)
    frame = cloth.simulation.frame
    if isinstance(events[0], Pause) and events[0].paused:
        cloth.publish_clock(cloth.now)
        cloth.tick_index += 1
        cloth.client.spin_until(lambda: cloth.simulation.paused, description="the pause")
    else:
        cloth.tick()
    return frame + 1


def test_topic_has_the_deviations_of_the_library(client: Client, values: dict[str, Any], tmp_path: Path) -> None:
    received, events = Received(client), dict[int, list[Event]]()
    values |= {"record.enabled": True, "record.folder": str(tmp_path / "sessions")}
    with ClockedCloth(client, values) as cloth:
        first_stamp, first_frame = cloth.now, cloth.simulation.frame + 1
        received.wait(cloth, 3)
        events[put(cloth, SetParameters({"air.drag": 0.6}))] = [SetParameters({"air.drag": 0.6})]
        received.wait(cloth, 3)
        events[put(cloth, Reset())] = [Reset()]
        received.wait(cloth, 5)
        n_frames, scene = cloth.simulation.frame, cloth.simulation.scene
        described = ensemble_of(cloth).describe()
    start = Scene.from_parameters({**scene.parameters(), "air.drag": 0.2}, files=scene.files)
    expected: dict[int, EnsembleFrame] = {}
    with Ensemble(start, start.distribution(), threads=1) as ensemble:
        for frame in range(1, n_frames + 1):
            expected[frame] = ensemble.advance(events.get(frame, []))
    assert len(received.messages) >= 11
    for message in received.messages:
        frame = first_frame + round((stamp_of(message) - first_stamp) * RATE / SECOND)
        points = np.frombuffer(bytes(message.data), "<f4").reshape(-1, 4)
        assert points[:, :3].tobytes() == expected[frame].mean.astype("<f4").tobytes()
        assert points[:, 3].tobytes() == expected[frame].deviation.astype("<f4").tobytes()
    assert [field.name for field in received.messages[0].fields] == ["x", "y", "z", "deviation"]
    assert (received.messages[0].height, received.messages[0].width) == (6, 7)
    assert received.messages[0].header.frame_id == "world"
    assert (described["ensemble"], described["ensemble_members"], described["ensemble_starts"]) == ("running", "4", "1")
    # The newest message may be on its way.
    assert int(described["ensemble_frames"]) - len(received.messages) in (0, 1)
    (session,) = (tmp_path / "sessions").glob("*.mcap")
    verdict = verify([session])
    assert verdict.same, verdict.first_reason
    assert verdict.compared["ensemble cloud"] >= len(received.messages)
    rows = [line.split("|") for line in PAGE.read_text().split("## Diagnostics\n")[1].split("\n## ")[0].splitlines()]
    assert set(described) == {name for row in rows if len(row) > 2 for name in re.findall(r"`(\w+)`", row[1])}


def test_recording_in_the_middle_lists_the_ensemble(client: Client, values: dict[str, Any], tmp_path: Path) -> None:
    received = Received(client)
    with ClockedCloth(client, {**values, "record.folder": str(tmp_path / "sessions")}) as cloth:
        received.wait(cloth, 2)
        answer = client.call(SetBool, "/cloth_sim/record", SetBool.Request(data=True))
        assert answer.success, answer.message
        received.wait(cloth, 2)
    (session,) = (tmp_path / "sessions").glob("*.mcap")
    verdict = verify([session])
    assert verdict.same, verdict.first_reason
    assert any(topic == "/cloth_sim/ensemble" for topic, _ in verdict.not_compared)
    with SessionReader(session) as reader:
        clouds = [decode_cloud(message.data) for message in reader.messages(["/cloth_sim/ensemble"])]
    assert clouds and all(cloud.deviation is not None for cloud in clouds)


def test_paused_cloth_has_no_further_deviations(client: Client, values: dict[str, Any]) -> None:
    received = Received(client)
    with ClockedCloth(client, values) as cloth:
        received.wait(cloth, 2)
        put(cloth, Pause(True))

        def has_caught_up() -> bool:
            cloth.publish_clock(cloth.now)
            cloth.tick_index += 1
            client.executor.spin_once(timeout_sec=0.02)
            described = ensemble_of(cloth).describe()
            is_complete = int(described["ensemble_frames"]) == len(received.messages)
            return is_complete and described["ensemble_lag_s"] == "0.000"

        streak = 0

        def has_settled() -> bool:
            # The pause takes effect at a later tick; frames before it are still under way.
            nonlocal streak
            streak = streak + 1 if has_caught_up() else 0
            return streak >= 10

        client.spin_until(has_settled, description="the ensemble at the paused frame")
        counts = [(has_caught_up(), len(received.messages))[1] for _ in range(10)]
        assert counts[-1] <= counts[0] + 1
        put(cloth, Pause(False))
        received.wait(cloth, 1)


def test_cloth_does_not_wait_for_the_ensemble(
    client: Client, values: dict[str, Any], capfd: pytest.CaptureFixture[str]
) -> None:
    received = Received(client)
    with ClockedCloth(client, values) as cloth:
        received.wait(cloth, 2)
        process = _process_of(cloth)
        os.kill(process, signal.SIGSTOP)
        cloth.tick(70)
        skipped = int(ensemble_of(cloth).describe()["ensemble_frames_skipped"])
        assert float(ensemble_of(cloth).describe()["ensemble_lag_s"]) > 1.0
        os.kill(process, signal.SIGCONT)
        received.wait(cloth, 1)
        assert int(ensemble_of(cloth).describe()["ensemble_frames_skipped"]) > skipped + 60
        os.kill(process, signal.SIGKILL)
        client.spin_until(lambda: "status -9" in ensemble_of(cloth).describe()["ensemble"], description="the end")
        count = len(received.messages)
        cloth.tick(5)
        client.spin_until(lambda: "~/ensemble ends" in capfd.readouterr().err, description="the warning")
        cloth.tick(5)
        assert len(received.messages) <= count + 1


def _process_of(cloth: ClockedCloth) -> int:
    # private: there is no other way to its process
    process = ensemble_of(cloth)._process._process  # type: ignore[union-attr]  # private, likewise
    assert process is not None
    return int(process.pid)


def test_failed_member_restarts_the_ensemble(
    client: Client, values: dict[str, Any], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "wide.yaml"
    path.write_text("parameters: [{name: air.drag, deviation: 0.5}]")
    received = Received(client)
    values |= {"record.enabled": True, "record.folder": str(tmp_path / "sessions")}
    with ClockedCloth(client, {**values, "ensemble.file": str(path), "rate": 20.0}) as cloth:
        received.wait(cloth, 2)
        # In range, and out of range times exp(0.5).
        put(cloth, SetParameters({"air.drag": 9000.0}))
        put(cloth, SetParameters({"air.drag": 0.2}))
        client.spin_until(
            lambda: cloth.tick() or ensemble_of(cloth).describe()["ensemble_starts"] == "2", description="a restart"
        )
        assert float(ensemble_of(cloth).describe()["ensemble_since_s"]) > 0.0
        received.wait(cloth, 2)
    log = capfd.readouterr().err
    assert "the ensemble restarts at the cloth's state: member 0 of the ensemble (air.drag = 0.329744)" in log
    (session,) = (tmp_path / "sessions").glob("*.mcap")
    verdict = verify([session])
    assert verdict.same, verdict.first_reason
    assert verdict.compared["ensemble cloud"] >= len(received.messages)


def test_process_that_died_before_a_start_starts_nothing(client: Client, values: dict[str, Any]) -> None:
    received = Received(client)
    with ClockedCloth(client, values) as cloth:
        received.wait(cloth, 1)
        put(cloth, Pause(True))
        ensemble = ensemble_of(cloth)
        # As after a restart: its members start with the next frame that moves.
        ensemble._must_start = True  # private: a failed member takes a second
        ensemble.before_frame()
        os.kill(_process_of(cloth), signal.SIGKILL)
        client.spin_until(lambda: "status -9" in ensemble.describe()["ensemble"], description="the end")
        labels = []
        put(cloth, Pause(False))
        for _ in range(3):
            ensemble.before_frame()
            frame = cloth.simulation.advance()
            labels.append(ensemble.record_extras(frame))
            ensemble.add(frame, cloth.now)
    assert labels == [{}, {}, {}]


def test_worker_waits_for_a_start_after_a_failure(values: dict[str, Any]) -> None:
    scene = Scene.from_parameters({**values, "cloth.resolution": [4, 4]})
    start = EnsembleStart(scene.parameters(), dict(scene.files), Simulation(scene).state)
    worker = EnsembleWorker()
    assert worker.advance([EnsembleStep(1, 5, (), None)]).keys() == {"steps", "seconds"}
    answer = worker.advance([EnsembleStep(1, 5, (), start), EnsembleStep(2, 7, (), None)])
    assert (answer["steps"], answer["index"], answer["stamp"], answer["members"]) == (2, 2, 7, 4)
    trouble = worker.advance([EnsembleStep(3, 9, (SetParameters({"air.drag": 9999.0}),), None)])["trouble"]
    assert "air.drag" in trouble
    assert "cloud" not in worker.advance([EnsembleStep(4, 11, (), None)])
    assert worker.advance([EnsembleStep(5, 13, (), start)])["index"] == 5


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("parameters: [{name: air.drug, deviation: 0.4}]", "unknown parameter 'air.drug'"),
        ("parameters: [{name: material.damping, deviation: 2.0}]", "state a smaller deviation"),
    ],
)
def test_unfit_distribution_is_refused(
    client: Client, values: dict[str, Any], tmp_path: Path, content: str, reason: str
) -> None:
    path = tmp_path / "unfit.yaml"
    path.write_text(content)
    with pytest.raises(ParameterError, match=reason):
        ClockedCloth(client, {**values, "material.damping": 5.0, "ensemble.file": str(path)})


def test_ensemble_file_is_read_only(client: Client, values: dict[str, Any]) -> None:
    with ClockedCloth(client, values) as cloth:
        (result,) = cloth.node.node.set_parameters([Parameter("ensemble.file", value="")])
        assert not result.successful


def test_values_beyond_a_members_range_are_refused(client: Client, values: dict[str, Any]) -> None:
    with ClockedCloth(client, values) as cloth:
        largest = Scene.from_parameters({}).parameters()["air.drag"]
        limit = next(entry.max for entry in cloth.simulation.scene.entries if entry.name == "air.drag")
        assert limit is not None and limit > largest
        result = cloth.node.node.set_parameters([Parameter("air.drag", value=float(limit))])[0]
        assert re.search(r"^member \d+ of the ensemble .*air\.drag is .*; state a smaller deviation$", result.reason)
        assert cloth.node.node.set_parameters([Parameter("air.drag", value=0.5)])[0].successful
