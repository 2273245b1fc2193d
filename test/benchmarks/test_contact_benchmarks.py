# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Benchmark of contact: a short run, and its report of missed targets."""

import math
from pathlib import Path

import numpy as np
import pytest
from support import contact_starts as starts
from support.obstacle_sheets import FRAME, SHEET, Capstan

from benchmarks.__main__ import main
from benchmarks.contact import obstacles as contact
from benchmarks.contact import pinch as contact_pinch
from benchmarks.contact import recovery as contact_starts
from benchmarks.contact import self_contact as contact_self
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.parameters import ros_yaml
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Grasp

CONFIG = Path(__file__).resolve().parents[2] / "config"


def test_capstan_tension_ratio_is_exponential():
    strip = Capstan(0.5, 0.5 * math.pi, columns=60)
    steps = Scene.from_parameters({**SHEET, "tolerance": 1e-4}).build_integrator()
    state, pulls = State(strip.start), np.zeros(2)
    for frame in range(60):
        strip.turn(frame * FRAME)
        steps.advance(strip.plan, state, frame * FRAME, FRAME)
        if frame >= 20:
            pulls += strip.tensions(state.x, state.v)
    assert pulls.max() / pulls.min() == pytest.approx(math.exp(0.25 * math.pi), rel=0.03)


def test_contact_command_prints_a_table(capsys):
    assert main(["contact", "--parts", "drift", "--drift", "0.5"]) == 0
    assert "### Drift" in capsys.readouterr().out


def test_contact_command_reports_missed_targets(capsys, monkeypatch):
    # The slope is too steep for the sheet.
    monkeypatch.setattr(contact, "STICTION_MARGIN", -5.0)
    assert main(["contact", "--parts", "drift", "--drift", "0.5"]) == 1
    assert "NOT MET" in capsys.readouterr().out


def test_pinch_holds_the_weight_and_reports_missed_targets(capsys, monkeypatch):
    assert main(["contact", "--parts", "pinch", "--drift", "0.5"]) == 0
    monkeypatch.setattr(contact_pinch, "FORCE_MARGIN", -0.01)  # Swaps the expectations of sliding and holding.
    monkeypatch.setattr(contact_pinch, "MAX_EXCURSION", 0.0)
    assert main(["contact", "--parts", "pinch", "--drift", "0.1"]) == 1
    output = capsys.readouterr().out
    assert "NOT MET: mu 0.5, grid of 28: it slides" in output
    assert "NOT MET: carried up, grid 4: gives by" in output


def test_recovery_is_slow_and_reports_missed_targets(capsys, monkeypatch):
    monkeypatch.setattr(contact_starts, "GAPS", (0.3,))
    monkeypatch.setattr(contact_starts, "PRESSES", (1e-3,))
    monkeypatch.setattr(starts, "RATE", 60)
    situations = {"start": (contact_starts.start, ("plane", "fold")), "added": (contact_starts.added, ("sphere",))}
    monkeypatch.setattr(contact_starts, "SITUATIONS", situations)
    monkeypatch.setattr(contact_starts, "PRESSED_ON", ("plane",))
    assert main(["contact", "--parts", "starts"]) == 0
    for name in ("FASTEST", "HIGHEST", "OPEN"):
        monkeypatch.setattr(contact_starts, name, 0.0)
    assert main(["contact", "--parts", "starts"]) == 1
    output = capsys.readouterr().out
    assert "NOT MET: start, plane, 0.6 mm: a particle moves at" in output
    assert "NOT MET: released on plane: a corner rises" in output
    assert "NOT MET: start, plane: the energy balance leaves" in output


def test_fold_poses_match_the_configuration():
    for name, sign in (("left", -1.0), ("right", 1.0)):
        steps = ros_yaml.load((CONFIG / f"fold_{name}.yaml").read_text(encoding="utf-8"))["steps"]
        poses = {step["time"]: tuple(step["position"]) for step in steps}
        assert poses == {t: (sign * contact_self.GRIPPER_OFFSET, y, z) for t, y, z, _ in contact_self.POSES}
        turns = [step["orientation"] for step in steps]
        assert np.allclose(turns, [contact_self.x_rotation(angle) for *_, angle in contact_self.POSES], atol=1e-6)
        closes = [(step["time"], step["close"]) for step in steps if "close" in step]
        assert closes == [(contact_self.CLOSING_TIME, True), (contact_self.OPENING_TIME, False)]


def test_fold_grippers_close_and_open():
    commands = [event for events in contact_self.events(300) for event in events]
    assert [event.closed for event in commands if isinstance(event, Grasp)] == [True, True, False, False]
    assert contact_self.gripper_pose(0.0) == (-0.22, 0.1, 0.0)
    assert contact_self.gripper_pose(2.3) == pytest.approx((-0.0875, 0.15, -60.0))
    assert contact_self.gripper_pose(9.0) == (0.23, 0.12, -180.0)


def test_self_contact_cost_is_reported(capsys, monkeypatch):
    monkeypatch.setattr(contact_self, "THICKNESSES", {12: 4e-3})
    monkeypatch.setattr(contact_self, "HANGING_RESOLUTIONS", (6,))
    monkeypatch.setattr(contact_self, "SEPARATED_FRAMES", 3)
    # The cost depends on the machine.
    main(["contact", "--parts", "folds", "hanging", "separated", "--fold", "0.2", "--seconds", "0.1"])
    out = capsys.readouterr().out
    assert "12 x 12" in out
    assert "6 x 6" in out
    assert "spins in free fall" in out


def test_fold_record_finds_the_worst_second():
    seconds = [0.01] * 100 + [0.05] * 60 + [0.02] * 40
    folded = contact_self.FoldRecord(seconds, [1] * 200, [0] * 200, 900)
    assert folded.worst == 100
    assert folded.speed(folded.worst, 60) == pytest.approx(1.0 / 3.0)
    assert folded.speed() == pytest.approx(200.0 / 60.0 / 4.8)
