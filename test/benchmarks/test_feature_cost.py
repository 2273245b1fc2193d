# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks feature-cost`; the hand-written loop moves as the simulation does."""

import numpy as np
import pytest
from support.feature_variants import BARE, FORCES, swinging

from benchmarks.__main__ import COMMANDS, main
from benchmarks.speed.curtain import cores
from benchmarks.speed.feature_cost import HandWrittenLoop
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.simulation import Simulation


@pytest.mark.parametrize("values", [BARE, FORCES], ids=["bare", "forces"])
def test_hand_written_loop_matches_the_simulation_bits(values):
    with cores(one_core=True):
        scene = Scene.from_parameters({**values, "cloth.resolution": [9, 12]})
        simulation, loop = Simulation(scene, swinging(scene)), HandWrittenLoop(scene)
        for _ in range(12):
            frame = simulation.advance()
            loop.frame()
            assert loop.steps == frame.advance.steps
        assert np.array_equal(simulation.state.x, loop.x)
        assert np.array_equal(simulation.state.v, loop.v)


def test_commands_print_their_help(capsys):
    for name in ("feature-cost", "scale"):
        assert name in COMMANDS
        with pytest.raises(SystemExit) as stop:
            main([name, "--help"])
        assert stop.value.code == 0
        assert "--json" in capsys.readouterr().out


def test_a_small_run_reports_ratios(tmp_path, capsys):
    status = main(["feature-cost", "--only", "hand", "--sizes", "8", "--copies", "1", "--seconds", "0.01"])
    output = capsys.readouterr().out
    assert "| 8  | springs alone" in output or "| 8 | springs alone" in output
    # At this size Python costs more than the engine, so the target is missed.
    assert status == 1
    assert "NOT MET" in output
