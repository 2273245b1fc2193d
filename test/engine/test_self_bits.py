# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Equal bits of self-contact with every instruction set of this machine."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from cloth_sim_ros.engine.instruction_set import libraries

TESTS = Path(__file__).resolve().parent.parent
#: Frames of a fold that comes down on itself, on a grid and as lists, and of an implicit method.
PROGRAM = """
from support.contact_scenes import drop, still
from support.self_scenes import folded
from cloth_sim_ros.engine.binding import engine_name
from cloth_sim_ros.physics.contact.obstacles import Obstacle
from cloth_sim_ros.physics.state.state import State

print(engine_name())
table = {"obstacles": [Obstacle(name="table", shape="plane")], "paths": [still((0.0, 0.0, -3e-3))]}
for listed, integrator, frames in ((False, "auto", 8), (True, "auto", 8), (False, "implicit", 2)):
    model, places, velocities = folded(12, listed=listed, **table)
    plan, _, method = drop(model, places, integrator=integrator, tolerance=1e-4)
    state, met = State(places, velocities), 0
    for k in range(frames):
        method.advance(plan, state, k / 60.0, 1.0 / 60.0)
        met += plan.contact.self_gaps(state.x)[0]
    print(state.digest(), met)
"""


def program_output(name):
    """Run the program with the library of an instruction set; return its output lines."""
    environment = {**os.environ, "CLOTH_SIM_ROS_ENGINE": name, "PYTHONPATH": str(TESTS)}
    done = subprocess.run([sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, check=True)
    return done.stdout.splitlines()


def test_every_instruction_set_gives_the_same_bits():
    names = libraries()
    if len(names) < 2:
        pytest.skip("this machine runs one instruction set alone")
    outputs = [program_output(name) for name in names]
    assert [lines[0] for lines in outputs] == list(names)
    assert all(lines[1:] == outputs[0][1:] for lines in outputs)
    assert int(outputs[0][1].split()[1]) > 0
