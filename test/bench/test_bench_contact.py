# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The measurement of contact: a short sample of it, and that it tells what is not met."""

import math

import numpy as np
import pytest

from cloth_sim_ros.bench import contact
from cloth_sim_ros.bench.contact_scenes import FRAME, SHEET, Capstan
from cloth_sim_ros.bench.main import main
from cloth_sim_ros.physics.state import State
from cloth_sim_ros.scene.scene import Scene


def test_a_strip_over_a_turning_drum_pulls_by_the_exponential_of_friction_and_angle():
    strip = Capstan(0.5, 0.5 * math.pi, columns=60)
    steps = Scene.from_parameters({**SHEET, "tolerance": 1e-4}).build_integrator()
    state, pulls = State(strip.start), np.zeros(2)
    for frame in range(60):
        strip.turn(frame * FRAME)
        steps.advance(strip.plan, state, frame * FRAME, FRAME)
        if frame >= 20:
            pulls += strip.tensions(state.x, state.v)
    assert pulls.max() / pulls.min() == pytest.approx(math.exp(0.25 * math.pi), rel=0.03)


def test_it_prints_a_table_and_ends_well(capsys):
    assert main(["contact", "--parts", "drift", "--drift", "0.5"]) == 0
    assert "### Drift" in capsys.readouterr().out


def test_what_is_not_met_is_told(capsys, monkeypatch):
    # A sheet that lies on a slope that is too steep for it.
    monkeypatch.setattr(contact, "NEAR", -5.0)
    assert main(["contact", "--parts", "drift", "--drift", "0.5"]) == 1
    assert "NOT MET" in capsys.readouterr().out
