# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The demonstration of `make run`: it works, ends, and stays on this machine."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
import pytest
import yaml
from support.session_maker import SessionMaker

from cloth_sim_ros import Scene
from cloth_sim_ros.ros import demo
from cloth_sim_ros.session.reader import SessionReader

ROOT = Path(__file__).resolve().parents[2]
RANGE, DOMAIN = "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_DOMAIN_ID"
STEPS = [
    {"time": 0.0, "position": [0.6, -0.2, 0.4]},
    {"time": 0.5, "position": [0.5, 0.0, 0.5]},
    {"time": 0.6, "position": [0.5, 0.0, 0.5], "close": True},
    {"time": 1.5, "position": [0.3, -0.4, 0.9]},
    {"time": 1.7, "close": False},
]


def run_demo(start_process: Callable[..., Any], folder: Path) -> Any:
    script, parameters = folder / "script.yaml", folder / "cloth.yaml"
    script.write_text(yaml.safe_dump({"steps": STEPS}))
    parameters.write_text(yaml.safe_dump({"/**": {"ros__parameters": {"cloth": {"resolution": [10, 10]}}}}))
    arguments = ["--folder", folder / "sessions", "--params", parameters, "--script", script]
    return start_process(["-m", "cloth_sim_ros.ros.demo", *arguments])


def test_demo_report_counts_are_consistent(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    maker = SessionMaker(tmp_path, Scene.from_parameters({"cloth.resolution": [4, 4]}))
    for _ in range(5):
        maker.add()
    path = maker.finish()
    with SessionReader(path) as session:
        stamps = [message.log_time for message in session.messages(["/cloth_sim/points"])]
    # The first cloud came before the subscriber was matched; the last diagnostics came before the last clouds.
    values = {"clouds_published": "2", "recording_file": str(path), "real_time_factor_overall": "1.0"}
    assert demo.report(demo.Received(clouds=4, first=stamps[1], values=values)) == 0
    assert "frames published  5, received 4, lost since the first one 0" in capsys.readouterr().out


def test_the_demonstration_grasps_records_and_ends(
    ros_domain: int, start_process: Callable[..., Any], tmp_path: Path
) -> None:
    pytest.importorskip("mcap")
    from cloth_sim_ros.verify.run import verify

    process = run_demo(start_process, tmp_path)
    assert process.wait(limit=110.0) == 0, process.output
    (path,) = (tmp_path / "sessions").glob("*.mcap")
    assert f"session           {path}" in process.output
    assert "lost since the first one 0" in process.output
    verdict = verify([path])
    assert verdict.same, verdict
    assert verdict.frames > 100


def test_a_signal_ends_the_demonstration_and_what_it_started(
    ros_domain: int, start_process: Callable[..., Any], tmp_path: Path
) -> None:
    process = run_demo(start_process, tmp_path)
    process.wait_for_output("grasping")
    children = psutil.Process(process.pid).children(recursive=True)
    assert len(children) >= 1
    os.kill(process.pid, 2)
    assert process.wait() == 130
    gone, alive = psutil.wait_procs(children, timeout=5.0)
    assert not alive
    assert len(gone) == len(children)
    assert "Traceback" not in process.output


def test_demo_uses_localhost_and_a_reserved_domain(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(RANGE)
    monkeypatch.delenv(DOMAIN)
    with demo.reserved_domain():
        assert os.environ[RANGE] == "LOCALHOST"
        first = int(os.environ[DOMAIN])
        # Another process that reserves a domain meanwhile gets another one.
        with socket.socket() as second_socket, pytest.raises(OSError, match="in use"):
            second_socket.bind(("", 32768 + first))
        monkeypatch.delenv(DOMAIN)
        with demo.reserved_domain():
            assert int(os.environ[DOMAIN]) != first


def test_demo_keeps_network_settings_of_the_user(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(RANGE, "SUBNET")
    monkeypatch.setenv(DOMAIN, "42")
    with demo.reserved_domain():
        assert (os.environ[RANGE], os.environ[DOMAIN]) == ("SUBNET", "42")


@pytest.mark.parametrize(("environment", "expected"), [({}, "LOCALHOST"), ({RANGE: "SUBNET"}, "SUBNET")])
def test_make_passes_discovery_range_and_no_other_ros(environment: dict[str, str], expected: str) -> None:
    if shutil.which("make") is None:
        pytest.skip("make is not installed")
    foreign = {"AMENT_PREFIX_PATH": "/opt/ros/other", "PYTHONPATH": "/opt/ros/other", "ROS_DISTRO": "other"}
    plain = {name: value for name, value in os.environ.items() if name != RANGE}
    done = subprocess.run(
        ["make", "--no-print-directory", "--eval", "shown: ; @env", "shown"],
        cwd=ROOT, env={**plain, **foreign, **environment}, check=True, capture_output=True, text=True,
    )  # fmt: skip
    passed = dict(line.split("=", 1) for line in done.stdout.splitlines() if "=" in line)
    assert passed[RANGE] == expected
    assert passed["RMW_IMPLEMENTATION"] == "rmw_fastrtps_cpp"
    assert not foreign.keys() & passed.keys()
