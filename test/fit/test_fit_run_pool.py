# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Processes of a fit after the end of the process that started them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("loky")

PROGRAM = """
import os, sys, time
from cloth_sim_ros.fit.run_pool import RunPool
with RunPool(2) as pool:
    print(os.getpid(), pool.map(abs, [-1, -2]), flush=True)
    time.sleep(60.0)
"""


def session_processes(session: int) -> list[int]:
    """Return the running processes of a session, which its first process started."""
    processes = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdecimal():
            continue
        try:
            state, _, _, of_session = (entry / "stat").read_text().rpartition(")")[2].split()[:4]
        except OSError:
            # It has ended meanwhile.
            continue
        if int(of_session) == session and state != "Z":
            processes.append(int(entry.name))
    return processes


def test_workers_of_a_killed_fit_end() -> None:
    with subprocess.Popen(
        [sys.executable, "-c", PROGRAM], stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as parent:
        assert parent.stdout is not None
        assert "[1, 2]" in parent.stdout.readline()
        assert len(session_processes(parent.pid)) > 2
        parent.kill()
    deadline = time.monotonic() + 20.0
    try:
        while session_processes(parent.pid) and time.monotonic() < deadline:
            time.sleep(0.1)
        assert session_processes(parent.pid) == []
    finally:
        for process in session_processes(parent.pid):
            os.kill(process, signal.SIGKILL)
