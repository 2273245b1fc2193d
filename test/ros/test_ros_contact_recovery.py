# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Contacts that an event compresses: messages and refusals of the node and `cloth_sim --check`."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rcl_interfaces.msg import Log as RosLog
from rclpy.parameter import Parameter
from support.clocked_cloth import ClockedCloth
from support.ros_client import Client

from cloth_sim_ros.physics.contact.thickness import RECOVERY_SPEED, START_GAP
from cloth_sim_ros.ros import main as node_main
from cloth_sim_ros.ros.io.obstacles import ObstacleTopics
from cloth_sim_ros.scene.parameters import parameter_file
from cloth_sim_ros.simulation.events import Event, Grasp, Reset

LYING: dict[str, Any] = {
    "cloth.orientation": [0.0, 0.0, 0.0, 1.0],
    "cloth.anchors": [""],
    "obstacles": ["table"],
    "table.shape": "plane",
}


def lying(gap: float, **values: Any) -> dict[str, Any]:
    """A flat cloth at a height [m] above a table."""
    return {**LYING, "cloth.position": [0.0, 0.0, gap], **values}


@pytest.fixture
def client(ros_domain: int) -> Iterator[Client]:
    with Client() as client:
        yield client


def logged(client: Client) -> list[str]:
    lines: list[str] = []
    client.node.create_subscription(RosLog, "/rosout", lambda message: lines.append(message.msg), 100)
    return lines


def fastest(cloth: ClockedCloth, thickness: float) -> float:
    """Largest speed of a particle [m/s] until contacts have regained their thickness, at most a given one [m]."""
    simulation, speeds = cloth.simulation, []
    for _ in range(math.ceil(thickness / RECOVERY_SPEED * simulation.scene.rate)):
        cloth.tick()
        speeds.append(np.linalg.norm(simulation.velocities, axis=1).max())
    assert simulation.contact_recovery is None
    return float(max(speeds))


@pytest.mark.parametrize(
    ("events", "expected"),
    [
        ((Grasp("g", False),), ["info"]),
        # Contacts that an earlier frame reduced still recover.
        ((Grasp("g", True),), []),
        ((Grasp("g", False), Reset()), ["warn"]),
    ],
)
def test_cause_of_reduced_contacts_is_logged(events: tuple[Event, ...], expected: list[str]) -> None:
    lines: list[str] = []
    log: Any = SimpleNamespace(info=lambda *_: lines.append("info"), warn=lambda *_: lines.append("warn"))
    unused: Any = None
    simulation: Any = SimpleNamespace(scene=SimpleNamespace(rate=60.0))
    frame: Any = SimpleNamespace(recovery=SimpleNamespace(describe=str), events=events)
    ObstacleTopics(unused, simulation, unused, unused, log).log_recovery(frame)
    assert lines == expected


def test_start_within_thickness_is_reported_and_calm(client: Client) -> None:
    lines = logged(client)
    with ClockedCloth(client, lying(0.001, **{"contact.thickness": 0.003})) as cloth:
        lift = 0.003 - 0.001 / START_GAP
        client.spin_until(lambda: any("closer than" in line for line in lines), description="the warning")
        (line,) = [line for line in lines if "closer than" in line]
        assert line == (
            "the cloth starts closer than contact.thickness to 'table': 42 particles; contact begins thinner there and "
            f"grows to contact.thickness in {lift / RECOVERY_SPEED:.3g} s or as soon as the cloth follows; move them "
            f"{1e3 * lift:.3g} mm apart to avoid it"
        )
        assert fastest(cloth, 0.003) < 0.1


def test_raised_thickness_is_reported_and_calm(client: Client) -> None:
    lines = logged(client)
    with ClockedCloth(client, lying(0.003)) as cloth:
        cloth.tick(2)
        result = cloth.node.node.set_parameters_atomically([Parameter("contact.thickness", value=0.01)])
        assert result.successful
        assert fastest(cloth, 0.01) < 0.1
        client.spin_until(lambda: any("closer than" in line for line in lines), description="the warning")
        assert "the cloth is closer than contact.thickness to 'table': 42 particles" in "\n".join(lines)


def test_thickness_beyond_fifty_gaps_is_refused_with_lift(client: Client) -> None:
    with ClockedCloth(client, lying(0.0003, **{"contact.thickness": 0.0003})) as cloth:
        cloth.tick(2)
        result = cloth.node.node.set_parameters_atomically([Parameter("contact.thickness", value=0.03)])
        assert not result.successful
        assert "contact.thickness: move them 0.0297 m apart" in result.reason
        assert cloth.node.node.get_parameter("contact.thickness").value == 0.0003


def test_check_warns_of_compressed_start(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(parameter_file.dump(lying(0.001, **{"cloth.resolution": [6, 7]})))
    assert node_main.main(["--check", str(path)]) == 0
    assert "warning: the cloth starts closer than contact.thickness to 'table': 42 part" in capsys.readouterr().out


def test_check_refuses_start_below_least_gap(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(parameter_file.dump(lying(0.00005, **{"cloth.resolution": [6, 7]})))
    assert node_main.main(["--check", str(path)]) == 1
    assert "6e-05 m at least, 0.02 of contact.thickness: move them 0.00295 m apart" in capsys.readouterr().err
