# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Benchmark of contact: a short run, and its report of missed targets."""

import math

import numpy as np
import pytest
from support.obstacle_sheets import FRAME, SHEET, Capstan

from benchmarks.__main__ import main
from benchmarks.contact import contact
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Grasp


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


def test_fold_grippers_close_and_open():
    events = contact.fold_events()
    grasps = [(frame, event.closed) for frame in range(300) for event in events.at(frame) if isinstance(event, Grasp)]
    # At 1 s and at 4.8 s; both grippers each.
    assert grasps == [(59, True), (59, True), (287, False), (287, False)]


def test_self_contact_cost_is_reported(capsys, monkeypatch):
    monkeypatch.setattr(contact, "THICKNESSES", {12: 4e-3})
    monkeypatch.setattr(contact, "HANGING_RESOLUTIONS", (6,))
    monkeypatch.setattr(contact, "SEPARATED_FRAMES", 3)
    # The cost depends on the machine.
    main(["contact", "--parts", "folds", "hanging", "separated", "--fold", "0.2", "--seconds", "0.1"])
    out = capsys.readouterr().out
    assert "12 x 12" in out
    assert "6 x 6" in out
    assert "spins in free fall" in out


def test_fold_record_finds_the_worst_second():
    seconds = [0.01] * 100 + [0.05] * 60 + [0.02] * 40
    folded = contact.FoldRecord(seconds, [1] * 200, [0] * 200, 900)
    assert folded.worst == 100
    assert folded.speed(folded.worst, 60) == pytest.approx(1.0 / 3.0)
    assert folded.speed() == pytest.approx(200.0 / 60.0 / 4.8)
