# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Evaluations at equal achieved error: what is read off two sets of runs."""

from __future__ import annotations

import math

import pytest

from cloth_sim_ros.bench.equal_error import compared, evaluations_at, runs_by_scene
from cloth_sim_ros.bench.report import Table

RUNS = [(1e-3, 100), (1e-5, 400), (1e-4, 900)]


def test_between_two_runs_the_logarithms_are_linear() -> None:
    assert evaluations_at(RUNS, 1e-5) == pytest.approx(400.0)
    # The run at 1e-4 is beaten by that at 1e-5, which is better and cheaper.
    assert evaluations_at(RUNS, 1e-4) == pytest.approx(200.0)


def test_a_larger_error_costs_the_cheapest_run_and_a_smaller_one_is_unknown() -> None:
    assert evaluations_at(RUNS, 1.0) == 100.0
    assert math.isnan(evaluations_at(RUNS, 1e-6))


def test_more_evaluations_than_allowed_are_told() -> None:
    columns = ["scene", "achieved m", "evaluations"]
    old = runs_by_scene(Table("", columns, [["chain", 1e-3, 100], ["chain", 1e-5, 400]]))
    new = runs_by_scene(Table("", columns, [["chain", 1e-3, 105], ["chain", 1e-5, 480]]))
    table, missed = compared(new, old, "abc")
    assert [row[4] for row in table.rows[:2]] == pytest.approx([1.05, 1.2])
    assert missed == ["chain at 1e-05 m takes 1.20 of abc's evaluations"]
