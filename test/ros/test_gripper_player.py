# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The gripper client's player on a clock that the test controls."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import attrs
import pytest
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

from cloth_sim_ros.ros.client import gripper_client, gripper_player
from cloth_sim_ros.ros.client.gripper_client import describe_holds
from cloth_sim_ros.simulation.gripper_script import GripperScript

SCRIPT = GripperScript.from_dict(
    {
        "rate": 50.0,
        "steps": [
            {"time": 0.0, "position": [0.0, 0.0, 0.0]},
            {"time": 1.0, "position": [0.0, 0.0, 0.0], "close": True},
            {"time": 2.0, "position": [1.0, 0.0, 0.0], "close": False},
        ],
    }
)


class Cloth:
    """A node whose gripper reports its particle count some time after a closing."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *, held: int = 3, answers_after: float = 0.02) -> None:
        #: Received commands with their time [s]: x of targets [m], and grasps.
        self.sent: list[tuple[float, Any]] = []
        #: The gripper of each command.
        self.to: list[str] = []
        self.time = 0.0
        #: Time at which the system suspends the player, and the duration [s].
        self.suspended_at, self.suspended_for = 0.0, 0.0
        self._held = held
        self._answers_after = answers_after
        #: Future answers of the gripper with their time [s].
        self._answers: list[tuple[float, str, bool]] = []
        self._callbacks: dict[str, Any] = {}
        # The middleware never acknowledges in time: only the node's answers count.
        clock = SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=round(self.time * 1e9)))
        self.node: Any = SimpleNamespace(
            create_publisher=self._create_publisher, create_subscription=self._subscribe, get_clock=lambda: clock
        )
        executor = SimpleNamespace(add_node=lambda _: None, spin_once=self._spin_once)
        monkeypatch.setattr(gripper_player, "SingleThreadedExecutor", lambda: executor)
        monkeypatch.setattr(gripper_player, "time", SimpleNamespace(monotonic=lambda: self.time))

    def publish_state(self, closed: bool, gripper: str = "gripper") -> None:
        """Publish the state of the gripper, as the node does for late subscribers."""
        values = {"closed": str(closed).lower(), "held": str(self._held if closed else 0)}
        self._callbacks[gripper](
            DiagnosticStatus(values=[KeyValue(key=key, value=value) for key, value in values.items()])
        )

    def play(self) -> gripper_player.GripperPlayer:
        player = gripper_player.GripperPlayer(self.node, [SCRIPT], target="/cloth_sim")
        assert player.play()
        return player

    def grasps(self) -> list[int]:
        """Indices of the grasps among the received commands."""
        return [k for k, (_, command) in enumerate(self.sent) if isinstance(command, bool)]

    def _spin_once(self, timeout_sec: float) -> None:
        before, self.time = self.time, self.time + timeout_sec
        if before < self.suspended_at <= self.time:
            self.time += self.suspended_for
        while self._answers and self.time >= self._answers[0][0]:
            _, gripper, closed = self._answers.pop(0)
            self.publish_state(closed, gripper)

    def _create_publisher(self, _kind: Any, topic: str, _qos: Any) -> Any:
        _, gripper, _ = topic.strip("/").split("/")
        return SimpleNamespace(
            publish=lambda message: self._publish(gripper, message),
            wait_for_all_acked=lambda _: False,
            get_subscription_count=lambda: 1,
        )

    def _publish(self, gripper: str, message: Any) -> None:
        self.to.append(gripper)
        self.sent.append((self.time, message.data if hasattr(message, "data") else message.pose.position.x))
        if hasattr(message, "data"):
            self._answers.append((self.time + self._answers_after, gripper, message.data))

    def _subscribe(self, _kind: Any, topic: str, callback: Any, _qos: Any) -> None:
        node, gripper, leaf = topic.strip("/").split("/")
        assert (node, leaf) == ("cloth_sim", "state")
        self._callbacks[gripper] = callback


@pytest.mark.parametrize(("at", "for_long"), [(0.5, 0.0), (0.95, 0.7), (0.3, 30.0), (1.8, 5.0)])
def test_grasps_happen_at_script_positions(monkeypatch: pytest.MonkeyPatch, at: float, for_long: float) -> None:
    cloth = Cloth(monkeypatch)
    cloth.suspended_at, cloth.suspended_for = at, for_long
    cloth.play()
    sent, grasps = cloth.sent, cloth.grasps()
    assert [sent[k][1] for k in grasps] == [True, False]
    for k, expected in zip(grasps, (0.0, 1.0), strict=True):
        # The target before the grasp, and those of the tenth of a second before.
        assert sent[k - 1][1] == pytest.approx(expected, abs=1e-3)
        positions = [
            command for when, command in sent[:k] if sent[k][0] - 0.08 < when and not isinstance(command, bool)
        ]
        assert len(positions) >= 4
        assert positions == pytest.approx([expected] * len(positions), abs=0.01)


@pytest.mark.parametrize("held", [0, 3])
def test_grasp_report_has_particle_count(monkeypatch: pytest.MonkeyPatch, held: int) -> None:
    assert [hold.held for hold in Cloth(monkeypatch, held=held).play().grippers[0].reports] == [held]


def test_gripper_opens_after_grasp_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    # The state after the opening is that of an open gripper.
    cloth = Cloth(monkeypatch, answers_after=2.5)
    player = cloth.play()
    closed, opened = (cloth.sent[k][0] for k in cloth.grasps())
    assert opened - closed >= 2.5
    assert [hold.held for hold in player.grippers[0].reports] == [3]


def test_script_starts_after_node_reports_open_gripper(monkeypatch: pytest.MonkeyPatch) -> None:
    cloth = Cloth(monkeypatch, answers_after=2.5)
    player = gripper_player.GripperPlayer(cloth.node, [SCRIPT], target="/cloth_sim")
    # The state before the request is no answer.
    cloth.publish_state(False)
    assert player.wait_for_grippers(10.0)
    assert [command for _, command in cloth.sent] == [False]
    assert 2.5 <= cloth.time < 3.0


def test_missing_open_report_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    cloth = Cloth(monkeypatch, answers_after=1e9)
    player = gripper_player.GripperPlayer(cloth.node, [SCRIPT], target="/cloth_sim")
    cloth.publish_state(False)
    with pytest.raises(gripper_player.GripperError, match="does not say that it is open"):
        player.wait_for_grippers(10.0)


def test_missing_grasp_answer_times_out(monkeypatch: pytest.MonkeyPatch) -> None:
    cloth = Cloth(monkeypatch, answers_after=1e9)
    player = cloth.play()
    assert len(cloth.grasps()) == 2
    (hold,) = player.grippers[0].reports
    assert hold.held is None
    assert "did not answer within" in hold.text
    assert "not known" in describe_holds(player.grippers[0].reports)


def test_scripts_of_several_grippers_start_and_wait_together(monkeypatch: pytest.MonkeyPatch) -> None:
    cloth = Cloth(monkeypatch)
    cloth.suspended_at, cloth.suspended_for = 0.95, 0.7
    scripts = [attrs.evolve(SCRIPT, gripper=name) for name in ("left", "right")]
    player = gripper_player.GripperPlayer(cloth.node, scripts, target="/cloth_sim")
    for name in ("left", "right"):
        cloth.publish_state(False, name)
    assert player.wait_for_grippers(10.0)
    cloth.sent.clear()
    cloth.to.clear()
    assert player.play()
    of = {name: [sent for to, sent in zip(cloth.to, cloth.sent, strict=True) if to == name] for name in set(cloth.to)}
    assert of["left"] == of["right"]
    assert [[hold.held for hold in hand.reports] for hand in player.grippers] == [[3], [3]]


def test_grasp_reports_are_described_in_words() -> None:
    holds = [gripper_client.GraspReport(1, ""), gripper_client.GraspReport(0, "")]
    assert describe_holds(holds) == "held 1 particle; held nothing (the node's log says why)"
    assert describe_holds([]) == "the script closes nothing"
