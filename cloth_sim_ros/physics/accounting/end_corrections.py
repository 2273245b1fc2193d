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

from cloth_sim_ros.physics.accounting.work_accumulator import WorkAccumulator
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.plan.runs import Run
from cloth_sim_ros.physics.state.controller_state import ANCHORS_KEY, JAWS_KEY, StateMemory, drift_jaws
from cloth_sim_ros.physics.state.state import State


def accumulate_runs(
    accumulator: WorkAccumulator,
    plan: Plan,
    start: State,
    t: float,
    duration: float,
    runs: Sequence[Run],
    counts: Sequence[int],
    weights: Sequence[float],
) -> None:
    """Add wrench and work integrals of combined runs to an accumulator, with end corrections for moving obstacles.

    Args:
        accumulator: the accumulator.
        plan: equations of motion.
        start: state at the start.
        t: time at the start [s].
        duration: length of the interval [s].
        runs: the runs of the combination.
        counts: number of steps of each run.
        weights: dimensionless weight of each run.
    """
    accumulator.add_runs(weights, runs, duration)
    if not accumulator.obstacle_count or plan.contact is None or plan.contact.force.steady():
        return
    for weight, run, steps in zip(weights, runs, counts, strict=True):
        accumulator.add_obstacle_work(weight * end_correction(plan, start, run, t, duration, steps))


def end_correction(plan: Plan, start: State, run: Run, t: float, duration: float, steps: int) -> Array:
    """Return the end-point correction (Euler-Maclaurin) of obstacles' work and dissipation [J], shape (obstacles, 8).

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
    h, ends = duration / steps, {ANCHORS_KEY: run.anchors, JAWS_KEY: run.jaw_states}
    begin = _rate_change(plan, t, start.x, start.v, start.memory, 0.5 * h)
    end_memory = {**start.memory, **{key: array for key, array in ends.items() if array is not None}}
    end = _rate_change(plan, t + duration, run.x, run.v, end_memory, -0.5 * h)
    correction: Array = (-h / 12.0) * (begin + end)
    correction[:, :6] = 0.0
    return correction


def _rate_change(plan: Plan, t: float, x: Array, v: Array, memory: StateMemory, offset: float) -> Array:
    """Return the change of obstacles' wrenches and powers (obstacles, 8) from t to t + offset [s] at constant v."""
    contact = plan.contact
    assert contact is not None
    rates = contact.wrench_rates(t, x, v, memory)
    change: Array = contact.wrench_rates(t + offset, x + offset * v, v, drift_jaws(memory, offset)) - rates
    return change
