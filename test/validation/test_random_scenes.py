# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A scene of a seed is the same on every machine, whatever its BLAS and C library make of the last bits."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
from support.random_meshes import drawn_alike

#: Draws, and the commands of a violent scene whose gripper leaps by vectors of random length.
PROGRAM = """
import hashlib
from validation.tolerance import violent as promise_violent
from validation.tolerance.random_scenes import draw_scene
from cloth_sim_ros.simulation.simulation import Simulation
said = hashlib.sha256()
for index in range(12):
    drawn = draw_scene(1, index)
    said.update(f"{drawn.scene!r} {drawn.state.digest()}".encode())
scene, rng, _ = promise_violent.violent_scene(1, 127)
simulation = Simulation(scene)
for frame in range(60):
    said.update(repr(promise_violent._events(simulation, rng, frame, 60)).encode())
print(said.hexdigest())
"""
OTHERWISE = {
    "OPENBLAS_CORETYPE": "Nehalem",
    "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-FMA4,-AVX,-AVX512F,-AVX2_Usable,-FMA_Usable",
}


def test_draws_do_not_depend_on_the_machine_s_libraries() -> None:
    said = []
    for more in ({}, OTHERWISE):
        variables = os.environ | {"ROS_DOMAIN_ID": "0"} | more
        command = [sys.executable, "-c", PROGRAM]
        done = subprocess.run(command, capture_output=True, text=True, check=True, env=variables, timeout=120)
        said.append(done.stdout)
    assert said[0] == said[1] != ""


def test_numbers_that_differ_in_their_last_bits_are_drawn_alike() -> None:
    rng = np.random.default_rng(4)
    numbers = rng.normal(size=1000)
    assert np.array_equal(drawn_alike(numbers), drawn_alike(np.nextafter(numbers, np.inf)))
    np.testing.assert_allclose(drawn_alike(numbers), numbers, rtol=0, atol=5.1e-10)
