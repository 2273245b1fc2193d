# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a frame may still take: attempts fit its cap, and runs that are kept count only where they can be used."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from cloth_sim_ros.physics.control.choice import Choice
from cloth_sim_ros.physics.control.effort import Effort
from cloth_sim_ros.physics.integrators.columns import SUMS

STEPS = 100


def effort(*, cap: float, evaluations: int) -> Any:
    """Of a free sheet, which implicit steps could finish."""
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
    """Evaluations of an attempt that is judged."""
    return STEPS * refine * SUMS[columns + 1]


@pytest.mark.parametrize("refine", [1.0, 12.0])
def test_runs_that_are_kept_are_not_counted_twice(refine: float) -> None:
    kept = int(STEPS * refine)
    whole = judged(1, refine)
    wanted, of = Choice(1, refine, True), effort(cap=whole + 1.0, evaluations=kept)
    assert of.fitted(wanted, judged, 0.0, kept) == wanted
    assert not of.spent
    # Of runs that are not kept there is no room.
    alone = effort(cap=whole + 1.0, evaluations=kept)
    alone.fitted(wanted, judged, 0.0)
    assert alone.spent


def test_runs_that_are_kept_make_no_room_for_others() -> None:
    kept, refine = 12 * STEPS, 12.0
    of = effort(cap=judged(1, refine) - 10.0, evaluations=kept)
    choice = of.fitted(Choice(1, refine, True), judged, 0.0, kept)
    assert choice.refine < refine
    assert kept + judged(choice.columns, choice.refine) <= of.cap
    assert of.spent
    assert not of.lost


def test_longest_steps_that_are_there_are_judged_a_little_beyond_the_cap() -> None:
    of = effort(cap=judged(1, 1.0) - 10.0, evaluations=STEPS)
    assert of.fitted(Choice(1, 1.0, True), judged, 0.0, STEPS).refine == 1.0
    assert of.spent
    assert not of.lost
