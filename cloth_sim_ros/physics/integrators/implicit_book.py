# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What grippers, obstacles, moving air and growing contacts do over a step of the implicit method."""

from __future__ import annotations

import attrs

from cloth_sim_ros.physics import book as books
from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.gripper_path import way_over
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.powers import in_order


@attrs.frozen
class Step:
    """One step: positions and velocities at its end, its last acceleration, and its estimated error [m]."""

    x: Array
    v: Array
    a: Array
    error: float
    #: Times, weights, positions and velocities of the points at which its forces act.
    stages: tuple[tuple[float, float, Array, Array], ...]
    #: Whether contact acts by the force of the last of these alone, all the way that obstacles go and contacts grow.
    whole: bool = False


def pushed(plan: Plan, t: float, h: float, done: Step) -> Array:
    """Return what obstacles did over a step of a length h [s] from time t on that moves by their force at its end, as
    `Touching.rates` has rates.

    Implicit Euler's impulse is h f. The work is f'w, w being the way of the obstacle: contact's energy, convex as it
    is, grows by at most f'(w - h u), and the kinetic energy by at most h f'u. So no energy comes from nowhere, however
    far w is. Forces on the way would be those of gaps that no step has followed, without limit.
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
    """Return what contacts that regain their thickness did over such a step [J].

    It is the power at its end, all the time: contact's energy d_i^2 b(g / d_i) is convex in gap and thickness together,
    because 2 b b'' > b'^2, so that this is no less than what a growing thickness adds; see `pushed`.
    """
    moment, _, x, v = done.stages[-1]
    return 0.0 if plan.contact is None else h * plan.contact.recovering(moment, x, v)


def work(plan: Plan, t: float, h: float, done: Step) -> float:
    """Return the work of grippers, obstacles, moving air and growing contacts over a step [J], as a book notes it."""
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
    """Note a step of a length h [s] that began at time t."""
    for moment, weight, x, v in done.stages:
        books.note(book, plan, moment, x, v, weight, touches=not done.whole)
    if done.whole and book.obstacle_count:
        book.add_touches(pushed(plan, t, h, done))
    if done.whole and book.powers:
        book.add_recovered(recovered(plan, h, done))
