# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Digests of a test's runs by the engine of another instruction set, in a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def check_digest(file: str, name: str, expected: str) -> None:
    """Compare the digest that `digest()` of a test's file gives with the engine's library of a name; skip the test if
    that library was not built.
    """
    if not (ROOT / "cloth_sim_ros" / "engine" / f"_{name}.so").exists():
        pytest.skip(f"the engine's library for {name} is not built: run make engines")
    path = os.pathsep.join(map(str, (ROOT, Path(file).parent, ROOT / "test")))
    done = subprocess.run(
        [sys.executable, "-c", f"import {Path(file).stem} as test; print(test.digest())"],
        env={**os.environ, "CLOTH_SIM_ROS_ENGINE": name, "PYTHONPATH": path},
        capture_output=True,
        text=True,
    )
    assert done.stdout.strip() == expected, done.stderr
