# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Signals: the node ends in order, its recording closed, however it is asked to."""

from __future__ import annotations

import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from ros_client import start_cloth

#: What issue and launch files promise is 2 s; the rest is for a busy machine.
LIMIT = 10.0


@pytest.mark.parametrize(
    "numbers",
    [[signal.SIGTERM], [signal.SIGINT, signal.SIGINT]],
    ids=lambda numbers: "+".join(number.name for number in numbers),
)
def test_a_signal_closes_the_recording(
    ros_domain: int, start_process: Callable[..., Any], tmp_path: Path, numbers: list[signal.Signals]
) -> None:
    pytest.importorskip("mcap")
    from cloth_sim_ros.session.reader import SessionReader

    process = start_cloth(start_process, "record.enabled:=true", f"record.folder:={tmp_path}")
    for number in numbers:
        process.send_signal(number)
        process.wait_for_output(": stopping")
    assert process.wait(limit=LIMIT) == 0, process.output
    assert "Traceback" not in process.output
    (path,) = tmp_path.glob("*.mcap")
    with SessionReader(path, strict=True) as reader:
        list(reader.messages())
        assert reader.complete


def test_a_signal_ends_the_compilation(ros_domain: int, start_process: Callable[..., Any], tmp_path: Path) -> None:
    process = start_cloth(start_process, wait="preparing the kernels", env={"NUMBA_CACHE_DIR": str(tmp_path)})
    assert process.interrupt(limit=LIMIT) == 0, process.output
    assert "wall time" not in process.output
    assert "Traceback" not in process.output


def test_a_gripper_that_waits_ends_at_once(ros_domain: int, start_process: Callable[..., Any]) -> None:
    process = start_process(["-m", "cloth_sim_ros.ros.gripper_main"])
    process.wait_for_output("waiting for")
    assert process.interrupt(limit=LIMIT) == 130
    assert "Traceback" not in process.output
