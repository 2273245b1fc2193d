# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The node and `--check` on mesh files: merges, sizes, and clouds in double precision."""

from __future__ import annotations

from math import cos, pi, sin
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy")
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from sensor_msgs.msg import PointCloud2, PointField
from support.clocked_cloth import ClockedCloth
from support.ros_client import Client

from cloth_sim_ros.ros.main import main as cloth_sim

AROUND, ALONG = 12, 4
#: Magnitude of map coordinates [m].
DISTANCE = 400_000.0


def tube(x: float) -> str:
    """Return OBJ text of a tube about a line at x [m]; its last column equals the first except for sin(2 pi)."""
    angles = [2.0 * pi * k / AROUND for k in range(AROUND + 1)]
    lines = [f"v {x + 0.3 * cos(a)!r} {0.3 * sin(a)!r} {0.15 * row!r}" for row in range(ALONG) for a in angles]
    width = AROUND + 1
    for row in range(ALONG - 1):
        for k in range(row * width + 1, row * width + AROUND + 1):
            lines += [f"f {k} {k + 1} {k + 1 + width} {k + width}"]
    return "\n".join(lines)


def doubles(cloud: PointCloud2) -> bool:
    return {field.datatype for field in cloud.fields} == {PointField.FLOAT64}


def test_check_prints_merges_and_sizes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "tube.obj").write_text(tube(DISTANCE))
    path = tmp_path / "tube.yaml"
    path.write_text(
        "/**:\n  ros__parameters:\n    cloth: {mesh: "
        + str(tmp_path / "tube.obj")
        + ", anchors: ['0']}\n    bending: {model: none}\n    gravity: [0.0, 0.0, 0.0]\n"
    )
    assert cloth_sim(["--check", str(path)]) == 0
    printed = capsys.readouterr()
    assert f"tube.obj': {ALONG} vertices closer than" in printed.out
    assert "extent 0.96 m, mass 0.168 kg, clouds resolve 0.031 m\n" in printed.out
    assert "warning: clouds resolve 0.031 m at 4e+05 m from the origin of 'world', coarser than the" in printed.out
    assert printed.err == ""


def test_double_clouds_come_on_request(ros_domain: int, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("mcap")
    from cloth_sim_ros.verify.run import verify

    (tmp_path / "tube.obj").write_text(tube(DISTANCE))
    parameters = {
        "cloth.mesh": str(tmp_path / "tube.obj"),
        "cloth.position": [0.0, 0.0, 0.0],
        "cloth.orientation": [0.0, 0.0, 0.0, 1.0],
        "cloth.anchors": ["0", "1", "2"],
        "bending.model": "none",
        "record.enabled": True,
        "record.folder": str(tmp_path),
    }
    with Client() as client, ClockedCloth(client, parameters) as cloth:
        client.node.create_subscription(PointCloud2, "/cloth_sim/points", client.clouds.append, 100)
        client.spin_until(lambda: cloth.tick() or client.clouds, description="the first cloud")
        assert not doubles(client.clouds[-1])
        request = SetParameters.Request(parameters=[Parameter("points.double", value=True).to_parameter_msg()])
        assert client.call(SetParameters, "/cloth_sim/set_parameters", request).results[0].successful
        cloth.tick(4)
        client.spin_until(lambda: doubles(client.clouds[-1]), description="a cloud in double precision")
        cloud = client.clouds[-1]
        assert (cloud.width, cloud.point_step) == (AROUND * ALONG, 24)
        first = np.frombuffer(bytes(cloud.data), "<f8").reshape(-1, 3)[0]
        assert first.tolist() == [DISTANCE + 0.3, 0.0, 0.0]
    log = capfd.readouterr().err
    assert "kg, clouds resolve 0.031 m" in log
    assert "coarser than the tolerance of 0.001 m: choose a nearer frame (frame_id), or set points" in log
    assert log.count("merged with it") == 1
    (path,) = tmp_path.glob("*.mcap")
    verdict = verify([path])
    assert verdict.same, verdict.first_reason
    assert verdict.clouds > 3
