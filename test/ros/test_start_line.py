# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The node's first log line."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("rclpy")

from cloth_sim_ros import Scene, Simulation
from cloth_sim_ros.ros.reporting.report import start_summary

ROOT = Path(__file__).resolve().parents[2]


def test_start_line_names_air_across_the_sheet() -> None:
    scene = Scene.from_parameters({"cloth.resolution": [5, 5]})
    assert start_summary(Simulation(scene), follows_clock=False).endswith("; air across the sheet 0.45 N s/m^3")
    still = scene.changed({"wind.normal_drag": 0.0})
    assert "air" not in start_summary(Simulation(still), follows_clock=False)


def test_start_line_of_raw_springs_names_no_air() -> None:
    chain = Scene.from_file(ROOT / "config" / "chain.yaml")
    assert "air" not in start_summary(Simulation(chain), follows_clock=False)
