# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Obstacles in the graph: targets, markers, wrenches, diagnostics, and addition and removal by parameters."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from geometry_msgs.msg import WrenchStamped
from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from support.clocked_cloth import SECOND, ClockedCloth
from support.ros_client import Client
from visualization_msgs.msg import Marker, MarkerArray

from cloth_sim_ros.session.reader import SessionReader
from cloth_sim_ros.verify.run import verify

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
FLOOR: dict[str, Any] = {"floor.shape": "plane", "floor.position": [0.0, 0.0, -1.0]}
BALL: dict[str, Any] = {"ball.shape": "sphere", "ball.size": [0.1], "ball.position": [0.3, 0.4, 0.5]}
#: A flat cloth that lies on a block except for its border.
LYING: dict[str, Any] = {
    "cloth.orientation": [0.0, 0.0, 0.0, 1.0],
    "cloth.position": [0.0, 0.0, 0.0529],
    "cloth.anchors": [""],
    "obstacles": ["block"],
    "block.shape": "box",
    "block.size": [1.2, 1.2, 0.1],
}


@pytest.fixture
def client(ros_domain: int) -> Iterator[Client]:
    with Client() as client:
        yield client


def change(cloth: ClockedCloth, **values: Any) -> SetParametersResult:
    """Set parameters together, which `ros2 param` does one by one."""
    parameters = [Parameter(name.replace("__", "."), value=value) for name, value in values.items()]
    result: SetParametersResult = cloth.node.node.set_parameters_atomically(parameters)
    return result


def shown(client: Client, arrays: list[MarkerArray], count: int) -> MarkerArray:
    """Wait for a number of marker arrays, and return the newest."""
    client.spin_until(lambda: len(arrays) >= count, description=f"{count} marker arrays")
    return arrays[-1]


def test_obstacle_reaches_its_target_and_marker_follows(client: Client) -> None:
    arrays: list[MarkerArray] = []
    client.node.create_subscription(MarkerArray, "/cloth_sim/obstacles", arrays.append, LATCHED)
    with ClockedCloth(client, {"obstacles": ["floor", "ball"], **FLOOR, **BALL}) as cloth:
        markers = shown(client, arrays, 1).markers
        assert [(marker.ns, marker.type) for marker in markers] == [
            ("/cloth_sim/floor", Marker.CUBE),
            ("/cloth_sim/ball", Marker.SPHERE),
        ]
        assert markers[0].pose.position.z == pytest.approx(-1.001)
        assert markers[1].scale.y == pytest.approx(0.2)
        cloth.tick(2)
        cloth.target("ball", (0.35, 0.4, 0.5))
        cloth.tick()
        assert cloth.simulation.obstacles is not None
        assert cloth.simulation.obstacles.poses()[1, :3].tolist() == [0.35, 0.4, 0.5]
        assert shown(client, arrays, 2).markers[1].pose.position.x == pytest.approx(0.35)
        cloth.tick(3)
        assert len(arrays) == 2, "told again only when something moved"
        cloth.target("ball", (float("nan"), 0.4, 0.5))
        assert cloth.refused == (1, 0)


def test_obstacles_come_and_go_with_their_topics(client: Client, capfd: pytest.CaptureFixture[str]) -> None:
    arrays: list[MarkerArray] = []
    client.node.create_subscription(MarkerArray, "/cloth_sim/obstacles", arrays.append, LATCHED)
    with ClockedCloth(client, FLOOR) as cloth:
        node = cloth.node.node

        def topics() -> set[str]:
            return {name.removeprefix("/cloth_sim/") for name, _ in node.get_topic_names_and_types()}

        cloth.tick()
        assert "obstacles does not name 'floor'; it may be added" in capfd.readouterr().err
        assert not topics() & {"floor/target", "ball/target"}
        assert not [name for name, _ in node.get_publisher_names_and_types_by_node("cloth_sim", "/") if "obst" in name]
        assert change(cloth, obstacles=["floor"]).successful
        cloth.tick()
        assert [marker.ns for marker in shown(client, arrays, 1).markers] == ["/cloth_sim/floor"]
        # The shape first, or with the others; then `obstacles` may name it.
        with pytest.raises(Exception, match=r"there is no parameter 'ball.size'"):
            change(cloth, ball__size=[0.1])
        refused = change(cloth, obstacles=["floor", "ball"])
        assert "ball.shape is not set" in refused.reason
        for name, value in BALL.items():
            assert change(cloth, **{name: value}).successful
        assert node.describe_parameter("ball.size").description.startswith("box: x, y, z; sphere: radius")
        assert change(cloth, obstacles=["floor", "ball"]).successful
        cloth.tick()
        assert {"floor/target", "ball/target", "ball/wrench"} <= topics()
        cloth.target("ball", (0.3, 0.45, 0.5))
        cloth.tick()
        assert cloth.simulation.obstacles is not None
        assert cloth.simulation.obstacles.poses()[1, 1] == 0.45
        assert "can't change while 'ball' is there" in change(cloth, ball__size=[0.2]).reason
        assert change(cloth, obstacles=["ball"]).successful
        cloth.tick()
        gone = [marker for marker in shown(client, arrays, 4).markers if marker.action == Marker.DELETE]
        assert {marker.ns for marker in gone} == {"/cloth_sim/floor"}
        client.spin_until(lambda: "floor/target" not in topics(), description="the topic to be gone")


def test_target_of_removed_obstacle_is_dropped(client: Client) -> None:
    with ClockedCloth(client, {"obstacles": ["floor", "ball"], **FLOOR, **BALL}) as cloth:
        cloth.tick(2)
        cloth.target("ball", (0.3, 0.45, 0.5), stamp=cloth.now + 3 * SECOND // 60)
        assert change(cloth, obstacles=["floor"]).successful
        cloth.tick(6)
        assert cloth.simulation.scene.obstacle_names == ["floor"]
        assert not cloth.simulation.paused


def test_obstacle_overlapping_the_cloth_is_refused(client: Client) -> None:
    with ClockedCloth(client) as cloth:
        cloth.tick()
        result = change(cloth, obstacles=["ball"], **{**BALL, "ball.position": [0.5, 0.02, 0.5]})
        assert "inside obstacle 'ball': particle 41" in result.reason
        assert not cloth.node.node.has_parameter("ball.shape")
        cloth.tick()
        assert cloth.simulation.obstacles is None


def test_friction_is_described_and_changes_while_the_cloth_runs(client: Client) -> None:
    with ClockedCloth(client, LYING) as cloth:
        descriptor = cloth.node.node.describe_parameter("block.friction")
        assert descriptor.description.startswith("Coefficients of friction between it and the cloth: static (sliding")
        assert not descriptor.read_only
        assert change(cloth, block__friction=[0.3]).successful
        assert cloth.node.node.get_parameter("block.friction").value == [0.3]
        refused = change(cloth, block__friction=[0.1, 0.2])
        assert not refused.successful
        assert "friction 0.1 at rest and 0.2 in motion" in refused.reason
        assert not change(cloth, block__friction=[-0.1]).successful


def test_block_bears_the_cloth_and_publishes_wrench(client: Client) -> None:
    wrenches: list[WrenchStamped] = []
    client.node.create_subscription(WrenchStamped, "/cloth_sim/block/wrench", wrenches.append, 10)
    with ClockedCloth(client, LYING) as cloth:
        client.spin_until(lambda: client.node.count_publishers("/cloth_sim/block/wrench"), description="the wrench")
        cloth.tick(120)
        client.spin_until(lambda: wrenches, description="a wrench")
        force = wrenches[-1].wrench.force
        assert force.z == pytest.approx(-0.2 * 9.81, rel=1e-3)
        assert abs(force.x) + abs(force.y) < 1e-3
        values = cloth.node.outputs.obstacles.describe()
        assert values["contacts"] == "42"
        assert 0.002 < float(values["smallest_gap_m"]) < 0.003


def test_a_session_with_obstacles_runs_again_to_the_same_bits(client: Client, tmp_path: Path) -> None:
    record = {"record.enabled": True, "record.folder": str(tmp_path)}
    with ClockedCloth(client, {**LYING, **record, **BALL, "block.friction": [0.5, 0.4]}) as cloth:
        cloth.tick(5)
        cloth.target("block", (0.01, 0.0, 0.0))
        cloth.tick(5)
        assert change(cloth, obstacles=["ball", "block"]).successful
        cloth.tick(3)
        cloth.target("ball", (0.3, 0.4, 0.2))
        cloth.tick(10)
        assert change(cloth, block__friction=[0.2]).successful
        cloth.tick(2)
        assert change(cloth, obstacles=["ball"]).successful
        cloth.tick(10)
    (path,) = tmp_path.glob("*.mcap")
    with SessionReader(path) as session:
        markers = sum(message.topic == "/cloth_sim/obstacles" for message in session.messages())
        assert markers >= 4
    verdict = verify([path])
    assert verdict.same, verdict.first_reason
    assert verdict.frames == 35


def test_crushing_obstacle_is_stopped_with_warning(client: Client, capfd: pytest.CaptureFixture[str]) -> None:
    small = {"cloth.resolution": [4, 4], "cloth.size": [0.09, 0.09], "cloth.position": [0.0, 0.0, 0.005]}
    iron = {"iron.shape": "box", "iron.size": [0.2, 0.2, 0.02], "iron.position": [0.0, 0.0, 0.1]}
    table = {"table.shape": "plane", "obstacles": ["table", "iron"], "contact.thickness": 0.005, "tolerance": 1e-2}
    scene = {**{k: v for k, v in LYING.items() if not k.startswith("block")}, **small, **iron, **table}
    with ClockedCloth(client, scene) as cloth:
        cloth.target("iron", (0.0, 0.0, -0.1))
        cloth.tick(4)
        assert cloth.simulation.obstacles is not None
        assert cloth.simulation.obstacles.poses()[1, 2] > 0.0
        assert cloth.node.outputs.obstacles.describe()["stopped_bodies"] == "iron"
        assert "'iron' is stopped" in capfd.readouterr().err
        frame = cloth.simulation.frame
        cloth.target("iron", (0.0, 0.0, 0.1))
        cloth.tick(4)
        assert cloth.simulation.frame == frame + 4
        assert cloth.node.outputs.obstacles.describe()["stopped_bodies"] == "none"
        assert cloth.simulation.obstacles.poses()[1, 2] == pytest.approx(0.1)
        refused = change(cloth, contact__thickness=1e-300)
        assert "contact.thickness out of range Min: 1e-06" in refused.reason
