# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Old names of public members: each gives the member of the new name and a warning."""

from __future__ import annotations

import inspect
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import cloth_sim_ros
from cloth_sim_ros import Extrapolated, Force, Model, Scene, Simulation
from cloth_sim_ros.physics.old_names import with_old_arguments, with_old_names
from cloth_sim_ros.scene.robot.pad_stops import PadStops
from cloth_sim_ros.simulation.energy_watch import EnergyReport

Array = NDArray[np.float64]
ROOT = Path(__file__).resolve().parents[2]
#: A row of the migration page: class, old and new name.
ROW = re.compile(r"^\| `(\w+)\.(\w+)` \| `(\w+)` \| \w", re.MULTILINE)


@with_old_names(size="length", grow="extend")
class Rope:
    def __init__(self, length: float) -> None:
        self.length = length

    @with_old_arguments(by="amount")
    def extend(self, amount: float) -> None:
        self.length += amount


def test_old_member_warns_and_gives_the_new_one() -> None:
    rope: Any = Rope(2.0)
    with pytest.warns(DeprecationWarning, match="Rope.size is now length") as caught:
        assert rope.size == 2.0
    assert caught[0].filename == __file__
    with pytest.warns(DeprecationWarning, match="Rope.grow is now extend"):
        rope.grow(1.0)
    with pytest.warns(DeprecationWarning, match="argument by of Rope.extend is now amount") as caught:
        rope.extend(by=1.0)
    assert caught[0].filename == __file__
    assert rope.length == 4.0


def test_old_argument_of_extrapolated_is_accepted() -> None:
    old: Any = Extrapolated
    with pytest.warns(DeprecationWarning, match="columns"):
        assert old(tolerance=1e-4, columns=3).n_runs == Extrapolated(tolerance=1e-4, n_runs=3).n_runs


def test_old_names_of_a_simulation_and_its_frame_work() -> None:
    simulation: Any = Simulation(Scene.from_parameters({"cloth.resolution": [4, 4]}))
    frame: Any = simulation.advance()
    with pytest.warns(DeprecationWarning, match=r"Simulation\.held is now grasped_count"):
        assert simulation.held(0) == simulation.grasped_count(0) == 0
    with pytest.warns(DeprecationWarning, match=r"Frame\.halted is now stopped"):
        assert frame.halted == frame.stopped
    with pytest.warns(DeprecationWarning, match=r"Advance\.binds is now limited_by"):
        assert frame.advance.binds == frame.advance.limited_by
    with pytest.warns(DeprecationWarning, match=r"Plan\.rates is now spectral_bounds"):
        assert simulation.plan.rates(simulation.state.x) == simulation.plan.spectral_bounds(simulation.state.x)


def test_migration_page_lists_members_that_exist() -> None:
    rows = ROW.findall((ROOT / "docs" / "migration.md").read_text(encoding="utf-8"))
    assert len(rows) == 34
    for class_name, old, new in rows:
        inner = {"EnergyReport": EnergyReport, "PadStops": PadStops}
        public_class = inner.get(class_name) or getattr(cloth_sim_ros, class_name)
        assert old in vars(public_class)
        assert new in dir(public_class) or new in inspect.getsource(public_class)


def test_force_that_overrides_supply_still_adds_power() -> None:
    with pytest.warns(DeprecationWarning, match="method supply of Pump is now external_power"):

        class Pump(Force):
            name = "pump"

            def add_force(self, t: float, x: Array, v: Array, f: Array) -> None:
                f[2] += 1.0

            def supply(self, t: float, x: Array, v: Array) -> float:
                return float(v[2].sum())

    plan: Any = cloth_sim_ros.compile(Model([1.0, 2.0], [Pump()]))
    x, v = np.zeros((3, 2)), np.ones((3, 2))
    assert plan.external_power(0.0, x, v) == 2.0
    with pytest.warns(DeprecationWarning, match=r"Plan\.supply is now external_power"):
        assert plan.supply(0.0, x, v) == 2.0
