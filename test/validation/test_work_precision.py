# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Command `work-precision`: compared solvers, and solvers beyond the time limit."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
from support.problems import Problem, problem

from validation.__main__ import main
from validation.tolerance import work_precision
from validation.tolerance.work_precision import SolverRun, SolverSetting, SolverTimeoutError


def fake(name: str, kind: str, *, error: float, seconds: float, held_up: bool = False) -> SolverSetting:
    """Return a solver with a given error on the chain and a given time; `held_up`: later runs exceed any time limit."""
    runs = []

    def solve(scene: Problem, limit: float) -> SolverRun:
        runs.append(limit)
        if held_up and len(runs) > 1 and limit < math.inf:
            raise SolverTimeoutError
        if seconds > limit:
            raise SolverTimeoutError
        assert scene.exact is not None
        x = scene.exact(scene.duration)
        x[0, 5] += error
        return SolverRun(x, seconds, 7)

    return SolverSetting(name, "as it is", kind, solve)


def test_comparison_uses_fastest_accurate_solver(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    product_solvers = [
        fake("fine", "beside", error=0.0, seconds=1e-9),
        fake("rough", "ours", error=1e-4, seconds=0.001),
    ]
    product_solvers += [
        fake("good", "ours", error=9e-6, seconds=0.01),
        fake("better", "ours", error=9e-8, seconds=0.05),
    ]
    product_solvers += [
        fake("one thread", "alone", error=9e-6, seconds=0.02),
        fake("the same", "alone", error=9e-8, seconds=0.1),
    ]
    library_solvers = [
        fake("theirs", "library", error=1e-8, seconds=0.2),
        fake("slower", "library", error=1e-9, seconds=0.3),
    ]
    library_solvers += [fake("never", "library", error=0.0, seconds=9.0)]
    library_solvers.append(fake("held up", "library", error=1e-9, seconds=0.4, held_up=True))
    monkeypatch.setattr(work_precision, "product_solvers", lambda _: product_solvers)
    monkeypatch.setattr(work_precision, "library_solvers", lambda *, slow: library_solvers)
    monkeypatch.setattr(work_precision, "_residual", lambda *_: None)
    file = tmp_path / "report.json"
    assert main(["work-precision", "--scene", "chain", "--limit", "1", "--repeats", "3", "--json", str(file)]) == 0
    report = json.loads(file.read_text())
    everything, comparison = (table["rows"] for table in report["tables"])
    names = ["fine", "rough", "good", "better", "one thread", "the same", "theirs", "slower", "held up"]
    assert [row[0] for row in everything] == names
    assert [[row[0], row[2].split()[0], row[5].split()[0]] for row in comparison] == [
        [1e-5, "good", "theirs"],
        [1e-7, "better", "theirs"],
    ]
    assert [row[6] for row in comparison] == [pytest.approx(20.0), pytest.approx(4.0)]
    assert [row[7] for row in comparison] == [pytest.approx(10.0), pytest.approx(2.0)]
    assert any("never" in note and "not done after 1 s" in note for note in report["notes"])
    assert any("1e-10" in note for note in report["notes"])


def test_product_and_library_solve_the_same_equations() -> None:
    scene = problem("chain")
    assert scene.exact is not None
    exact = scene.exact(scene.duration)
    product_solver = next(solver for solver in work_precision.product_solvers((1e-7,)) if solver.kind == "ours")
    library_solver = next(
        solver for solver in work_precision.library_solvers(slow=False) if solver.setting.endswith("1e-08")
    )
    for solver in (product_solver, library_solver):
        done = solver.solve(scene, 60.0)
        assert abs(done.positions - exact).max() < 1e-7
        assert done.evaluations > 100
