# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Wrenches and work of an implicit step."""

from __future__ import annotations

import attrs

from cloth_sim_ros.physics.accounting.work_accumulator import WorkAccumulator, accumulate
from cloth_sim_ros.physics.arithmetic.deterministic_math import ordered_sum
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.gripper_path import step_displacement
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.state.controller_state import StateMemory


@attrs.frozen
class ImplicitStep:
    """Result of an implicit step: end positions [m], velocities [m/s], last acceleration [m/s^2], error [m]."""

    x: Array
    v: Array
    a: Array
    error: float
    #: Times [s], weights [s], positions and velocities of the points at which its forces act.
    stages: tuple[tuple[float, float, Array, Array], ...]
    #: True if the contact force of the last point acts during the whole step, while obstacles move and contacts grow.
    acts_at_end: bool = False


def _obstacle_impulses(plan: Plan, t: float, h: float, step: ImplicitStep, memory: StateMemory) -> Array:
    """Return impulse and work of each obstacle, (obstacles, 8), in a step whose contact force is that at its end.

    The impulse of the implicit Euler method is h f, and the work is f'w with the displacement w of the obstacle. The
    contact energy is convex; it grows by at most f'(w - h u), and the kinetic energy by at most h f'u. Therefore the
    step creates no energy for any w. Forces inside the step would belong to gaps that no step has resolved; they are
    unbounded.

    Args:
        plan: equations of motion.
        t: time at the start of the step [s].
        h: its length [s].
        step: the step.
        memory: memory of the state at its start.

    Returns:
        Rows as of `ContactBinding.wrench_rates`.
    """
    contact = plan.contact
    assert contact is not None
    end_time, _, x, v = step.stages[-1]
    rows = contact.wrench_rates(end_time, x, v, memory, h)
    for row, path in zip(rows, contact.force.paths, strict=True):
        if row.any():
            displacement = step_displacement(path, t, h)
            row[6] = -ordered_sum([a * b / h for a, b in zip(row[:6].tolist(), displacement, strict=True)])
    return rows


def _recovery_work(plan: Plan, h: float, step: ImplicitStep, memory: StateMemory) -> float:
    """Return the work [J] of contacts that regain their thickness in a step whose contact force is that at its end.

    It is the power at the end of the step times its length. The contact energy d_i^2 b(g / d_i) is convex in gap and
    thickness together, because 2 b b'' > b'^2. Therefore this is an upper bound of the added energy, see
    `_obstacle_impulses`.
    """
    end_time, _, x, v = step.stages[-1]
    return 0.0 if plan.contact is None else h * plan.contact.recovery_power(end_time, x, v, memory)


def external_work(plan: Plan, t: float, h: float, step: ImplicitStep, memory: StateMemory) -> float:
    """Return the work [J] of grippers, obstacles, moving air and growing contacts on the cloth over a step."""
    total = 0.0
    for stage_time, weight, x, v in step.stages:
        total += weight * plan.external_power(stage_time, x, v, memory)
        if plan.gripper_count:
            rates = plan.grip_wrench_rates(stage_time, x, v, weight, memory)
            total = ordered_sum(rates[:, 6].tolist(), total)
        if plan.contact is not None and not step.acts_at_end:
            total = ordered_sum(plan.contact.wrench_rates(stage_time, x, v, memory, weight)[:, 6].tolist(), total)
            total += weight * plan.contact.recovery_power(stage_time, x, v, memory)
    if not step.acts_at_end:
        return total
    total = ordered_sum(_obstacle_impulses(plan, t, h, step, memory)[:, 6].tolist(), total)
    return total + _recovery_work(plan, h, step, memory)


def accumulate_step(
    accumulator: WorkAccumulator, plan: Plan, t: float, h: float, step: ImplicitStep, memory: StateMemory
) -> None:
    """Add the wrenches and work of a step from t to t + h [s] to an accumulator."""
    for stage_time, weight, x, v in step.stages:
        accumulate(accumulator, plan, stage_time, x, v, weight, memory, record_obstacles=not step.acts_at_end)
    if step.acts_at_end and accumulator.obstacle_count:
        accumulator.add_obstacle_work(_obstacle_impulses(plan, t, h, step, memory))
    if step.acts_at_end and accumulator.record_power:
        accumulator.add_recovery_work(_recovery_work(plan, h, step, memory))
