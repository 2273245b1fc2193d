# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The measurements of the node run, and clouds are built for those alone who want them."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rclpy")
ROOT = Path(__file__).resolve().parent.parent


def ask(module, *arguments):
    """Run a measurement; return what it prints. Its figures are the machine's, and so is its status."""
    command = [sys.executable, "-m", f"cloth_sim_ros.ros.{module}", *arguments]
    done = subprocess.run(command, cwd=ROOT, check=False, capture_output=True, text=True, timeout=300)
    assert done.returncode in (0, 1), done.stderr
    return json.loads(done.stdout)


def test_outputs_are_built_for_those_alone_who_want_them():
    # The measurement refuses to report if a cloud was built for nobody.
    told = ask("measure_outputs", "--resolution", "8", "--frames", "3")
    assert told["particles"] == 64
    assert set(told["presences"]) == {"nobody", "subscriber", "recorder", "both"}
    assert told["presences"]["nobody"]["to_nobody"] == 1.0


def test_start_is_measured_from_the_process_to_the_first_cloud():
    told = ask("measure_start", "--starts", "1", "--ros", "-p", "cloth.resolution:=[5, 5]")
    assert len(told["warm_s"]) == 1
    assert 0.0 < told["warm_processor_median_s"] < told["warm_s"][0] * 4.0
    assert told["met"] == (told["warm_median_s"] < told["goal_s"])
