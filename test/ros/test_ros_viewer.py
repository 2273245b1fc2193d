# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `cloth_viewer` beside a node, with a Rerun recording as its output."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rcl_interfaces.msg import ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import PointCloud2
from shape_msgs.msg import Mesh
from support.ros_client import STARTED, Client
from support.rrd import rows

from cloth_sim_ros.ros.client import viewer_feed
from cloth_sim_ros.ros.client.viewer_feed import ViewerFeed
from cloth_sim_ros.ros.io.messages import CloudMessage, mesh_bytes
from cloth_sim_ros.ros.io.output import LATCHED_QOS

GRID = np.array([[0.1 * column, 0.0, 0.1 * row] for row in range(3) for column in range(4)])
TRIANGLES = np.array([[0, 1, 4], [1, 5, 4]])


class Feed:
    """A feed in this process, and its messages."""

    def __init__(self, client: Client, target: str) -> None:
        self.client = client
        self.sent: list[tuple[str, bytes]] = []
        self.feed = ViewerFeed(client.node, target, lambda topic, data: self.sent.append((topic, data)))

    def wait_for(self, topic: str, *, count: int = 1) -> bytes:
        """Wait for messages of a topic, and return the last one."""
        self.client.spin_until(lambda: self._count(topic) >= count, description=f"{count} of {topic}")
        return next(data for sent, data in reversed(self.sent) if sent == topic)

    def _count(self, topic: str) -> int:
        return sum(sent == topic for sent, _ in self.sent)


def test_viewer_follows_a_named_node_and_its_restart(
    ros_domain: int, start_process: Callable[..., Any], tmp_path: Path, wait_until: Callable[..., Any]
) -> None:
    pytest.importorskip("rerun", reason="the viewer is not installed: pip install 'cloth_sim_ros[replay]'")
    names = ["-r", "__ns:=/arm", "-r", "__node:=towel"]
    start = ["-m", "cloth_sim_ros.ros.main", "--ros-args", *names, "-p", "cloth.resolution:="]
    node = start_process([*start[:-1], f"{start[-1]}[5, 4]"])
    out = tmp_path / "out.rrd"
    viewer = start_process(["-m", "cloth_sim_ros.ros.viewer_main", "--node", "arm/towel", "--save", out])
    viewer.wait_for_output("writing")
    wait_until(lambda: out.stat().st_size > 20_000, description="clouds in the recording")
    node.kill()
    node = start_process([*start[:-1], f"{start[-1]}[3, 3]"])
    node.wait_for_output(STARTED)
    second = out.with_name("out_2.rrd")
    wait_until(lambda: second.exists() and second.stat().st_size > 20_000, description="clouds of the second start")
    assert viewer.interrupt() == 0
    assert node.interrupt() == 0
    assert "Traceback" not in viewer.output
    for path, count in ((out, 20), (second, 9)):
        times, clouds = rows(path, "/world/cloth", "Mesh3D:vertex_positions")
        assert {len(cloud) for cloud in clouds} == {count}
        assert np.all(np.diff(times) >= 0.0)
        # The sheet hangs by its upper edge.
        assert len(rows(path, "/world/anchors", "Points3D:positions")[1][0]) == {20: 4, 9: 3}[count]


def test_missing_python_or_rerun_is_named(start_process: Callable[..., Any], tmp_path: Path) -> None:
    viewer = start_process(["-m", "cloth_sim_ros.ros.viewer_main", "--python", "/nowhere/python"])
    assert viewer.wait() == 1
    assert "/nowhere/python" in viewer.output
    assert "Traceback" not in viewer.output
    broken_python = tmp_path / "python"
    broken_python.write_text("#!/bin/sh\nexit 1\n")
    broken_python.chmod(0o755)
    assert start_process(["-m", "cloth_sim_ros.ros.viewer_main", "--python", broken_python]).wait() == 1


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--every", "0"], "at least 1"),
        (["--strain-limit", "nan"], "within (0, 10000]"),
        (["--serve", "70000"], "from 1 to 65535"),
        (["--save", "session.mcap"], "session.mcap"),
        (["--save", "a.rrd", "--serve"], "not allowed"),
    ],
)
def test_wrong_options_are_refused(arguments: list[str], reason: str, start_process: Callable[..., Any]) -> None:
    viewer = start_process(["-m", "cloth_sim_ros.ros.viewer_main", *arguments])
    assert viewer.wait() != 0
    assert reason in viewer.output
    assert "Traceback" not in viewer.output


def test_killed_parent_leaves_a_finished_recording(
    ros_domain: int, start_process: Callable[..., Any], tmp_path: Path, wait_until: Callable[..., Any]
) -> None:
    pytest.importorskip("rerun", reason="the viewer is not installed: pip install 'cloth_sim_ros[replay]'")
    psutil = pytest.importorskip("psutil")
    out = tmp_path / "out.rrd"
    viewer = start_process(["-m", "cloth_sim_ros.ros.viewer_main", "--save", out])
    children = wait_until(lambda: psutil.Process(viewer.pid).children(), description="the drawing process")
    viewer.kill()
    _, alive = psutil.wait_procs(children, timeout=60.0)
    assert not alive


def test_feed_asks_nothing_of_the_node(
    ros_domain: int, start_process: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    node = start_process(["-m", "cloth_sim_ros.ros.main", "--ros-args", "-p", "cloth.resolution:=[5, 4]"])
    node.wait_for_output(STARTED)
    with Client() as client:
        feed = Feed(client, "/cloth_sim")
        feed.wait_for("/cloth_sim/points", count=3)
        topics = [topic for topic, _ in feed.sent]
        assert topics[:2] == ["/cloth_sim/topology", "parameters"]
        assert b'"gripper.mode": "attach"' in feed.sent[1][1]
        cloud = deserialize_message(feed.wait_for("/cloth_sim/points"), PointCloud2)
        assert (cloud.height, cloud.width) == (5, 4)
        feed.wait_for("/cloth_sim/gripper/state")
        feed.wait_for("/cloth_sim/clock")
        # A reliable subscription could make the node wait for a viewer that stalls.
        infos = client.node.get_subscriptions_info_by_topic("/cloth_sim/points")
        assert [info.qos_profile.reliability for info in infos] == [ReliabilityPolicy.BEST_EFFORT]
        assert not client.node.get_subscriptions_info_by_topic("/cloth_sim/mesh")
    assert node.interrupt() == 0


def test_feed_shows_a_bag_that_has_no_parameters(ros_domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viewer_feed, "_PARAMETERS_TIMEOUT", 0.2)
    with Client() as client:
        feed = Feed(client, "/cloth_sim")
        topology = client.node.create_publisher(Mesh, "/cloth_sim/topology", LATCHED_QOS)
        topology.publish(mesh_bytes(TRIANGLES, GRID))
        assert feed.wait_for("parameters") == b"{}"
        points = client.node.create_publisher(PointCloud2, "/cloth_sim/points", QoSProfile(depth=1))
        cloud = CloudMessage(frame_id="world", height=3, width=4, velocity=False, double=False)
        client.spin_until(points.get_subscription_count, description="the feed's subscription")

        def is_forwarded() -> bool:
            points.publish(cloud.serialize(GRID.T, 0))
            return any(topic == "/cloth_sim/points" for topic, _ in feed.sent)

        client.spin_until(is_forwarded, description="a cloud")


def test_feed_waits_longer_for_a_node_that_has_the_service(ros_domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viewer_feed, "_PARAMETERS_TIMEOUT", 0.2)

    def answer_late(request: GetParameters.Request, response: GetParameters.Response) -> GetParameters.Response:
        time.sleep(0.5)
        rate = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=30.0)
        response.values = [rate if name == "rate" else ParameterValue() for name in request.names]
        return response

    with Client() as client:
        name = "/cloth_sim/get_parameters"
        client.node.create_service(GetParameters, name, answer_late)
        feed = Feed(client, "/cloth_sim")
        client.spin_until(client.node.create_client(GetParameters, name).service_is_ready, description="the service")
        topology = client.node.create_publisher(Mesh, "/cloth_sim/topology", LATCHED_QOS)
        topology.publish(mesh_bytes(TRIANGLES, GRID))
        assert feed.wait_for("parameters") == b'{"rate": 30.0}'


def test_wrong_name_lists_the_cloths(
    ros_domain: int, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(viewer_feed, "_SILENCE", 0.2)
    with Client() as client:
        topology = client.node.create_publisher(Mesh, "/arm/towel/topology", LATCHED_QOS)
        points = client.node.create_publisher(PointCloud2, "/arm/towel/points", QoSProfile(depth=1))
        Feed(client, "/cloth_sim")
        output: list[str] = []

        def warned() -> bool:
            output.append(capfd.readouterr().err)
            return "nothing has come on /cloth_sim/topology" in "".join(output)

        client.spin_until(warned, description="the warning")
        assert "there are /arm/towel (--node)" in "".join(output)
        del topology, points


def test_stop_signal_ends_the_viewer_before_a_node_exists(
    ros_domain: int, start_process: Callable[..., Any], tmp_path: Path
) -> None:
    pytest.importorskip("rerun", reason="the viewer is not installed: pip install 'cloth_sim_ros[replay]'")
    for signum in (signal.SIGINT, signal.SIGTERM):
        viewer = start_process([sys.executable, "-m", "cloth_sim_ros.ros.viewer_main", "--save", tmp_path / "out.rrd"])
        viewer.wait_for_output("waiting for /cloth_sim")
        viewer.send_signal(signum)
        assert viewer.wait() == 0
        assert "Traceback" not in viewer.output
