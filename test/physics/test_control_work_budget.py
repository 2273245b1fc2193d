# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Work limit of a frame: clamped attempts fit it, and only reusable runs are discounted."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from cloth_sim_ros.physics.control.advance_context import AdvanceContext
from cloth_sim_ros.physics.control.step_choice import StepChoice
from cloth_sim_ros.physics.integrators.extrapolation_tableau import RATIO_SUMS

STEPS = 100


def context(*, cap: float, evaluations: int) -> AdvanceContext:
    """Return the context of a sheet without contact, small enough for implicit steps."""
    empty_fields: dict[str, Any] = dict.fromkeys(
        ("state", "accumulator", "stability", "energy", "precision", "multirate", "contact_limit")
    )
    plan = SimpleNamespace(model=SimpleNamespace(particle_count=900))
    context_class: Any = AdvanceContext
    return context_class(
        options=SimpleNamespace(tolerance=1e-3),
        plan=plan,
        duration=1 / 60,
        max_evaluations=cap,
        part_call_work=0.0,
        may_touch=False,
        evaluations=evaluations,
        **empty_fields,
    )


def work_of(n_runs: int, refinement: float) -> float:
    """Return the force evaluations of an attempt with an error estimate."""
    return STEPS * refinement * RATIO_SUMS[n_runs + 1]


@pytest.mark.parametrize("refinement", [1.0, 12.0])
def test_reusable_runs_are_not_counted_twice(refinement: float) -> None:
    reusable = int(STEPS * refinement)
    whole = work_of(1, refinement)
    choice, reusing = StepChoice(1, refinement, True), context(cap=whole + 1.0, evaluations=reusable)
    assert reusing.clamp(choice, work_of, 0.0, reusable) == choice
    assert not reusing.exhausted
    # Without reuse the same attempt exceeds the limit.
    without_reuse = context(cap=whole + 1.0, evaluations=reusable)
    without_reuse.clamp(choice, work_of, 0.0)
    assert without_reuse.exhausted


def test_reusable_runs_leave_no_work_for_other_refinements() -> None:
    reusable, refinement = 12 * STEPS, 12.0
    clamped = context(cap=work_of(1, refinement) - 10.0, evaluations=reusable)
    choice = clamped.clamp(StepChoice(1, refinement, True), work_of, 0.0, reusable)
    assert choice.refinement < refinement
    assert reusable + work_of(choice.n_runs, choice.refinement) <= clamped.max_evaluations
    assert clamped.exhausted
    assert not clamped.abandoned


def test_existing_longest_steps_may_exceed_the_limit_slightly() -> None:
    clamped = context(cap=work_of(1, 1.0) - 10.0, evaluations=STEPS)
    assert clamped.clamp(StepChoice(1, 1.0, True), work_of, 0.0, STEPS).refinement == 1.0
    assert clamped.exhausted
    assert not clamped.abandoned
