# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The thread pool avoids a late thread for as long as it was late."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from cloth_sim_ros.engine import build


@pytest.mark.skipif(shutil.which("g++") is None, reason="there is no g++")
def test_late_thread_is_retried_after_its_delay(tmp_path: Path) -> None:
    source, program = Path(__file__).with_name("late_thread.cpp"), tmp_path / "late_thread"
    command = ["g++", "-std=c++20", "-pthread", "-O1", *build.WARNINGS, "-I", str(Path(build.__file__).parent)]
    subprocess.run([*command, str(source), "-o", str(program)], check=True, capture_output=True, text=True)
    output = subprocess.run([program], check=True, capture_output=True, text=True, timeout=120).stdout
    assert output.splitlines() == [f"{late} late: 1 meanwhile, 2 later" for late in (1, 2, 3)]
