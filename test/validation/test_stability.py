# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Stability scan: single cases, step limits at stretched states, and the case pool."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path

import numpy as np
import pytest

from cloth_sim_ros.physics.control.leapfrog import Leapfrog
from cloth_sim_ros.physics.integrators.implicit import Implicit
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.simulation import Simulation
from validation import __main__ as validation_command
from validation.case_pool import CasePool
from validation.stability.cases import Case, all_cases, contact_cases, random_cases, run_case
from validation.stability.scan import LARGEST_EXCESS, MAX_ENERGY_GAIN, measure_step_limit, stretched_sheet


@pytest.mark.parametrize("case", contact_cases(1, 5), ids=lambda case: case.stress_case)
def test_contact_stress_cases_stay_finite_and_gain_no_energy(case: Case) -> None:
    result = run_case(case)
    assert result.finite, result.trouble
    assert result.gain <= MAX_ENERGY_GAIN


def test_scan_has_at_least_2000_distinct_cases() -> None:
    cases = all_cases()
    assert len(set(cases)) == len(cases) >= 2000


@pytest.mark.parametrize(
    ("case", "integrator"),
    [
        # Energy gain of springs pushed to a point, at a fixed step.
        (Case("grid", "inverted cell", 1.0, 0.0, 30.0, "fixed"), "leapfrog"),
        (Case("grid", "stretched x 3", 100.0, 0.0, 60.0, "fixed"), "leapfrog"),
        # Combined runs that amplify undamped waves.
        (Case("grid", "release", 100.0, 0.0, 240.0, "auto"), "extrapolated"),
        # Stages without a solution nearby.
        (Case("grid", "coincident", 1e6, 0.5, 60.0, "auto"), "implicit"),
        (Case("grid", "yanked at 10 m/s", 1e6, 3.0, 30.0, "auto"), "implicit"),
        (Case("grid", "parameters change", 1.0, 0.5, 60.0, "fixed"), "leapfrog"),
        (Case("mesh", "crumpled", 1.0, 0.5, 60.0, "auto"), "extrapolated"),
        # Steps that change in mid-run, and with them the leapfrog's own energy.
        (Case("opposite", "inverted cell", 1.0, 0.0, 60.0, "fixed"), "leapfrog"),
        # A start that a work limit can resolve only in part.
        (Case("grid", "stretched x 3", 1e4, 0.5, 30.0, "auto"), "extrapolated"),
        # Folded shut, where S8 is stiffest.
        (Case("crossed", "parameters change", 1.0, 0.5, 60.0, "auto"), "extrapolated"),
        (Case("crossed", "half in one point", 1.0, 0.5, 60.0, "fixed"), "leapfrog"),
        (Case("crossed", "half in one point", 100.0, 0.5, 60.0, "fixed"), "leapfrog"),
        # The same while a gripper does work.
        (Case("crossed", "zero-length springs", 100.0, 0.5, 60.0, "auto"), "extrapolated"),
        # A motion beyond the stability limit of the fixed step before its parameters change.
        (Case("crossed", "parameters change", 1.0, 0.5, 60.0, "fixed"), "leapfrog"),
        # All waves in phase: a change of the step must not make their energy oscillation permanent.
        (Case("grid", "stretched x 3", 1.0, 0.0, 30.0, "fixed"), "leapfrog"),
        # The same with longer steps after shorter ones.
        (Case("altitude", "crumpled", 1e4, 0.0, 60.0, "fixed"), "leapfrog"),
        # The same with intervals of one frame, each with its own step, beyond the work limit.
        (Case("crossed", "inverted cell", 100.0, 0.0, 60.0, "auto"), "extrapolated"),
    ],
    ids=lambda value: f"{value.sheet} {value.stress_case}" if isinstance(value, Case) else value,
)
def test_stress_cases_stay_finite_and_gain_no_energy(case: Case, integrator: str) -> None:
    result = run_case(case)
    assert result.finite, result.trouble
    assert result.gain <= MAX_ENERGY_GAIN
    assert integrator in result.integrators


@pytest.mark.parametrize(("stretch", "k_d0"), [(1.0, 0.0), (2.0, 0.2), (3.0, 1.0)])
def test_measured_step_limit_stays_close_to_its_bound(stretch: float, k_d0: float) -> None:
    plan, x = stretched_sheet(stretch, k_d0, resolution=8)
    bound = Leapfrog().step_limit(*plan.spectral_bounds(x))
    # The bisection is accurate to 0.2 %.
    assert 0.998 * bound <= measure_step_limit(plan, x, bound) <= (1.0 + LARGEST_EXCESS) * bound


def test_unsolvable_implicit_step_settles_at_equilibrium() -> None:
    """Coincident particles of a sheet too stiff for its steps must neither freeze nor gain energy."""
    plan, x = stretched_sheet(1.0, 0.5, resolution=6)
    state = State(x.T.copy())
    state.x = state.x.copy()
    state.x[:, 14] = state.x[:, 21]
    before = plan.energy(0.0, state.x, state.v)
    Implicit(tolerance=1e-6).advance(plan, state, 0.0, 0.5)
    assert plan.energy(0.0, state.x, state.v) < 0.05 * before
    assert np.isfinite(state.x).all()


def test_wind_acceleration_causes_no_smaller_steps() -> None:
    """Step control must not mistake energy from wind for an instability."""
    values = {"cloth.resolution": [12, 12], "wind.velocity": [0.0, 8.0, 0.0], "integrator": "leapfrog", "step": 2e-4}
    simulation = Simulation(Scene.from_parameters(values))
    for _ in range(3):
        done = simulation.advance().advance
        assert done is not None
        assert (done.rejected, done.steps) == (0, 84)


def _square(case: int) -> int:
    if case == 3:
        os._exit(1)
    if case == 4:
        time.sleep(60.0)
    return case * case


def test_case_pool_reports_timeouts_and_dead_processes() -> None:
    results = {case_result.case: case_result for case_result in CasePool(2, 1.0).run(_square, [1, 2, 3, 4, 5])}
    assert {case: case_result.result for case, case_result in results.items()} == {1: 1, 2: 4, 3: None, 4: None, 5: 25}
    assert results[3].trouble == "its process ended"
    assert results[4].trouble == "took longer than 1 s"


def test_random_cases_are_reproducible_and_within_the_scan() -> None:
    cases = random_cases(5, 200)
    assert cases == random_cases(5, 200) != random_cases(6, 200)
    assert {case.stress_case for case in cases} == {case.stress_case for case in all_cases()}
    assert {case.sheet for case in cases} == {case.sheet for case in all_cases()}
    assert all(1.0 <= case.stiffness <= 1e6 and 0.0 <= case.damping <= 3.0 for case in cases)
    assert all(30.0 <= case.rate <= 240.0 for case in cases)


def test_interrupted_scan_resumes_from_its_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """All results are in the file: the report contains them, and no case runs again."""
    result_file = tmp_path / "results.jsonl"
    first, second = all_cases()[:2]
    lines = []
    for case, gain in ((first, 0.0), (second, 0.5)):
        entry = {
            name: getattr(case, name) for name in ("sheet", "stress_case", "stiffness", "damping", "rate", "stepping")
        }
        result = {"integrators": ["leapfrog"], "finite": True, "strain": 0.1, "gain": gain}
        lines.append(json.dumps({"case": entry, "result": result, "seconds": 1.0, "trouble": ""}))
    result_file.write_text("\n".join([*lines, '{"cut off']))
    n_cases = len(all_cases())
    status = validation_command.main(["stability", "--parts", "scan", "--resume", str(result_file), "--only", "2"])
    output = capsys.readouterr().out
    assert status == 1
    assert f"2 cases of {n_cases}" in output
    assert "gains 0.5 of the energy turned over" in output
