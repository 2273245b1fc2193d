# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Velocities in the cloud, switched while the cloth runs; the recording replays with and without them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from sensor_msgs.msg import PointCloud2
from support.ros_client import Client, start_cloth


def fields(cloud: PointCloud2) -> list[str]:
    return [field.name for field in cloud.fields]


def test_velocities_come_and_go_on_request(ros_domain: int, start_process: Callable[..., Any], tmp_path: Path) -> None:
    pytest.importorskip("mcap")
    from cloth_sim_ros.verify.run import verify

    process = start_cloth(
        start_process,
        "points.velocity:=true",
        "tolerance:=1.0e-5",  # single precision would not keep it flat to 1e-6 m/s
        "cloth.resolution:=[6, 6]",
        "cloth.anchors:=['']",
        "record.enabled:=true",
        f"record.folder:={tmp_path}",
    )
    with Client() as client:
        client.watch()
        first = client.clouds[0]
        assert fields(first) == ["x", "y", "z", "vx", "vy", "vz"]
        assert (first.point_step, first.row_step, len(first.data)) == (24, 144, 864)
        velocity = np.frombuffer(bytes(first.data), "<f4").reshape(-1, 6)[:, 3:]
        # It falls freely, against the air.
        assert (velocity[:, 2] < 0.0).all()
        assert np.ptp(velocity[:, 2]) < 1e-6
        request = SetParameters.Request(parameters=[Parameter("points.velocity", value=False).to_parameter_msg()])
        assert client.call(SetParameters, "/cloth_sim/set_parameters", request).results[0].successful
        client.spin_until(
            lambda: fields(client.clouds[-1]) == ["x", "y", "z"], description="a cloud of positions alone"
        )
        client.wait_for_clouds(3)
    assert process.interrupt() == 0
    (path,) = tmp_path.glob("*.mcap")
    verdict = verify([path])
    assert verdict.same, verdict.first_reason
    assert verdict.clouds > 3
