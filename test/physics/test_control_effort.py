# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Work limit of a frame: clamped attempts fit it, and only reusable runs are discounted."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from cloth_sim_ros.physics.control.choice import Choice
from cloth_sim_ros.physics.control.effort import Effort
from cloth_sim_ros.physics.integrators.columns import SUMS

STEPS = 100


def effort(*, cap: float, evaluations: int) -> Effort:
    """Return the context of a sheet without contact, small enough for implicit steps."""
    beside: dict[str, Any] = dict.fromkeys(("state", "book", "stability", "energy", "precision", "hinges", "touch"))
    plan = SimpleNamespace(model=SimpleNamespace(particle_count=900))
    made: Any = Effort
    return made(
        options=SimpleNamespace(tolerance=1e-3),
        plan=plan,
        duration=1 / 60,
        cap=cap,
        part_cost=0.0,
        touches=False,
        evaluations=evaluations,
        **beside,
    )


def judged(columns: int, refine: float) -> float:
    """Return the force evaluations of an attempt with an error estimate."""
    return STEPS * refine * SUMS[columns + 1]


@pytest.mark.parametrize("refine", [1.0, 12.0])
def test_reusable_runs_are_not_counted_twice(refine: float) -> None:
    kept = int(STEPS * refine)
    whole = judged(1, refine)
    wanted, of = Choice(1, refine, True), effort(cap=whole + 1.0, evaluations=kept)
    assert of.fitted(wanted, judged, 0.0, kept) == wanted
    assert not of.spent
    # Without reuse the same attempt exceeds the limit.
    alone = effort(cap=whole + 1.0, evaluations=kept)
    alone.fitted(wanted, judged, 0.0)
    assert alone.spent


def test_reusable_runs_leave_no_work_for_other_refinements() -> None:
    kept, refine = 12 * STEPS, 12.0
    of = effort(cap=judged(1, refine) - 10.0, evaluations=kept)
    choice = of.fitted(Choice(1, refine, True), judged, 0.0, kept)
    assert choice.refine < refine
    assert kept + judged(choice.columns, choice.refine) <= of.cap
    assert of.spent
    assert not of.lost


def test_existing_longest_steps_may_exceed_the_limit_slightly() -> None:
    of = effort(cap=judged(1, 1.0) - 10.0, evaluations=STEPS)
    assert of.fitted(Choice(1, 1.0, True), judged, 0.0, STEPS).refine == 1.0
    assert of.spent
    assert not of.lost
