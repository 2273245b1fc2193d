# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""External work over a step of the implicit method: grippers, obstacles, air, contact recovery."""

from __future__ import annotations

import attrs

from cloth_sim_ros.physics import book as books
from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.gripper_path import way_over
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.powers import in_order


@attrs.frozen
class Step:
    """One step: positions [m] and velocities [m/s] at its end, last acceleration [m/s^2], error estimate [m]."""

    x: Array
    v: Array
    a: Array
    error: float
    #: Times [s], weights [s], positions and velocities of the points at which its forces act.
    stages: tuple[tuple[float, float, Array, Array], ...]
    #: True if the contact force of the last point acts during the whole step, while obstacles move and contacts grow.
    whole: bool = False


def pushed(plan: Plan, t: float, h: float, done: Step) -> Array:
    """Return impulse and work of obstacles over a step whose contact force is that at its end.

    The impulse of the implicit Euler method is h f, and the work is f'w with the displacement w of the obstacle. The
    contact energy is convex; it grows by at most f'(w - h u), and the kinetic energy by at most h f'u. Therefore the
    step creates no energy for any w. Forces inside the step would belong to gaps that no step has resolved; they are
    unbounded.

    Args:
        plan: equations of motion.
        t: time at the start of the step [s].
        h: its length [s].
        done: the step.

    Returns:
        Rows as of `ContactBinding.wrench_rates`.
    """
    contact = plan.contact
    assert contact is not None
    moment, _, x, v = done.stages[-1]
    rows = contact.rates(moment, x, v, h)
    for row, path in zip(rows, contact.force.paths, strict=True):
        if row.any():
            row[6] = -in_order([a * b / h for a, b in zip(row[:6].tolist(), way_over(path, t, h), strict=True)])
    return rows


def recovered(plan: Plan, h: float, done: Step) -> float:
    """Return the work of contacts that regain their thickness over such a step [J].

    It is the power at the end of the step times its length. The contact energy d_i^2 b(g / d_i) is convex in gap and
    thickness together, because 2 b b'' > b'^2. Therefore this is an upper bound of the added energy, see
    `obstacle_work_rates`.
    """
    moment, _, x, v = done.stages[-1]
    return 0.0 if plan.contact is None else h * plan.contact.recovering(moment, x, v)


def work(plan: Plan, t: float, h: float, done: Step) -> float:
    """Return the work of grippers, obstacles, moving air and growing contacts over a step [J]; see `accumulate`."""
    total = 0.0
    for moment, weight, x, v in done.stages:
        total += weight * plan.supply(moment, x, v)
        if plan.gripper_count:
            total = in_order(plan.grip_rates(moment, x, v, weight)[:, 6].tolist(), total)
        if plan.contact is not None and not done.whole:
            total = in_order(plan.contact.rates(moment, x, v, weight)[:, 6].tolist(), total)
            total += weight * plan.contact.recovering(moment, x, v)
    if not done.whole:
        return total
    return in_order(pushed(plan, t, h, done)[:, 6].tolist(), total) + recovered(plan, h, done)


def note(book: books.Book, plan: Plan, t: float, h: float, done: Step) -> None:
    """Accumulate a step of length h [s] that starts at time t [s]."""
    for moment, weight, x, v in done.stages:
        books.note(book, plan, moment, x, v, weight, touches=not done.whole)
    if done.whole and book.obstacle_count:
        book.add_touches(pushed(plan, t, h, done))
    if done.whole and book.powers:
        book.add_recovered(recovered(plan, h, done))
