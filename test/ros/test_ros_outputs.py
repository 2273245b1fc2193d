# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Outputs besides the cloud: surface marker for RViz, latched topology, and profiles."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PointStamped, PoseStamped, WrenchStamped
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2
from shape_msgs.msg import Mesh
from std_msgs.msg import Bool
from support.clocked_cloth import ClockedCloth
from support.ros_client import Client, positions, stamp_of
from visualization_msgs.msg import Marker

from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.session import old_keys

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
OBJ = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 2 0 0\nf 1 2 3\nf 1 3 4\nf 2 5 3\n"


@pytest.fixture
def client(ros_domain: int) -> Iterator[Client]:
    with Client() as client:
        yield client


def profile(client: Client, topic: str) -> Any:
    """Return the profile that the publisher of a topic offers in the graph."""
    publishers = client.spin_until(
        lambda: client.node.get_publishers_info_by_topic(topic), description=f"a publisher of {topic}"
    )
    (info,) = publishers
    return info.qos_profile


def publisher(cloth: ClockedCloth, topic: str) -> Any:
    """Return the cloth's publisher of a topic."""
    return next(entry for entry in cloth.node.node.publishers if entry.topic_name == topic)


def test_surface_marker_is_built_for_subscribers_only(client: Client) -> None:
    with ClockedCloth(client, {"frame_id": "map"}) as cloth:
        marker = cloth.node.outputs.cloth.marker
        stamps, make = [], marker.serialize
        marker.serialize = lambda x, stamp: stamps.append(stamp) or make(x, stamp)
        clouds: list[PointCloud2] = []
        client.node.create_subscription(PointCloud2, "/cloth_sim/points", clouds.append, 100)
        client.spin_until(
            lambda: cloth.node.outputs.cloth.points.has_subscribers, description="the subscriber of points"
        )
        cloth.tick(5)
        assert stamps == [], "nobody looks"
        markers: list[Marker] = []
        looking = client.node.create_subscription(Marker, "/cloth_sim/mesh", markers.append, 100)
        client.spin_until(lambda: cloth.node.outputs.cloth.mesh.has_subscribers, description="the subscriber of mesh")
        cloth.tick(3)
        client.spin_until(lambda: len(markers) == 3 and len(clouds) >= 8, description="three markers")
        triangles = cloth.simulation.scene.sheet.triangles()
        for message, cloud in zip(markers, clouds[-3:], strict=True):
            assert (message.type, message.action) == (Marker.TRIANGLE_LIST, Marker.ADD)
            assert message.header.frame_id == "map"
            assert message.header.stamp == cloud.header.stamp
            # RViz takes the corners in threes: unit scale, no rotation, no offset, no lifetime.
            assert (message.scale.x, message.scale.y, message.scale.z) == (1.0, 1.0, 1.0)
            assert (message.pose.position.x, message.pose.orientation.w) == (0.0, 1.0)
            assert (message.lifetime.sec, message.lifetime.nanosec) == (0, 0)
            corners = np.array([(p.x, p.y, p.z) for p in message.points])
            np.testing.assert_array_equal(corners.astype(np.float32), positions(cloud)[triangles.ravel()])
        # One surface per node, which each new one replaces.
        assert {(message.ns, message.id) for message in markers} == {("/cloth_sim", 0)}
        client.node.destroy_subscription(looking)
        client.spin_until(lambda: not cloth.node.outputs.cloth.mesh.has_subscribers, description="the subscriber gone")
        count = len(stamps)
        cloth.tick(3)
        assert len(stamps) == count


def test_late_subscriber_receives_topology(client: Client) -> None:
    with ClockedCloth(client) as cloth:
        cloth.tick(50)
        late: list[Mesh] = []
        client.node.create_subscription(Mesh, "/cloth_sim/topology", late.append, LATCHED)
        client.spin_until(lambda: late, description="the topology")
        triangles = [list(triangle.vertex_indices) for triangle in late[0].triangles]
        assert triangles == cloth.simulation.scene.sheet.triangles().tolist()
        rest_positions = np.array([(v.x, v.y, v.z) for v in late[0].vertices])
        np.testing.assert_array_equal(rest_positions, cloth.simulation.scene.sheet.positions())
        cloth.tick(5)
        assert len(late) == 1, "said once"


def test_a_mesh_is_published_in_its_own_order(client: Client, tmp_path: Path) -> None:
    pytest.importorskip("trimesh")
    (tmp_path / "cloth.obj").write_text(OBJ)
    parameters = {"cloth.mesh": str(tmp_path / "cloth.obj"), "bending.model": "none", "cloth.anchors": ["0", "4"]}
    with ClockedCloth(client, parameters) as cloth:
        clouds: list[PointCloud2] = []
        meshes: list[Mesh] = []
        client.node.create_subscription(PointCloud2, "/cloth_sim/points", clouds.append, 10)
        client.node.create_subscription(Mesh, "/cloth_sim/topology", meshes.append, LATCHED)
        client.spin_until(
            lambda: cloth.node.outputs.cloth.points.has_subscribers and meshes, description="the topology of a mesh"
        )
        cloth.tick()
        client.spin_until(lambda: clouds, description="a cloud of a mesh")
        assert (clouds[0].height, clouds[0].width) == (1, 5)
        np.testing.assert_array_equal(positions(clouds[0]), cloth.simulation.positions.astype(np.float32))
        assert [list(triangle.vertex_indices) for triangle in meshes[0].triangles] == [[0, 1, 2], [0, 2, 3], [1, 4, 2]]
        assert (meshes[0].vertices[4].x, meshes[0].vertices[4].y) == (2.0, 0.0)


def test_profiles_are_reliable_and_overridable_one_by_one(client: Client) -> None:
    points = "qos_overrides./cloth_sim/points.publisher"
    with ClockedCloth(client, {f"{points}.reliability": "best_effort", f"{points}.depth": 3}) as cloth:
        assert profile(client, "/cloth_sim/points").reliability == ReliabilityPolicy.BEST_EFFORT
        assert publisher(cloth, "/cloth_sim/points").qos_profile.depth == 3
        for topic in ("mesh", "topology", "gripper/wrench"):
            assert profile(client, f"/cloth_sim/{topic}").reliability == ReliabilityPolicy.RELIABLE, topic
        assert profile(client, "/diagnostics").reliability == ReliabilityPolicy.RELIABLE
        assert profile(client, "/cloth_sim/topology").durability == DurabilityPolicy.TRANSIENT_LOCAL
        # A best-effort subscriber receives messages; a reliable one does not, as the override requires.
        best, all_of_them = [], []
        effort = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
        client.node.create_subscription(PointCloud2, "/cloth_sim/points", best.append, effort)
        client.node.create_subscription(PointCloud2, "/cloth_sim/points", all_of_them.append, 10)
        client.spin_until(lambda: cloth.node.outputs.cloth.points.has_subscribers, description="a subscriber")
        cloth.tick(3)
        client.spin_until(lambda: best, description="a cloud by best effort")
        assert all_of_them == []
    # The next cloth in this process has the defaults.
    with ClockedCloth(client, name="other"):
        assert profile(client, "/other/points").reliability == ReliabilityPolicy.RELIABLE


@pytest.mark.parametrize(
    ("policy", "value"),
    [
        ("reliability", "sometimes"),
        ("reliability", 1),
        ("history", "none"),
        ("depth", "many"),
        ("depth", True),
        ("depth", -1),
        ("depth", 2**31),
    ],
)
def test_a_senseless_profile_is_refused(client: Client, policy: str, value: Any) -> None:
    name = f"qos_overrides./cloth_sim/points.publisher.{policy}"
    right = {
        "reliability": "system_default, reliable, best_effort or best_available",
        "history": "system_default, keep_last or keep_all",
        "depth": "a whole number from 0 to 2147483647",
    }
    words = re.escape(f"{name} is {value!r}; it must be {right[policy]}")
    with pytest.raises(ParameterError, match=words), ClockedCloth(client, {name: value}):
        pass


def test_frames_of_one_stamp_belong_together(client: Client) -> None:
    with ClockedCloth(client) as cloth:
        clouds: list[PointCloud2] = []
        wrenches: list[WrenchStamped] = []
        client.node.create_subscription(PointCloud2, "/cloth_sim/points", clouds.append, 100)
        client.node.create_subscription(WrenchStamped, "/cloth_sim/gripper/wrench", wrenches.append, 100)
        outputs = cloth.node.outputs.cloth
        client.spin_until(
            lambda: outputs.points.has_subscribers and outputs.wrenches[0].has_subscribers,
            description="both subscribers",
        )
        cloth.tick(10)
        client.spin_until(lambda: len(clouds) >= 10 and len(wrenches) >= 10, description="ten of each")
        assert [stamp_of(cloud) for cloud in clouds] == [stamp_of(wrench) for wrench in wrenches]


def test_diagnostics_keys_match_the_docs(client: Client) -> None:
    page = (Path(__file__).resolve().parents[2] / "docs" / "node" / "diagnostics.md").read_text()
    # test_ros_accuracy.py tests the entries of the accuracy monitor.
    section = page.split("## Entries\n")[1].split("\n## ")[0]
    cells = [line.split("|") for line in section.splitlines() if line.startswith("| `")]
    documented = {name for cell in cells for name in re.findall(r"`(\w+)`", cell[1])}
    documented |= set(re.findall(r"`(energy_\w+)`", section))
    # test_ros_ensemble.py tests the entries of the ensemble.
    documented -= {"ensemble"}
    with ClockedCloth(client, {"diagnostics.energy": True, "tolerance": 1e-4, "cameras": ["wrist"]}) as cloth:
        seen: list[DiagnosticStatus] = []
        client.node.create_subscription(
            DiagnosticArray, "/diagnostics", lambda message: seen.extend(message.status), 10
        )
        client.spin_until(
            lambda: publisher(cloth, "/diagnostics").get_subscription_count(),
            description="the subscriber of diagnostics",
        )
        cloth.target("gripper", (0.5, 0.0, 0.5))
        cloth.tick(30)
        seen.clear()
        cloth.node.reporting.diagnostics.send()
        status = client.spin_until(lambda: seen and seen[0], description="diagnostics")
        values = {entry.key: entry.value for entry in status.values}
        assert status.name == "cloth_sim: cloth"
        # Entries of a recording and of contact exist only with a recording or contact.
        contact = {"contacts", "smallest_gap_m", "self_contacts", "self_smallest_gap_m", "stopped_bodies"}
        contact |= {"energy_friction_j", "energy_recovered_j", "energy_air_j"}
        present = [(old, current) for old, current in old_keys.DIAGNOSTICS.items() if current in values]
        assert ("integrator_why", "integrator_reason") in present
        assert [values.pop(old) for old, _ in present] == [values[current] for _, current in present]
        assert set(values) == documented - {"recording_file", "recording_dropped"} - contact
        assert (values["frame"], values["paused"], values["recording"]) == ("30", "false", "off")
        assert (values["commands_received"], values["commands_refused"]) == ("1", "0")
        # It hangs and is stretched by its weight: its energy comes from its height, and the balance closes.
        turned_over = 0.2 * 9.81 * (0.5 - float(cloth.simulation.positions[:, 2].mean() - 0.5))
        assert abs(float(values["energy_balance_j"])) < 1e-3 * max(turned_over, 1e-2)
        assert float(values["energy_dissipated_j"]) > 0.0


def test_strain_is_measured_for_subscribers_only(client: Client) -> None:
    with ClockedCloth(client, {"cloth.resolution": [6, 6], "cloth.size": [1.0, 2.0]}) as cloth:
        gauge = cloth.node.reporting.collector.gauge
        x = cloth.simulation.state.x.copy()
        assert gauge.largest(x) == pytest.approx(0.0, abs=1e-12)
        away = np.linalg.norm(x[:, 1] - x[:, 0])
        x[:, 0] = x[:, 1] + 1.5 * (x[:, 0] - x[:, 1])
        assert away > 0.0
        assert gauge.largest(x) == pytest.approx(0.5)
        measured: list[bool] = []
        cloth.node.reporting.collector.gauge.largest = lambda x: measured.append(True)
        cloth.node.reporting.diagnostics.send()
        assert not measured
        client.node.create_subscription(DiagnosticArray, "/diagnostics", lambda message: None, 10)
        client.spin_until(
            lambda: publisher(cloth, "/diagnostics").get_subscription_count(),
            description="the subscriber of diagnostics",
        )
        cloth.node.reporting.diagnostics.send()
        assert measured


def test_targets_take_any_publisher_and_grasps_reliable_ones(client: Client) -> None:
    profiles = {
        policy: QoSProfile(depth=10, reliability=policy)
        for policy in (ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT)
    }
    with ClockedCloth(client):
        for policy, profile in profiles.items():
            for kind, leaf in ((PoseStamped, "target"), (PointStamped, "point")):
                publisher = client.node.create_publisher(kind, f"/cloth_sim/gripper/{leaf}", profile)
                client.spin_until(publisher.get_subscription_count, description=f"{leaf} of a {policy.name} publisher")
        sure = client.node.create_publisher(Bool, "/cloth_sim/gripper/grasp", profiles[ReliabilityPolicy.RELIABLE])
        unsure = client.node.create_publisher(Bool, "/cloth_sim/gripper/grasp", profiles[ReliabilityPolicy.BEST_EFFORT])
        client.spin_until(sure.get_subscription_count, description="grasp of a reliable publisher")
        assert unsure.get_subscription_count() == 0, "a grasp that may get lost is none"
