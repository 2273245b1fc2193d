# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""End-point correction for the work of moving obstacles.

A run sums powers at the middles of its steps, times h. For a smooth power p from a to b this sum misses h^2/24 (p'(b) -
p'(a)) (Euler and Maclaurin). The slopes are those of the last half step and of the first one. Their inner ends are
positions that the run has visited. The correction also covers contact that begins within the last half step, after the
last middle.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cloth_sim_ros.physics.book import Book
from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.remembered import PINCHED
from cloth_sim_ros.physics.runs import Run
from cloth_sim_ros.physics.state import State


def note_runs(
    book: Book,
    plan: Plan,
    start: State,
    t: float,
    duration: float,
    runs: Sequence[Run],
    counts: Sequence[int],
    weights: Sequence[float],
) -> None:
    """Accumulate a weighted combination of runs, with end-point corrections for moving obstacles.

    Args:
        book: the accumulator.
        plan: equations of motion.
        start: state at the start.
        t: time at the start [s].
        duration: length of the interval [s].
        runs: the runs of the combination.
        counts: number of steps of each run.
        weights: dimensionless weight of each run.
    """
    book.add_runs(weights, runs, duration)
    if not book.obstacle_count or plan.contact is None or plan.contact.force.steady():
        return
    for weight, run, steps in zip(weights, runs, counts, strict=True):
        book.add_touches(weight * lacking(plan, start, run, t, duration, steps))


def lacking(plan: Plan, start: State, run: Run, t: float, duration: float, steps: int) -> Array:
    """Return the end-point correction of work and dissipation [J] of one run.

    The columns are those of `ContactBinding.wrench_rates`. Wrenches need no correction, because they are means of the
    impulses of the steps.

    Args:
        plan: equations of motion, with contact.
        start: state at the start.
        run: a run from that state.
        t: time at the start [s].
        duration: length of the run [s].
        steps: number of its steps.
    """
    contact = plan.contact
    assert contact is not None
    h = duration / steps
    contact.take(start)
    begin = _slope(plan, t, start.x, start.v, start.memory.get(PINCHED), 0.5 * h)
    contact.lay(run.anchors)
    end = _slope(plan, t + duration, run.x, run.v, run.pinched, -0.5 * h)
    missed: Array = (-h / 12.0) * (begin + end)
    missed[:, :6] = 0.0
    return missed


def _slope(plan: Plan, t: float, x: Array, v: Array, pads: Array | None, away: float) -> Array:
    """Return the change of the rates if the state moves on uniformly by a time `away` [s] from time t [s]."""
    contact = plan.contact
    assert contact is not None
    contact.lay_pads(pads)
    here = contact.rates(t, x, v)
    if pads is not None:
        contact.lay_pads(np.stack([pads[:, 0] + away * pads[:, 1], pads[:, 1]], axis=1))
    change: Array = contact.rates(t + away, x + away * v, v) - here
    return change
