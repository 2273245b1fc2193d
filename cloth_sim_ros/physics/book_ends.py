# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Noting runs, and what their sums lack of the work of obstacles that move.

A run notes powers at the middles of its steps, h times each. Of a smooth power p from a to b that misses
h^2/24 (p'(b) - p'(a)), by the formula of Euler and Maclaurin. The slopes are those of the last half step and of the
first one, whose inner ends are places that the run has been at. What comes into contact within the last half step,
which no middle sees, is counted by this, too.
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
    """Note a combination of runs by weights, each of so many steps, over a duration [s] from a state at time t [s]."""
    book.add_runs(weights, runs, duration)
    if not book.obstacle_count or plan.contact is None or plan.contact.force.steady():
        return
    for weight, run, steps in zip(weights, runs, counts, strict=True):
        book.add_touches(weight * lacking(plan, start, run, t, duration, steps))


def lacking(plan: Plan, start: State, run: Run, t: float, duration: float, steps: int) -> Array:
    """Return what a run's sums lack of work and loss [J], in the columns that `Touching.rates` has for them.

    Wrenches lack nothing: they are means of the impulses that the steps gave.

    Args:
        plan: equations of motion, with contact.
        start: state at the start.
        run: what was run from it.
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
    """Return by how much rates change over a time [s] from a state at time t [s] on, without forces."""
    contact = plan.contact
    assert contact is not None
    contact.lay_pads(pads)
    here = contact.rates(t, x, v)
    if pads is not None:
        contact.lay_pads(np.stack([pads[:, 0] + away * pads[:, 1], pads[:, 1]], axis=1))
    change: Array = contact.rates(t + away, x + away * v, v) - here
    return change
