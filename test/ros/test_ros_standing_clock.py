# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A /clock that does not come, stands, steps, or goes back while it stands."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from lifecycle_msgs.msg import State
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import SetBool, Trigger
from support.clocked_cloth import SECOND, ClockedCloth
from support.ros_client import Client, pose, positions, stamp_of

from cloth_sim_ros import Simulation

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


@pytest.fixture
def client(ros_domain: int) -> Iterator[Client]:
    with Client() as client:
        yield client


class Standing(ClockedCloth):
    """A cloth whose /clock stands; the time is published repeatedly, as by a paused Gazebo, unless silent."""

    def __init__(self, client: Client, **options: Any) -> None:
        super().__init__(client, **options)
        self.states: list[str] = []
        self.reports: list[DiagnosticStatus] = []
        client.node.create_subscription(State, "/cloth_sim/state", lambda m: self.states.append(m.label), LATCHED)
        client.node.create_subscription(DiagnosticArray, "/diagnostics", lambda m: self.reports.extend(m.status), 10)
        client.node.create_subscription(PointCloud2, "/cloth_sim/points", client.clouds.append, 1000)

    def until(self, condition: Callable[[], Any], *, at: int | None, expectation: str) -> None:
        """Spin until the condition holds, publishing the time [ns] at which the clock stands."""

        def poll() -> Any:
            if at is not None:
                self.publish_clock(at)
            return condition()

        self.client.spin_until(poll, description=expectation)

    def stand(self, at: int | None) -> None:
        """Keep the time until the node reports that /clock stands."""
        self.until(lambda: self.states and self.states[-1] == "inactive", at=at, expectation="inactive")

    def ask(self, kind: Any, name: str, data: bool | None = None, *, at: int | None = None) -> Any:
        """Call a service while the clock stands; an answer with `no frame was due` fails."""
        caller = self.client.node.create_client(kind, f"/cloth_sim/{name}")
        self.until(caller.service_is_ready, at=at, expectation=f"the service {name}")
        future = caller.call_async(kind.Request() if data is None else kind.Request(data=data))
        self.until(future.done, at=at, expectation=f"an answer of {name}")
        assert "no frame was due" not in future.result().message
        return future.result()

    def wait_for_report(self, level: bytes, start: str, *, at: int | None = None) -> dict[str, str]:
        def is_reported() -> bool:
            report = self.reports[-1] if self.reports else None
            return report is not None and report.level == level and report.message.startswith(start)

        self.until(is_reported, at=at, expectation=f"diagnostics '{start}'")
        return {entry.key: entry.value for entry in self.reports[-1].values}


def test_clock_that_never_comes_is_warned_of(client: Client) -> None:
    with Standing(client) as cloth:
        cloth.wait_for_report(DiagnosticStatus.WARN, "waiting for /clock since ")
        assert cloth.states == ["inactive"]
        cloth.tick(3)
        client.spin_until(lambda: cloth.states == ["inactive", "active"], description="active")
        cloth.wait_for_report(DiagnosticStatus.OK, "")


@pytest.mark.parametrize("republished", [True, False])
def test_standing_clock_is_a_pause(client: Client, tmp_path: Path, republished: bool) -> None:
    pytest.importorskip("mcap")
    from cloth_sim_ros.verify.run import verify

    values = {"record.enabled": True, "record.folder": str(tmp_path)}
    with Standing(client, parameters=values) as cloth:
        cloth.tick(5)
        at = cloth.now - SECOND // 60
        still = at if republished else None
        cloth.stand(still)
        cloth.wait_for_report(DiagnosticStatus.OK, f"/clock stands at {at / SECOND:.3f} s", at=still)
        frame, count = cloth.simulation.frame, len(client.clouds)
        cloth.until(lambda: len(client.clouds) > count, at=still, expectation="a cloud of what stands")
        # Commands take effect without time passing, and are answered.
        corner = cloth.simulation.positions[-1].tolist()
        cloth.send("gripper/target", pose(*corner))
        assert cloth.ask(SetBool, "gripper/close", True, at=still).message == "holds 1 particle"
        assert cloth.ask(Trigger, "save_state", at=still).success
        refused = cloth.ask(Trigger, "step", at=still)
        assert (refused.success, refused.message) == (False, "the cloth is running; pause it first")
        assert cloth.simulation.frame == frame
        start = Simulation(cloth.simulation.scene).positions
        assert cloth.ask(Trigger, "reset", at=still).success
        client.spin_until(
            lambda: np.allclose(positions(client.clouds[-1]), start, atol=1e-6), description="the reset's cloud"
        )
        assert cloth.simulation.frame == frame
        cloth.tick(3)
        client.spin_until(lambda: cloth.states[-1] == "active", description="active")
    stamps = [stamp_of(cloud) for cloud in client.clouds]
    assert stamps == sorted(stamps)
    (path,) = tmp_path.glob("*.mcap")
    verdict = verify([path])
    assert verdict.same
    assert verdict.frames > 8


def test_users_pause_survives_a_standing_clock(client: Client) -> None:
    with Standing(client) as cloth:
        cloth.tick(3)
        cloth.stand(None)
        assert cloth.ask(SetBool, "pause", True).success
        cloth.wait_for_report(DiagnosticStatus.OK, "paused; /clock stands at ")
        frame = cloth.simulation.frame
        # A user who paused may request a single frame.
        assert cloth.ask(Trigger, "step").success
        assert cloth.simulation.frame == frame + 1
        cloth.publish_clock(cloth.now + SECOND)
        cloth.wait_for_report(DiagnosticStatus.OK, f"paused; /clock stands at {cloth.now / SECOND + 1.0:.3f} s")
        assert cloth.simulation.frame == frame + 1
        assert cloth.ask(SetBool, "pause", False).success
        assert cloth.simulation.frame == frame + 1
        assert cloth.states[-1] == "inactive"
        cloth.tick_index += 120
        cloth.tick(3)
        client.spin_until(lambda: cloth.states[-1] == "active", description="active")


@pytest.mark.parametrize("back", [50 * SECOND + 1, 0])
def test_clock_that_goes_back_while_it_stands_resets(client: Client, back: int) -> None:
    with Standing(client) as cloth:
        cloth.tick(5)
        cloth.stand(None)
        start = Simulation(cloth.simulation.scene).positions
        assert not np.allclose(cloth.simulation.positions, start, atol=1e-6)
        cloth.until(lambda: np.allclose(cloth.simulation.positions, start, atol=1e-9), at=back, expectation="the reset")
        cloth.wait_for_report(DiagnosticStatus.OK, f"/clock stands at {back / SECOND:.3f} s", at=back)


def test_clock_standing_at_zero_is_a_clock(client: Client) -> None:
    with Standing(client) as cloth:
        cloth.wait_for_report(DiagnosticStatus.OK, "/clock stands at 0.000 s", at=0)
        assert cloth.ask(Trigger, "reset", at=0).success
        cloth.tick_index = 1
        cloth.tick(3)
        client.spin_until(lambda: cloth.states[-1] == "active", description="active")


@pytest.mark.parametrize(("step", "frames"), [(11 * SECOND, 60), (SECOND // 10, 6)])
def test_frames_of_a_step_of_the_clock_are_not_late(client: Client, step: int, frames: int) -> None:
    with Standing(client) as cloth:
        cloth.tick(1)
        for count in range(1, 4):
            cloth.publish_clock(100 * SECOND + count * step)
            client.spin_until(
                lambda n=count: cloth.simulation.frame >= 1 + n * frames, description="frames made up for"
            )
        assert cloth.simulation.frame == 1 + 3 * frames
        report = cloth.wait_for_report(DiagnosticStatus.OK, "")
        assert report["late_frames"] == "0"


def test_cloth_slower_than_the_clock_is_late(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    with Standing(client) as cloth:
        cloth.tick(1)
        advance = cloth.simulation.advance

        def slow(events: Any = ()) -> Any:
            begun = time.monotonic()
            while time.monotonic() - begun < 0.04:
                pass
            return advance(events)

        monkeypatch.setattr(cloth.simulation, "advance", slow)
        begun = time.monotonic_ns()

        def late() -> bool:
            cloth.publish_clock(100 * SECOND + time.monotonic_ns() - begun)
            values = {entry.key: entry.value for report in cloth.reports[-1:] for entry in report.values}
            return int(values.get("late_frames", 0)) > 10

        client.spin_until(late, description="late frames")


def test_parameters_survive_jump_back(client: Client) -> None:
    with ClockedCloth(client, {"rate": 10.0}) as cloth:
        cloth.tick(3)
        changed = Parameter("gravity", value=[0.0, 0.0, -1.0])
        assert cloth.node.node.set_parameters([changed])[0].successful
        cloth.tick_index //= 2
        cloth.tick(3)
        assert cloth.simulation.scene.gravity == (0.0, 0.0, -1.0)
