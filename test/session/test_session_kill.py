# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A few kills at random times; soak_session_kills.py does hundreds."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest


def _kill(folder: Path, *options: str) -> str:
    script = Path(__file__).parents[1] / "soak_session_kills.py"
    done = subprocess.run(
        [sys.executable, str(script), "--folder", str(folder), *options], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_killed_recordings_lack_only_their_end(tmp_path: Path) -> None:
    # The length of the missing end is not tested: a busy machine may stop a process for a while.
    assert "8 kills" in _kill(tmp_path, "--count", "8", "--within", "60", "--longest", "1.2")


@pytest.mark.soak
def test_five_hundred_kills_lose_at_most_a_second_each(tmp_path: Path) -> None:
    said = _kill(tmp_path, "--count", "500", "--within", "1.0")
    print(said)
    assert "500 kills" in said
