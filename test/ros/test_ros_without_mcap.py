# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A robot without the session libraries: the cloth runs and reports that it can't record."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from std_srvs.srv import SetBool, Trigger
from support.ros_client import STARTED, Client

REASON = "which is not installed: pip install mcap rosbags zstandard lz4"


@pytest.mark.parametrize("library", ["mcap", "rosbags", "lz4"])
def test_node_without_mcap_runs_and_reports_no_recording(
    ros_domain: int, start_process: Callable[..., Any], tmp_path: Path, library: str
) -> None:
    parameters = {"record.enabled": "true", "record.folder": tmp_path / "sessions", "cloth.resolution": "[6, 7]"}
    arguments = ["--ros-args", *(word for name, value in parameters.items() for word in ("-p", f"{name}:={value}"))]
    script = (
        f"import sys\nsys.modules[{library!r}] = None\nfrom cloth_sim_ros.ros.main import main\n"
        f"sys.exit(main({arguments!r}))"
    )
    process = start_process([sys.executable, "-c", script])
    process.wait_for_output(STARTED)
    assert f"nothing is recorded: recording needs {library}, {REASON}" in process.output
    with Client() as client:
        client.watch()
        answer = client.call(SetBool, "/cloth_sim/record", SetBool.Request(data=True))
        assert not answer.success
        assert REASON in answer.message
        seen: list[Any] = []
        client.node.create_subscription(DiagnosticArray, "/diagnostics", lambda m: seen.extend(m.status), 10)
        status = client.spin_until(lambda: seen and seen[-1], description="diagnostics")
        assert REASON in {entry.key: entry.value for entry in status.values}["recording"]
        # Everything else works, including saved states.
        assert client.call(Trigger, "/cloth_sim/save_state").success
        client.wait_for_clouds(5)
    assert process.interrupt() == 0
    assert "Traceback" not in process.output
    assert list((tmp_path / "sessions").glob("*.mcap")) == []
