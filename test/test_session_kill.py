# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A few kills at random moments; soak_session_kills.py does hundreds."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path


def test_killed_recordings_open_and_lack_nothing_but_their_end(tmp_path: Path) -> None:
    # How much of the end may be missing is not tested here: a busy machine may stop any process for a while.
    command = [sys.executable, str(Path(__file__).with_name("soak_session_kills.py")), "--count", "8", "--within", "60"]
    done = subprocess.run(
        [*command, "--longest", "1.2", "--folder", str(tmp_path)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "8 kills" in done.stdout
