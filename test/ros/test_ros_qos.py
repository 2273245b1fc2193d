# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Overrides of quality of service: durability, and the topics that the node subscribes to."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from geometry_msgs.msg import PoseStamped
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2
from support.clocked_cloth import ClockedCloth
from support.ros_client import Client, pose

from cloth_sim_ros.ros import main as node_main
from cloth_sim_ros.ros.io.qos_rules import faults, foreign_owners
from cloth_sim_ros.scene.parameters import parameter_file
from cloth_sim_ros.scene.parameters.declare import ParameterError

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
POINTS = "qos_overrides./cloth_sim/points.publisher"
TARGET = "qos_overrides./cloth_sim/gripper/target.subscription"
GRASP = "qos_overrides./cloth_sim/gripper/grasp.subscription"


@pytest.fixture
def client(ros_domain: int) -> Iterator[Client]:
    with Client() as client:
        yield client


def requested(client: Client, topic: str) -> Any:
    """Return the profile of a topic's only subscription in the graph."""
    endpoints = client.spin_until(
        lambda: client.node.get_subscriptions_info_by_topic(topic), description=f"one of {topic}"
    )
    (info,) = endpoints
    return info.qos_profile


def test_latched_points_reach_late_subscribers(client: Client) -> None:
    with ClockedCloth(client, {f"{POINTS}.durability": "transient_local", f"{POINTS}.depth": 1}) as cloth:
        listener = client.node.create_subscription(PointCloud2, "/cloth_sim/points", lambda _: None, LATCHED)
        client.spin_until(
            lambda: client.node.count_publishers("/cloth_sim/points"), description="the publisher of points"
        )
        cloth.tick(3)
        client.node.destroy_subscription(listener)
        late: list[PointCloud2] = []
        client.node.create_subscription(PointCloud2, "/cloth_sim/points", late.append, LATCHED)
        client.spin_until(lambda: late, description="the last cloud")


def test_inputs_keep_their_defaults(client: Client) -> None:
    with ClockedCloth(client):
        for leaf in ("target", "point"):
            qos = requested(client, f"/cloth_sim/gripper/{leaf}")
            assert (qos.reliability, qos.durability) == (ReliabilityPolicy.BEST_EFFORT, DurabilityPolicy.VOLATILE)
        assert requested(client, "/cloth_sim/gripper/grasp").reliability == ReliabilityPolicy.RELIABLE


def test_inputs_may_be_overridden(client: Client, capfd: pytest.CaptureFixture[str]) -> None:
    values = {
        f"{TARGET}.reliability": "reliable",
        f"{TARGET}.durability": "transient_local",
        f"{TARGET}.depth": 3,
        f"{GRASP}.reliability": "best_effort",
    }
    with ClockedCloth(client, values) as cloth:
        qos = requested(client, "/cloth_sim/gripper/target")
        assert (qos.reliability, qos.durability) == (ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL)
        assert requested(client, "/cloth_sim/gripper/grasp").reliability == ReliabilityPolicy.BEST_EFFORT
        # Without overrides, the parameters hold the defaults, as in `ros2 param dump`.
        assert cloth.node.node.get_parameter(f"{GRASP}.depth").value == 100
        publisher = client.node.create_publisher(PoseStamped, "/cloth_sim/gripper/target", LATCHED)
        client.spin_until(publisher.get_subscription_count, description="the subscription of targets")
        publisher.publish(pose(0.5, 0.0, 0.5))
        client.spin_until(lambda: cloth.node.inputs.commands.received == 1, description="a target")
        # An incompatible publisher is warned of, with the policy that it lacks.
        lacks = QoSProfile(depth=1)
        client.node.create_publisher(PoseStamped, "/cloth_sim/gripper/target", lacks)
        warnings: list[str] = []

        def misfit() -> bool:
            warnings.append(capfd.readouterr().err)
            return "is volatile, so none of its messages arrive" in "".join(warnings)

        client.spin_until(misfit, description="a warning")
    assert "there is no parameter" not in "".join(warnings)


def test_latched_target_is_heard_by_a_node_that_starts_later(client: Client) -> None:
    publisher = client.node.create_publisher(PoseStamped, "/cloth_sim/gripper/target", LATCHED)
    publisher.publish(pose(0.5, 0.0, 0.5))
    values = {f"{TARGET}.reliability": "reliable", f"{TARGET}.durability": "transient_local"}
    with ClockedCloth(client, values) as cloth:
        client.spin_until(lambda: cloth.node.inputs.commands.received == 1, description="the target of before")


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (
            {f"{POINTS}.durability": "transient_local", f"{POINTS}.reliability": "best_effort"},
            f"{POINTS} has reliability best_effort and durability transient_local",
        ),
        (
            # Alone it contradicts the topic's default.
            {"qos_overrides./cloth_sim/topology.publisher.reliability": "best_effort"},
            "set reliability reliable or durability volatile",
        ),
        ({f"{TARGET}.durability": "transient_local"}, f"{TARGET} has reliability best_effort and durability"),
        ({f"{POINTS}.durability": "forever"}, "system_default, transient_local, volatile or best_available"),
        ({f"{TARGET}.reliability": "sometimes"}, f"{TARGET}.reliability is 'sometimes'; it must be system_default"),
        ({f"{TARGET}.depth": -1}, "how many messages wait for the node"),
        ({f"{GRASP}.history": 3}, f"{GRASP}.history is 3; it must be system_default, keep_last or keep_all"),
    ],
    ids=lambda value: "" if isinstance(value, str) else next(iter(value)),
)
def test_senseless_override_is_refused_with_the_reason(client: Client, values: dict[str, Any], words: str) -> None:
    with pytest.raises(ParameterError) as caught, ClockedCloth(client, values):
        pass
    assert words in str(caught.value)


def test_check_refuses_senseless_overrides_together(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "scene.yaml"
    values = {f"{TARGET}.depth": -1, f"{POINTS}.durability": "forever", "rate": 0.0, "frame_id": "/map"}
    path.write_text(parameter_file.dump(values))
    assert node_main.main(["--check", str(path)]) == 1
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == len(values)
    assert all(line.startswith("cloth_sim: ") for line in lines)


def test_override_cannot_change_while_the_cloth_runs(client: Client) -> None:
    with ClockedCloth(client, {f"{POINTS}.depth": 3}) as cloth:
        (result,) = cloth.node.node.set_parameters([Parameter(f"{POINTS}.depth", value=4)])
        assert (result.successful, result.reason) == (
            False, f"{POINTS}.depth can't change while the cloth runs; set it at start",
        )  # fmt: skip


def test_session_holds_the_profiles_in_force(client: Client, tmp_path: Path) -> None:
    reader = pytest.importorskip("mcap.reader")
    values = {
        "record.folder": str(tmp_path),
        "record.enabled": True,
        f"{POINTS}.history": "keep_all",
        f"{POINTS}.durability": "transient_local",
        f"{TARGET}.reliability": "reliable",
        f"{TARGET}.depth": 7,
    }
    with ClockedCloth(client, values) as cloth:
        cloth.target("gripper", (0.5, 0.0, 0.5))
        cloth.grasp("gripper", True)
        cloth.tick(3)
    (path,) = tmp_path.glob("*.mcap")
    with path.open("rb") as file:
        channels = reader.make_reader(file).get_summary().channels.values()
        offered = {channel.topic: channel.metadata.get("offered_qos_profiles", "") for channel in channels}
    points, target = offered["/cloth_sim/points"], offered["/cloth_sim/gripper/target"]
    assert "history: keep_all" in points
    assert "durability: transient_local" in points
    assert "reliability: reliable" in target
    assert "depth: 7" in target
    assert "depth: 100" in offered["/cloth_sim/gripper/grasp"]


def test_dumped_topics_are_distinguished_from_misspelt_ones() -> None:
    topics = ["/towel/points", "/towel/left/wrench", "/diagnostics"]
    names = [
        "qos_overrides./arm/cloth/points.publisher.depth",
        "qos_overrides./arm/cloth/left/wrench.publisher.depth",
        "qos_overrides./towel/pionts.publisher.depth",
        "qos_overrides./diagnostics.publisher.depth",
        "qos_overrides./points.publisher.depth",
        "rate",
    ]
    assert foreign_owners(names, topics, "/towel") == {"/arm/cloth": names[:2]}


def test_policies_of_an_endpoint_are_validated_together() -> None:
    both = {f"{POINTS}.durability": "TRANSIENT_LOCAL", f"{POINTS}.reliability": "Best_Effort"}
    assert len(list(faults(both))) == 1
    apart = {f"{POINTS}.durability": "transient_local", f"{TARGET}.reliability": "best_effort"}
    assert list(faults(apart)) == []
    assert list(faults({}, {"reliability": "best_effort", "durability": "transient_local"})) == []
