# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The gripper client with a cloth that is slow, stands, or ends."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock
from std_srvs.srv import SetBool
from support.clocked_cloth import ClockedCloth
from support.ros_client import STARTED, Client

from cloth_sim_ros.ros.client import gripper_player
from cloth_sim_ros.ros.timing import cloth_clock
from cloth_sim_ros.simulation.gripper_script import GripperScript

SECOND = 1_000_000_000
PERIOD = 1.0 / 60.0
#: The script stays at the position of its closing for 1.2 s.
STEPS: list[dict[str, Any]] = [
    {"time": 0.0, "position": [0.0, 0.0, 0.0]},
    {"time": 1.0, "position": [1.0, 0.0, 0.0], "close": True},
    {"time": 2.2, "position": [1.0, 0.0, 0.0]},
    {"time": 3.0, "position": [2.0, 0.0, 0.0], "close": False},
]
SCRIPT = GripperScript.from_dict({"rate": 100.0, "steps": STEPS})


class SlowCloth:
    """A cloth slower than real time, on the test's clock; it records the received commands.

    Args:
        factor: real-time factor.
        answer: simulated time that pads take to close [s].
        stands_at: simulated time at which the cloth stops [s].
    """

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, factor: float, *, answer: float = 1.0, stands_at: float = math.inf
    ) -> None:
        self.factor, self._answer, self._stands_at = factor, answer, stands_at
        self.wall = self.simulated = 0.0
        #: Received commands with their simulated time [s]: x of targets [m], and grasps.
        self.sent: list[tuple[float, float | bool]] = []
        #: Fraction of the frame that had passed when each target was sent.
        self.shares: list[float] = []
        self._closed: float | None = None
        self._callbacks: dict[str, Callable[[Any], None]] = {}
        clock = SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=round(self.wall * 1e9)))
        self.node: Any = SimpleNamespace(
            create_publisher=lambda *_: SimpleNamespace(publish=self._publish, wait_for_all_acked=lambda _: True),
            create_subscription=lambda _kind, topic, hear, _qos: self._callbacks.update({topic: hear}),
            get_clock=lambda: clock,
        )
        executor = SimpleNamespace(add_node=lambda _: None, spin_once=self._spin_once)
        steady = SimpleNamespace(monotonic=lambda: self.wall)
        monkeypatch.setattr(gripper_player, "SingleThreadedExecutor", lambda: executor)
        for module in (gripper_player, cloth_clock):
            monkeypatch.setattr(module, "time", steady)
        self.player = gripper_player.GripperPlayer(
            self.node, [SCRIPT], target="/cloth_sim", script_time=cloth_clock.ClothTime(self.node, "/cloth_sim")
        )

    def targets(self) -> list[tuple[float, float]]:
        """Simulated time [s] and x [m] of the targets."""
        return [(when, message) for when, message in self.sent if not isinstance(message, bool)]

    def grasps(self) -> list[float]:
        """Simulated times of the grasps [s]."""
        return [when for when, message in self.sent if isinstance(message, bool)]

    def _spin_once(self, timeout_sec: float) -> None:
        self.wall += timeout_sec
        while self.simulated < self._stands_at and self.wall >= (self.simulated + PERIOD) / self.factor:
            self.simulated += PERIOD
            self._frame()

    def _frame(self) -> None:
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(round(self.simulated * SECOND), SECOND)
        self._callbacks["/cloth_sim/clock"](message)
        if self._closed is not None and self.simulated > self._closed + self._answer:
            self._closed = None
            values = [KeyValue(key="closed", value="true"), KeyValue(key="held", value="9")]
            self._callbacks["/cloth_sim/gripper/state"](DiagnosticStatus(values=values))

    def _publish(self, message: Any) -> None:
        if not hasattr(message, "data"):
            self.sent.append((self.simulated, message.pose.position.x))
            self.shares.append((self.wall * self.factor - self.simulated) / PERIOD)
            return
        self.sent.append((self.simulated, message.data))
        self._closed = self.simulated if message.data else None


@pytest.mark.parametrize("factor", [0.03, 0.3, 0.8, 1.0])
def test_script_is_as_slow_as_the_cloth(monkeypatch: pytest.MonkeyPatch, factor: float) -> None:
    cloth = SlowCloth(monkeypatch, factor)
    assert cloth.player.play()
    closed, opened = cloth.grasps()
    begun = cloth.targets()[0][0]
    assert closed - begun == pytest.approx(1.0, abs=0.06)
    assert opened - closed == pytest.approx(2.0, abs=0.1)
    # In no frame does the gripper move further than the script does in the frame's time: at most 1.9 m/s.
    by_frame = dict(cloth.targets())
    ways = [b - a for a, b in zip(list(by_frame.values()), list(by_frame.values())[1:], strict=False)]
    assert max(map(abs, ways)) < 2.4 * 1.6 * PERIOD
    assert [hold.held for hold in cloth.player.grippers[0].reports] == [9]


def test_target_is_sent_within_the_frame_of_a_slow_cloth(monkeypatch: pytest.MonkeyPatch) -> None:
    cloth = SlowCloth(monkeypatch, 0.1)
    assert cloth.player.play()
    # At the start of a frame, either that frame or the next one would take it.
    assert min(cloth.shares[5:]) > 0.2
    assert max(cloth.shares[5:]) < 0.5


def test_script_waits_where_it_closes_until_it_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    cloth = SlowCloth(monkeypatch, 0.5, answer=3.0)
    assert cloth.player.play()
    closed, opened = cloth.grasps()
    assert all(x == 1.0 for when, x in cloth.targets() if closed + 0.1 < when < closed + 3.0)
    # The time from the wait to the opening is that of the script.
    assert opened - closed == pytest.approx(3.0 + 0.8, abs=0.1)


def test_nothing_is_sent_while_the_cloth_stands(monkeypatch: pytest.MonkeyPatch) -> None:
    cloth = SlowCloth(monkeypatch, 1.0, stands_at=0.49)
    said: list[str] = []
    monkeypatch.setattr(cloth.player, "_on_standing", said.append)
    with pytest.raises(gripper_player.GripperError, match=r"/cloth_sim stands at 0\.500 s of simulated time .* for 20"):
        cloth.player.play(standing=20.0)
    assert 20.0 < cloth.wall < 22.0
    late = [when for when, _ in cloth.sent if when >= 0.5]
    assert len(late) < 5
    assert len(said) == 1


def test_restarted_cloth_ends_the_script(monkeypatch: pytest.MonkeyPatch) -> None:
    cloth = SlowCloth(monkeypatch, 1.0)
    # private: the spin is delayed below it
    spin = cloth._spin_once

    def spin_once(timeout_sec: float) -> None:
        spin(timeout_sec)
        if cloth.wall > 1.5:
            cloth.simulated = 0.0
            cloth.factor = 1e-9
            # private: a frame between two spins
            cloth._frame()

    # private: the spin is delayed below it
    monkeypatch.setattr(cloth.player._executor, "spin_once", spin_once)
    with pytest.raises(gripper_player.GripperError, match="went back: it was restarted"):
        cloth.player.play()


def test_cloth_without_time_times_out(monkeypatch: pytest.MonkeyPatch) -> None:
    cloth = SlowCloth(monkeypatch, 1.0, stands_at=-1.0)
    with pytest.raises(gripper_player.GripperError, match="/cloth_sim has published nothing on /cloth_sim/clock"):
        cloth.player.play(standing=3.0)
    assert not cloth.sent


@pytest.mark.parametrize(
    ("time", "end"), [(0.0, 0.0), (0.5, 0.5), (1.0, 2.2), (1.5, 2.2), (3.0, math.inf), (9.0, math.inf)]
)
def test_rest_ends_where_the_script_moves_on(time: float, end: float) -> None:
    assert SCRIPT.rest_end(time) == end


@pytest.fixture
def client(ros_domain: int) -> Iterator[Client]:
    with Client() as client:
        yield client


def test_clock_shows_the_time_of_each_frame(client: Client) -> None:
    times: list[float] = []
    with ClockedCloth(client) as cloth:
        client.node.create_subscription(
            Clock,
            "/cloth_sim/clock",
            lambda message: times.append(message.clock.sec + 1e-9 * message.clock.nanosec),
            QoSProfile(depth=10),
        )
        client.spin_until(lambda: client.node.count_publishers("/cloth_sim/clock") == 1, description="the topic")
        client.spin_until(lambda: cloth.tick() or times, description="a time")
        cloth.tick(3)
        client.spin_until(lambda: times[-1] > cloth.simulation.time - 1e-8, description="the newest time")
        assert times[-3:] == pytest.approx([cloth.simulation.time - k * PERIOD for k in (2, 1, 0)], abs=1e-8)


def test_script_waits_for_a_paused_cloth(client: Client, start_process: Callable[..., Any], tmp_path: Path) -> None:
    script = tmp_path / "script.yaml"
    steps = [
        {"time": 0.0, "position": [0.5, 0.0, 0.5]},
        {"time": 0.5, "position": [0.5, 0.0, 0.5], "close": True},
        {"time": 2.0, "position": [0.5, -0.2, 0.6]},
    ]
    script.write_text(yaml.safe_dump({"steps": steps}))
    targets: list[Any] = []
    client.node.create_subscription(PoseStamped, "/cloth_sim/gripper/target", targets.append, QoSProfile(depth=100))
    node = start_process(["-m", "cloth_sim_ros.ros.main", "--ros-args", "-p", "cloth.resolution:=[6, 7]"])
    node.wait_for_output(STARTED)
    # Match service and publisher first: discovery may take longer than the script.
    assert client.call(SetBool, "/cloth_sim/pause", SetBool.Request(data=True)).success
    gripper = start_process(["-m", "cloth_sim_ros.ros.gripper_main", script])
    topic = "/cloth_sim/gripper/target"
    client.spin_until(lambda: client.node.count_publishers(topic), description="the gripper's publisher")
    assert client.call(SetBool, "/cloth_sim/pause", SetBool.Request(data=False)).success
    client.spin_until(lambda: len(targets) > 20, description="targets")
    assert client.call(SetBool, "/cloth_sim/pause", SetBool.Request(data=True)).success
    gripper.wait_for_output("stands at")
    count = len(targets)
    assert "of simulated time (~/state: inactive): the script waits" in gripper.output
    assert client.call(SetBool, "/cloth_sim/pause", SetBool.Request(data=False)).success
    assert gripper.wait() == 0
    client.spin_until(lambda: len(targets) > count, description="the rest of the targets")
    assert "held 1 particle" in gripper.output
    # Targets of a tenth of a second may still have been in transit.
    assert count < 100
