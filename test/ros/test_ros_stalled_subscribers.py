# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Subscribers that are suspended, killed, or restarted: all others receive the published messages."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import PointCloud2
from support.line_log import LineLog
from support.ros_client import Client, stamp_of, start_cloth
from visualization_msgs.msg import Marker

from cloth_sim_ros.ros.io.output import Output
from cloth_sim_ros.session.reader import SessionReader

SUBSCRIBER = Path(__file__).resolve().parents[1] / "support" / "stalling_subscriber.py"
#: Clouds that may be in transit at the first or the last check.
MIN_CLOUDS = 5
pytestmark = pytest.mark.skipif(
    os.environ.get("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp") != "rmw_fastrtps_cpp", reason="Fast DDS's shared memory"
)


class Stalled:
    """Subscribers in processes of their own, which have received clouds."""

    def __init__(self, start_process: Callable[..., Any], efforts: str, *topics: str) -> None:
        self.processes = [start_process([sys.executable, SUBSCRIBER, effort, *topics]) for effort in efforts]
        for process in self.processes:
            process.wait_for_output("receives")

    def send_signal(self, signal_number: int) -> None:
        """Send a signal to each."""
        for process in self.processes:
            process.send_signal(signal_number)


def start_recording_cloth(start_process: Callable[..., Any], cells: int, folder: Path) -> Any:
    """Start a node whose frames take little time, and that records what it publishes."""
    soft = ["material.stretch_modulus:=10.0", "material.shear_modulus:=1.0", "bending.model:=none"]
    recorded = ["record.enabled:=true", f"record.folder:={folder}"]
    return start_cloth(
        start_process, f"cloth.resolution:=[{cells}, {cells}]", *soft, "gravity:=[0.0, 0.0, 0.0]", *recorded
    )


def check_received(node: Any, client: Client, folder: Path) -> None:
    """End the node, and compare received and published clouds."""
    received = {stamp_of(cloud) for cloud in client.clouds}
    assert node.interrupt() == 0, node.output
    (session,) = folder.glob("*.mcap")
    with SessionReader(session) as reader:
        published = {message.publish_time for message in reader.messages(["/cloth_sim/points"])}
    missed = {stamp for stamp in published - received if min(received) < stamp < max(received)}
    assert len(missed) <= MIN_CLOUDS, f"{len(missed)} of {len(published)} clouds were not received"


@pytest.mark.parametrize(("cells", "efforts"), [(64, "r"), (64, "rrbrb"), (128, "rbr")])
def test_suspended_subscribers_leave_others_their_clouds(
    ros_domain: int, start_process: Callable[..., Any], tmp_path: Path, cells: int, efforts: str
) -> None:
    node = start_recording_cloth(start_process, cells, tmp_path)
    with Client() as client:
        client.watch()
        stalled = Stalled(start_process, efforts, "/cloth_sim/points")
        stalled.send_signal(signal.SIGSTOP)
        # Far more than Fast DDS's default segment holds, and longer than its lease of a subscriber.
        client.wait_for_clouds(60 * 4)
        stalled.send_signal(signal.SIGCONT)
        client.wait_for_clouds(30)
        check_received(node, client, tmp_path)


def test_suspended_subscriber_leaves_small_topics(
    ros_domain: int, start_process: Callable[..., Any], tmp_path: Path
) -> None:
    node = start_recording_cloth(start_process, 64, tmp_path)
    with Client() as client:
        wrenches: list[Any] = []
        health: list[Any] = []
        client.node.create_subscription(
            WrenchStamped, "/cloth_sim/gripper/wrench", wrenches.append, QoSProfile(depth=9)
        )
        client.node.create_subscription(DiagnosticArray, "/diagnostics", health.append, QoSProfile(depth=9))
        client.watch()
        stalled = Stalled(start_process, "r", "/cloth_sim/points", "/cloth_sim/gripper/wrench", "/diagnostics")
        stalled.send_signal(signal.SIGSTOP)
        client.wait_for_clouds(60)
        wrenches.clear()
        health.clear()
        client.wait_for_clouds(60)
        client.spin_until(lambda: health and wrenches, description="diagnostics and wrenches")
        stalled.send_signal(signal.SIGKILL)
        check_received(node, client, tmp_path)


def test_subscribers_killed_or_suspended_leave_others_clouds(
    ros_domain: int, start_process: Callable[..., Any], tmp_path: Path
) -> None:
    node = start_recording_cloth(start_process, 64, tmp_path)
    with Client() as client:
        client.watch()
        for end in (signal.SIGKILL, signal.SIGCONT):
            stalled = Stalled(start_process, "rb", "/cloth_sim/points")
            stalled.send_signal(signal.SIGSTOP)
            client.wait_for_clouds(60)
            stalled.send_signal(end)
            client.wait_for_clouds(30)
            stalled.send_signal(signal.SIGKILL)
        client.wait_for_clouds(60)
        check_received(node, client, tmp_path)


def test_suspended_rviz_leaves_others_clouds_and_meshes(
    ros_domain: int, start_process: Callable[..., Any], tmp_path: Path
) -> None:
    node = start_recording_cloth(start_process, 48, tmp_path)
    with Client() as client:
        meshes: list[Any] = []
        client.node.create_subscription(Marker, "/cloth_sim/mesh", meshes.append, QoSProfile(depth=5), raw=True)
        client.watch()
        stalled = Stalled(start_process, "rr", "/cloth_sim/points", "/cloth_sim/mesh")
        stalled.send_signal(signal.SIGSTOP)
        client.wait_for_clouds(60 * 2)
        meshes.clear()
        client.spin_until(lambda: len(meshes) > 30, description="30 meshes")
        stalled.send_signal(signal.SIGKILL)
        check_received(node, client, tmp_path)


class Recorded:
    """A record sink that does not run."""

    running = False

    def add(self, *_: Any, **__: Any) -> None:
        """Record nothing."""


class SlowNode(Node):
    """A node with a slow middleware."""

    seconds = 0.0

    def create_publisher(self, *arguments: Any, **options: Any) -> Any:
        """Create rclpy's publisher with a delay in `publish`."""
        publisher = super().create_publisher(*arguments, **options)
        publish = publisher.publish

        def delayed(data: bytes) -> None:
            time.sleep(self.seconds)
            publish(data)

        publisher.publish = delayed
        return publisher


def test_long_publication_is_warned_of_once(monkeypatch: pytest.MonkeyPatch, ros_domain: int) -> None:
    with Client() as client:
        node = SlowNode("slow", context=client.context)
        log = LineLog()
        monkeypatch.setattr(node, "get_logger", lambda: log)
        output = Output(node, PointCloud2, "~/points", Recorded())
        output.publish(b"\x00\x01\x00\x00")
        assert not log.lines
        node.seconds = 0.55
        for _ in range(2):
            output.publish(b"\x00\x01\x00\x00")
        (line,) = log.lines
        assert "/slow/points: publishing took 0.5" in str(line)
        assert "suspended" in str(line)
        node.destroy_node()
