# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The node's Fast DDS transports: size from the cloud, bounds, and the user's choice."""

from __future__ import annotations

import os
import types
from pathlib import Path
from typing import Any

import pytest
import rclpy.utilities

from cloth_sim_ros.ros.io.transports import cloud_transports, segment_bytes
from cloth_sim_ros.ros.process.command_line_parameters import command_line_parameters

PROFILES = "FASTRTPS_DEFAULT_PROFILES_FILE"


@pytest.fixture(autouse=True)
def fast_dds(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Fast DDS without settings of the user, and with much shared memory."""
    for name in (PROFILES, "FASTDDS_BUILTIN_TRANSPORTS", "RMW_FASTRTPS_USE_QOS_FROM_XML"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(rclpy.utilities, "get_rmw_implementation_identifier", lambda: "rmw_fastrtps_cpp")
    monkeypatch.chdir(tmp_path)
    set_room(monkeypatch, 1 << 34)


def set_room(monkeypatch: pytest.MonkeyPatch, free: int) -> None:
    """Set the free shared memory [bytes]."""
    monkeypatch.setattr(os, "statvfs", lambda _: types.SimpleNamespace(f_bavail=free, f_frsize=1))


def test_segment_holds_what_a_suspended_subscriber_pins() -> None:
    small, medium, large = (segment_bytes({"cloth.resolution": [cells, cells]}) for cells in (10, 64, 128))
    cloud, mesh = 100 * 12, 2 * 9 * 9 * 72
    assert small >= 3 * 60 * cloud + 4 * (cloud + mesh)
    # A queue of 512 buffers of 65,500 bytes, and the messages being sent.
    assert large >= 512 * 65_500 + 4 * (128 * 128 * 12 + 2 * 127 * 127 * 72)
    assert small < medium < large


def test_segment_keeps_no_unread_meshes() -> None:
    # Fast DDS makes all of the segment resident, and the mesh is eleven times as large as the cloud.
    assert segment_bytes({}) < 4 << 20


@pytest.mark.parametrize(
    ("parameters", "size"),
    [
        ({"cloth.resolution": [1000, 1000]}, 64 << 20),
        ({"cloth.resolution": [3, 3]}, 1 << 20),
        ({"cloth.resolution": "many", "rate": -3.0}, None),
        ({"cloth.mesh": "no_such_file.obj"}, None),
    ],
)
def test_segment_is_bounded_whatever_the_parameters(parameters: dict[str, Any], size: int | None) -> None:
    expected = segment_bytes({}) if size is None else size
    assert expected <= segment_bytes(parameters) < expected + (1 << 20)


def test_segment_of_a_mesh_follows_from_its_file(tmp_path: Path) -> None:
    mesh = tmp_path / "large.obj"
    mesh.write_bytes(bytes(1_000_000))
    assert segment_bytes({"cloth.mesh": str(mesh)}) > segment_bytes({})


def test_profile_is_in_force_until_the_node_has_joined() -> None:
    before = dict(os.environ)
    with cloud_transports({"cloth.resolution": [64, 64]}) as warning:
        profile = Path(os.environ[PROFILES])
        assert f"<segment_size>{segment_bytes({'cloth.resolution': [64, 64]})}<" in profile.read_text()
        assert not warning
    assert dict(os.environ) == before
    assert not profile.exists()


@pytest.mark.parametrize(
    "name", [PROFILES, "FASTDDS_DEFAULT_PROFILES_FILE", "FASTDDS_BUILTIN_TRANSPORTS", "RMW_FASTRTPS_USE_QOS_FROM_XML"]
)
def test_transports_of_a_user_stay(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setenv(name, "1")
    before = dict(os.environ)
    with cloud_transports({}) as warning:
        assert dict(os.environ) == before
    assert not warning


def test_profile_in_the_working_directory_stays(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "DEFAULT_FASTRTPS_PROFILES.xml").touch()
    with cloud_transports({}):
        assert PROFILES not in os.environ
    monkeypatch.setenv("SKIP_DEFAULT_XML_FILE", "1")
    with cloud_transports({}):
        assert PROFILES in os.environ


def test_other_middlewares_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rclpy.utilities, "get_rmw_implementation_identifier", lambda: "rmw_cyclonedds_cpp")
    with cloud_transports({}):
        assert PROFILES not in os.environ


def test_little_room_makes_a_smaller_segment(monkeypatch: pytest.MonkeyPatch) -> None:
    set_room(monkeypatch, 10_000_000)
    with cloud_transports({"cloth.resolution": [64, 64]}) as warning:
        assert "<segment_size>5000000<" in Path(os.environ[PROFILES]).read_text()
    assert not warning


@pytest.mark.parametrize("reach", ["SUBNET", "LOCALHOST"])
def test_no_room_means_udp_and_a_warning(monkeypatch: pytest.MonkeyPatch, reach: str) -> None:
    set_room(monkeypatch, 3_000_000)
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", reach)
    with cloud_transports({"cloth.resolution": [64, 64]}) as warning:
        chosen = (
            os.environ.get("FASTDDS_BUILTIN_TRANSPORTS", "") + Path(os.environ.get(PROFILES, "/dev/null")).read_text()
        )
        assert "UDPv4" in chosen
        assert "SHM" not in chosen
    assert "3 MB free" in warning
    assert "12.4 MB" in warning
    assert "enlarge /dev/shm" in warning
    assert os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] == reach


def test_given_parameters_follow_the_command_line(tmp_path: Path) -> None:
    file = tmp_path / "cloth.yaml"
    file.write_text(
        "/**:\n  ros__parameters:\n    rate: 30.0\n"
        "/left/towel:\n  ros__parameters:\n    cloth: {resolution: [7, 8]}\n"
        "other:\n  ros__parameters:\n    rate: 1.0\n"
    )
    renamed = ["cloth_sim", "--ros-args", "-r", "__ns:=/left", "--remap", "__node:=towel"]
    values = command_line_parameters(
        [*renamed, "--params-file", str(file), "-p", "rate:=90.0", "-p", "other:gravity:=[1.0]"]
    )
    assert values == {"rate": 90.0, "cloth.resolution": [7, 8]}
    assert command_line_parameters(["cloth_sim", "-p", "rate:=1.0"]) == {}


@pytest.mark.parametrize("text", ["a: [", "- 1", "\0", "x:\n  y: 1\n"])
def test_given_parameters_leave_refusals_to_the_node(tmp_path: Path, text: str) -> None:
    file = tmp_path / "bad.yaml"
    file.write_text(text)
    arguments = ["cloth_sim", "--ros-args", "--params-file", str(file), "-p", "rate:=[", "-p", "rate", "--params-file"]
    assert command_line_parameters(arguments) == {}
