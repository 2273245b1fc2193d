# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks cost-additivity`: the additivity of costs, on tiny sheets."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.__main__ import main
from benchmarks.speed import cost_additivity as adds
from benchmarks.speed.cost_additivity import Cost
from validation.report import Report

ROOT = Path(__file__).resolve().parents[2]


def cost(both: float) -> Cost:
    times = {frozenset(["air"]): 1.5, frozenset(["numpy"]): 2.0, frozenset(["air", "numpy"]): both}
    return Cost(base=1e-3, steps=50, times=times)


@pytest.mark.parametrize(("both", "holds"), [(2.6, True), (2.68, False)])
def test_pair_cost_above_the_bound_fails(both: float, holds: bool) -> None:
    report = Report("", "", environment={})
    adds.add("grid", cost(both), report)
    # 1.1 (0.5 + 1.0) + 0.02 = 1.67
    (row,) = report.tables[1].rows
    assert row[:2] == ["air", "numpy"]
    assert row[5] == pytest.approx((both - 1.0) / 1.5)
    assert row[-1] == ("yes" if holds else "no")
    assert bool(report.failures) is not holds


def test_pairs_have_one_bending_model() -> None:
    pairs = adds.pairs(adds.FEATURES)
    assert len(pairs) == len(set(pairs)) == 30
    assert ("opposite", "crossed") not in pairs
    assert ("altitude", "energy") in pairs


@pytest.mark.parametrize("sheet", adds.SHEETS)
def test_cost_additivity_reports_all_pairs(sheet: str, tmp_path: Path) -> None:
    file = tmp_path / "out.json"
    options = [
        "--sheets",
        sheet,
        "--features",
        "opposite",
        "gripper",
        "numpy",
        "--resolution",
        "8",
        "--seconds",
        "0.01",
    ]
    main(["cost-additivity", *options, "--json", str(file)])
    alone, together = json.loads(file.read_text())["tables"]
    assert [row[0] for row in alone["rows"]] == ["base", "opposite", "gripper", "numpy"]
    assert [row[:2] for row in together["rows"]] == [
        ["opposite", "gripper"],
        ["opposite", "numpy"],
        ["gripper", "numpy"],
    ]


def test_scene_has_the_requested_features() -> None:
    names = frozenset(["altitude", "air", "gripper", "numpy", "energy"])
    scene = adds.scene("mesh", 8, names, step=1e-4)
    assert {"altitude", "air", "grips", "floor"} <= {force.name for force in scene.plan().model.forces}
    assert scene.diagnostics.energy
    assert {force.name for force in adds.scene("mesh", 8, frozenset()).plan().model.forces}.isdisjoint(
        {"altitude", "air", "grips", "floor"}
    )


def test_floor_force_is_the_energy_gradient() -> None:
    floor = adds.Floor(0.7, 3.0)
    x = np.array([[0.0, 0.0], [0.0, 0.0], [0.5, 0.9]])
    f = np.zeros_like(x)
    floor.add_force(0.0, x, np.zeros_like(x), f)
    kick = np.zeros_like(x)
    kick[2] = 1e-6
    slope = (floor.energy(0.0, x + kick) - floor.energy(0.0, x - kick)) / 2e-6
    assert float(f[2].sum()) == pytest.approx(-slope, rel=1e-6)
