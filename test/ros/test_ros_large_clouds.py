# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The Fast DDS profile for large clouds: read without errors, with a segment of the given size."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2
from support.ros_client import Client, start_cloth

from cloth_sim_ros.ros.io.transports import segment_bytes

PROFILE = Path(__file__).resolve().parents[2] / "config" / "fastdds_large_clouds.xml"
VARIABLE = "FASTRTPS_DEFAULT_PROFILES_FILE"
SEGMENT = 16 << 20


def largest_segment(pid: int) -> int:
    """Size of the largest shared-memory segment of Fast DDS that a process has mapped [bytes]."""
    sizes = [0]
    for line in Path(f"/proc/{pid}/maps").read_text().splitlines():
        span, *_, name = line.split(maxsplit=5)
        if "/fastrtps_" in name:
            begin, end = (int(address, 16) for address in span.split("-"))
            sizes.append(end - begin)
    return max(sizes)


@pytest.mark.skipif(os.environ.get("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp") != "rmw_fastrtps_cpp", reason="Fast DDS's")
def test_clouds_come_with_the_profile_and_without(ros_domain: int, start_process: Callable[..., Any]) -> None:
    node = ["cloth.resolution:=[60, 60]", "material.stretch_modulus:=10.0", "material.shear_modulus:=1.0"]
    node += ["bending.model:=none", "rate:=30.0"]
    received = {}
    for profile in ("", str(PROFILE)):
        process = start_cloth(start_process, *node, env={VARIABLE: profile} if profile else {})
        with Client() as client:
            effort = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
            client.node.create_subscription(PointCloud2, "/cloth_sim/points", client.clouds.append, effort)
            assert len(client.wait_for_clouds(3).data) == 60 * 60 * 12
            received[profile] = largest_segment(process.pid)
        assert process.interrupt() == 0
        assert "XML" not in process.output, process.output
    # The node's own choice, unless the user has a profile.
    needed = segment_bytes({"cloth.resolution": [60, 60], "rate": 30.0})
    assert needed <= received[""] < needed + (2 << 20)
    assert SEGMENT <= received[str(PROFILE)] < SEGMENT + (2 << 20)


def test_the_profile_says_what_is_tested() -> None:
    names = {"d": "http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"}
    root = ElementTree.parse(PROFILE).getroot()
    sizes = [element.text for element in root.iterfind(".//d:segment_size", names)]
    assert sizes == [str(SEGMENT)]
    # A larger message is split; the limit must not exceed the segment.
    assert [element.text for element in root.iterfind(".//d:maxMessageSize", names)] == [str(SEGMENT)]
