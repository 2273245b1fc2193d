# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Limits of plans: memory of long runs, refused copies and arrays, a sheet without springs."""

from __future__ import annotations

import copy
import pickle
from pathlib import Path

import numpy as np
import pytest

from cloth_sim_ros.engine.binding import PATH_NUMBERS, float64_address
from cloth_sim_ros.physics.model.forces.gravity import Gravity
from cloth_sim_ros.physics.model.forces.grid_springs import GridSprings
from cloth_sim_ros.physics.model.forces.grips import Grips
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.model.parts import GridFamily
from cloth_sim_ros.physics.plan.plan import compile

MEGABYTE = 2**20


def peak():
    """Return the peak memory of this process since the mark was reset [bytes]."""
    (line,) = [line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM")]
    return 1024 * int(line.split()[1])


@pytest.mark.parametrize("gridded", [True, False], ids=["sheet", "list"])
def test_a_long_run_with_grippers_needs_no_memory_for_its_steps(gridded):
    grips = Grips(4)
    paths = np.zeros((4, PATH_NUMBERS))
    paths[:, 16] = 1.0
    grips.set_grips(paths, np.arange(5), np.arange(4), np.zeros((4, 3)), np.ones(4), np.zeros(4))
    springs = GridSprings(2, 2, [GridFamily(name="right", stiffness=1.0, rest_length=1.0)])
    plan = compile(Model(np.ones(4), [springs if gridded else springs.pair_springs, grips]))
    x = np.zeros((3, 4))
    plan.runs(0.0, 1.0, (x, x), [10])
    Path("/proc/self/clear_refs").write_text("5")
    before = peak()
    plan.runs(0.0, 1.0, (x, x), [100_000])
    assert peak() - before < 8 * MEGABYTE


@pytest.mark.parametrize("again", [copy.copy, copy.deepcopy, pickle.dumps])
def test_a_plan_is_not_copied(again):
    plan = compile(Model(np.ones(4), [Gravity((0.0, 0.0, -9.81))]))
    with pytest.raises(TypeError, match="compile its model once more"):
        again(plan)


def test_an_array_that_is_not_aligned_is_refused():
    odd = np.frombuffer(bytearray(8 * 6 + 1), dtype=np.float64, count=6, offset=1).reshape(3, 2)
    with pytest.raises(ValueError, match="no multiple of 8"):
        float64_address("x", odd, (3, 2))


def test_read_only_array_is_read_in_place():
    fixed = np.zeros((3, 2))
    address = float64_address("x", fixed, (3, 2))
    fixed.flags.writeable = False
    assert float64_address("x", fixed, (3, 2)) == address == fixed.ctypes.data


def test_a_sheet_without_families_has_no_listed_springs():
    assert GridSprings(3, 4, []).pair_springs.pairs.shape == (0, 2)


@pytest.mark.parametrize("columns", [1, 2, 7, 8, 9, 16, 33])
def test_grid_accelerations_equal_those_of_listed_springs(columns):
    random = np.random.default_rng(columns)
    names = {"right": 1.0, "down": 1.0, "diagonal": 1.4, "antidiagonal": 1.4, "right2": 2.0, "down2": 2.0}
    families = [
        GridFamily(name=name, stiffness=3.0, rest_length=rest_length, damping=0.2)
        for name, rest_length in names.items()
    ]
    springs, masses = GridSprings(5, columns, families), random.uniform(1.0, 2.0, 5 * columns)
    x, v = random.standard_normal((2, 3, 5 * columns))
    accelerations = np.full((2, *x.shape), np.nan)
    for force, out in zip((springs, springs.pair_springs), accelerations, strict=True):
        compile(Model(masses, [force, Gravity((0.0, 0.0, -9.81))], anchors=[0])).accelerations(0.0, x, v, out)
    np.testing.assert_allclose(accelerations[0], accelerations[1], rtol=1e-12, atol=1e-12)
    # The output may overwrite the input.
    over = x.copy()
    compile(Model(masses, [springs, Gravity((0.0, 0.0, -9.81))], anchors=[0])).accelerations(0.0, over, v, over)
    np.testing.assert_array_equal(over, accelerations[0])
