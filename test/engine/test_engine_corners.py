# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Corner cases: ends of rows, missing families of springs, exit during a run, re-entrant calls."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from support.alone import of_blocks

from cloth_sim_ros.physics.model.forces.force import Force
from cloth_sim_ros.physics.model.forces.grid_springs import GridSprings
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.model.parts import GridFamily
from cloth_sim_ros.physics.plan.plan import compile
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.scene import Scene

REST_LENGTHS = {"right": 0.01, "down": 0.01, "diagonal": 0.014, "antidiagonal": 0.014, "right2": 0.02, "down2": 0.02}


def springs(rows, columns, names):
    families = [GridFamily(name=name, stiffness=5.0, rest_length=REST_LENGTHS[name], damping=0.001) for name in names]
    return GridSprings(rows, columns, families)


def crumpled(rows, columns):
    rng = np.random.default_rng(4)
    i, j = np.divmod(np.arange(rows * columns), columns)
    x = np.stack([0.01 * j, 0.01 * i, 0.0 * i]) + 0.002 * rng.standard_normal((3, rows * columns))
    return x, 0.1 * rng.standard_normal(x.shape)


@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize(
    "names", [("right",), ("down",), ("right2",), ("down2",), ("down", "diagonal"), tuple(REST_LENGTHS)]
)
def test_sheet_with_any_subset_of_families(names, single):
    """Some families are known to a row only together; those that a sheet has not must not be taken with the others."""
    rows, columns = 9, 8
    x, v = crumpled(rows, columns)
    sheet = springs(rows, columns, names)
    masses = np.full(rows * columns, 1e-4)
    ends = [
        compile(Model(masses, [force])).runs(0.0, 5e-4, (x, v), [5], single_precision=single)[0][0].x
        for force in (sheet, sheet.pair_springs)
    ]
    assert np.abs(ends[0] - ends[1]).max() < (1e-8 if single else 1e-15)


@pytest.mark.parametrize("columns", [1, 2, 5, 6, 13, 14, 22])
def test_bounds_at_row_start_ignore_padding(columns):
    """Rows whose padding is just filled by whole vectors: what lies beyond the last column belongs to no spring."""
    rows = 7
    x, _ = crumpled(rows, columns)
    sheet = springs(rows, columns, REST_LENGTHS)
    # The first column decides.
    masses = np.where(np.arange(rows * columns) % columns == 0, 1e-5, 1e-4)
    grid, listed = (compile(Model(masses, [force])) for force in (sheet, sheet.pair_springs))
    actual, expected = (np.zeros((2, 6, rows * columns)) for _ in range(2))
    grid.add_bounds(x, *actual)
    listed.add_bounds(x, *expected)
    assert np.abs(actual - expected).max() < 1e-13 * np.abs(expected).max()
    np.testing.assert_allclose(grid.spectral_bounds(x), of_blocks(listed, x), rtol=3e-6)


RUN_ON = """
import threading
import numpy as np
from cloth_sim_ros.physics.model.forces.grid_springs import GridSprings
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.model.parts import GridFamily
from cloth_sim_ros.physics.plan.plan import compile

family = GridFamily(name="right", stiffness=1.0, rest_length=0.01, damping=0.001)
plan, other = (compile(Model(np.ones(90_000), [GridSprings(300, 300, [family])])) for _ in range(2))
x, v = np.random.default_rng(1).standard_normal((2, 3, 90_000))
begun = threading.Event()


def work():
    begun.set()
    plan.runs(0.0, 1e-3, (x, v), [10**6])


threading.Thread(target=work, daemon=True).start()
begun.wait()
for _ in range(30):
    other.energy(0.0, x, v)  # long enough for the run to be under way
"""


def test_process_exits_during_a_run():
    done = subprocess.run([sys.executable, "-c", RUN_ON], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


class ReentrantForce(Force):
    """A force that lets its own plan run while a run asks for it."""

    name = "asks back"

    def __init__(self):
        self.plan = None

    def add_force(self, t, x, v, f):
        if self.plan is not None:
            plan, self.plan = self.plan, None
            plan.runs(t, 0.01, (x.copy(), v.copy()), [1, 2], memory={})


def test_busy_plan_refuses_second_run():
    x, v = crumpled(4, 4)
    force = ReentrantForce()
    plan = compile(Model(np.ones(16), [force]))
    force.plan = plan
    with pytest.raises(RuntimeError, match="not re-entrant"):
        plan.runs(0.0, 0.01, (x, v), [3], memory={})
    # The refusal leaves it as it was.
    assert np.isfinite(plan.runs(0.0, 0.01, (x, v), [3], memory={})[0][0].x).all()


QUESTIONS = {
    "rates": lambda plan, x, v: plan.spectral_bounds(x),
    "energy": lambda plan, x, v: plan.energies(0.0, x, v, memory={}),
    "powers": lambda plan, x, v: plan.powers(0.0, x, v, memory={}),
    "bounds": lambda plan, x, v: plan.add_bounds(x, np.zeros((6, 16)), np.zeros((6, 16)), memory={}),
    "gaps": lambda plan, x, v: plan.contact.self_gaps(x),
    "ahead": lambda plan, x, v: plan.contact.predict_surface_contact(0.0, 0.01, x, v, memory={}),
    "rest": lambda plan, x, v: plan.contact.is_clear_of_itself(0.01, x, v),
}


@pytest.mark.parametrize("name", QUESTIONS)
def test_busy_plan_refuses_queries(name):
    # Answers would overwrite what the run keeps: which parts of the cloth are near each other, for one.
    scene = Scene.from_parameters({"cloth.resolution": [4, 4], "contact.self": True, "contact.thickness": 0.01})
    model = scene.model()
    x, v = State(scene.sheet.positions()).x, np.zeros((3, 16))
    queried = []

    class QueryingForce(Force):
        name = "asks"

        def add_force(self, t, x, v, f):
            if not queried:
                queried.append(t)
                QUESTIONS[name](plan, x.copy(), v.copy())

    plan = compile(Model(model.masses, [*model.forces, QueryingForce()], anchors=model.anchors))
    with pytest.raises(RuntimeError, match="not re-entrant"):
        plan.runs(0.0, 0.01, (x, v), [3], memory={})
    assert queried
    QUESTIONS[name](plan, x, v)
