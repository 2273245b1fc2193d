# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Ground truth of a live node: normals and ids in the cloud, keypoints, covered area."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseArray
from rclpy.parameter import Parameter
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float64
from support.clocked_cloth import ClockedCloth
from support.ros_client import Client, pose

from cloth_sim_ros.physics.plan.gripper_path import rotation_matrix
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.verify.run import verify

NODE = "/cloth_sim"
FLAT = {"cloth.orientation": [0.0, 0.0, 0.0, 1.0], "gravity": [0.0, 0.0, 0.0]}
TABLE = {
    "obstacles": ["table"],
    "table.shape": "box",
    "table.size": [0.5, 0.4, 0.02],
    "table.position": [0.0, 0.0, 0.5],
    "coverage.obstacle": "table",
}


@pytest.fixture
def client(ros_domain: int) -> Iterator[Client]:
    with Client() as client:
        yield client


def structured(cloud: PointCloud2) -> np.ndarray:
    """Return the points of a cloud with named fields."""
    kinds = {6: "<u4", 7: "<f4", 8: "<f8"}
    names = [(field.name, kinds[field.datatype]) for field in cloud.fields]
    return np.frombuffer(bytes(cloud.data), names)


def test_normals_and_ids_come_and_go_on_request(client: Client, tmp_path: Path) -> None:
    recording = {"record.enabled": True, "record.folder": str(tmp_path), "record.least_free_space": 0}
    with ClockedCloth(client, {**FLAT, **recording, "points.normal": True, "points.id": True}) as cloth:
        client.node.create_subscription(PointCloud2, f"{NODE}/points", client.clouds.append, 100)
        client.spin_until(lambda: cloth.node.outputs.cloth.points.has_subscribers, description="a subscriber")
        cloth.tick(2)
        client.spin_until(lambda: len(client.clouds) == 2, description="two clouds")
        points = structured(client.clouds[-1])
        assert points.dtype.names == ("x", "y", "z", "normal_x", "normal_y", "normal_z", "id")
        assert points["id"].tolist() == list(range(42))
        assert (points["normal_z"] == -1.0).all()
        assert not (points["normal_x"].any() or points["normal_y"].any())
        cloth.node.node.set_parameters_atomically([Parameter("points.normal", value=False)])
        cloth.tick(2)
        client.spin_until(lambda: len(client.clouds) == 4, description="four clouds")
        assert structured(client.clouds[-1]).dtype.names == ("x", "y", "z", "id")
        cloth.node.close(timeout=10.0)
    (path,) = tmp_path.glob("*.mcap")
    verdict = verify([path])
    assert (verdict.same, verdict.clouds) == (True, 4), verdict.first_reason


def test_changed_normal_in_a_session_is_found(client: Client, tmp_path: Path) -> None:
    recording = {"record.enabled": True, "record.folder": str(tmp_path), "record.least_free_space": 0}
    with ClockedCloth(client, {**recording, "points.normal": True, "record.compression": "none"}) as cloth:
        cloth.tick(3)
        points = cloth.node.outputs.cloth
        send = points.points.send
        points.points.send = lambda data, stamp: send(data[:-5] + bytes([data[-5] ^ 1]) + data[-4:], stamp)
        cloth.tick(1)
        cloth.node.close(timeout=10.0)
    (path,) = tmp_path.glob("*.mcap")
    verdict = verify([path])
    assert (verdict.first_frame, verdict.first_reason) == (4, "its cloud, by the normals")


def test_keypoints_are_computed_for_subscribers_only(client: Client) -> None:
    with ClockedCloth(client, {"keypoints": ["corners", "middle=24"], "frame_id": "map"}) as cloth:
        (topic,) = cloth.node.outputs.ground_truth
        computed: list[Any] = []
        compute = topic.poses.compute
        topic.poses.compute = lambda x: computed.append(x) or compute(x)
        cloth.tick(3)
        assert computed == []
        received: list[PoseArray] = []
        client.node.create_subscription(PoseArray, f"{NODE}/keypoints", received.append, 10)
        client.spin_until(lambda: topic.output.has_subscribers, description="the subscriber")
        cloth.tick(2)
        client.spin_until(lambda: len(received) == 2, description="two messages")
        message, x = received[-1], cloth.simulation.positions
    assert len(computed) == 2
    assert message.header.frame_id == "map"
    positions = [(entry.position.x, entry.position.y, entry.position.z) for entry in message.poses]
    assert np.array_equal(positions, x[[0, 6, 41, 35, 24]])
    q = message.poses[0].orientation
    axes = rotation_matrix(np.array([q.x, q.y, q.z, q.w]))
    # It hangs: its rows are level.
    assert axes[:, 0] == pytest.approx([1.0, 0.0, 0.0], abs=1e-6)


def test_coverage_follows_the_moving_table(client: Client) -> None:
    parameters = {**FLAT, **TABLE, "cloth.anchors": ["top", "bottom"], "cloth.position": [0.0, 0.0, 1.0]}
    with ClockedCloth(client, parameters) as cloth:
        (topic,) = cloth.node.outputs.ground_truth
        received: list[Float64] = []
        client.node.create_subscription(Float64, f"{NODE}/coverage", received.append, 10)
        client.spin_until(lambda: topic.output.has_subscribers, description="the subscriber")
        cloth.tick(1)
        client.spin_until(lambda: received, description="the covered area")
        assert received[-1].data == pytest.approx(0.5 * 0.4, abs=1e-9)
        # Half of the table leaves the cloth, whose edge is at x = 0.5 m.
        cloth.send("table/target", pose(0.5, 0.0, 0.5))
        cloth.tick(20)
        client.spin_until(lambda: len(received) == 21, description="the covered area at the end")
        assert received[-1].data == pytest.approx(0.25 * 0.4, abs=1e-9)
        assert received[-1].data < received[2].data


def test_plane_of_coverage_needs_no_contact(client: Client) -> None:
    parameters = {**FLAT, **TABLE, "obstacles": [""]}
    with ClockedCloth(client, parameters) as cloth:
        (topic,) = cloth.node.outputs.ground_truth
        assert cloth.simulation.obstacles is None
        received: list[Float64] = []
        client.node.create_subscription(Float64, f"{NODE}/coverage", received.append, 10)
        client.spin_until(lambda: topic.output.has_subscribers, description="the subscriber")
        cloth.tick(1)
        client.spin_until(lambda: received, description="the covered area")
        assert received[-1].data == pytest.approx(0.5 * 0.4, abs=1e-9)
        cloth.node.node.set_parameters_atomically([Parameter("table.size", value=[0.2, 0.1, 0.02])])
        cloth.tick(2)
        client.spin_until(lambda: len(received) == 3, description="the area of a smaller table")
        assert received[-1].data == pytest.approx(0.2 * 0.1, abs=1e-9)


def test_wrong_size_of_the_plane_of_coverage_is_refused(client: Client, capfd: pytest.CaptureFixture[str]) -> None:
    with ClockedCloth(client, {**FLAT, **TABLE, "obstacles": [""]}) as cloth:
        assert "no effect" not in capfd.readouterr().err
        result = cloth.node.node.set_parameters_atomically([Parameter("table.size", value=[0.1])])
        assert result.reason == "obstacle 'table' has 1 sizes, [0.1]; a box has 3: x, y, z"
        cloth.tick()


def test_node_without_parameters_has_no_ground_truth(client: Client) -> None:
    with ClockedCloth(client) as cloth:
        assert cloth.node.outputs.ground_truth == []
        names = {entry.topic_name for entry in cloth.node.node.publishers}
        assert not names & {f"{NODE}/keypoints", f"{NODE}/coverage"}


def test_quality_of_service_of_ground_truth_is_overridden(client: Client) -> None:
    override = {f"qos_overrides.{NODE}/keypoints.publisher.reliability": "best_effort"}
    with ClockedCloth(client, {"keypoints": ["0"], **override}):
        (info,) = client.spin_until(
            lambda: client.node.get_publishers_info_by_topic(f"{NODE}/keypoints"), description="the publisher"
        )
        assert info.qos_profile.reliability.name == "BEST_EFFORT"


@pytest.mark.parametrize(
    ("parameters", "message"),
    [({"keypoints": ["99"]}, "keypoints names particle 99"), ({"coverage.obstacle": "t"}, "t.shape is not set")],
)
def test_node_refuses_wrong_ground_truth(client: Client, parameters: dict[str, Any], message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        ClockedCloth(client, parameters)
