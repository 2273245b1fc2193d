# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What grippers, obstacles and moving air do over a step of the implicit method: the sums that a book notes."""

from __future__ import annotations

import attrs
import numpy as np

from cloth_sim_ros.engine.binding import BOOKED_NUMBERS
from cloth_sim_ros.physics.book import Book
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
    #: Whether the force of its one stage acts all the way that a gripper or an obstacle goes in the step.
    whole: bool = False


def acted(plan: Plan, t: float, h: float, done: Step) -> tuple[Array, Array]:
    """Return the time integrals over a step of a length h [s] from time t on, of each gripper and of each obstacle, as
    `Plan.grip_rates` has their rates.

    The implicit Euler method moves by the force f at its end, so the impulse is h f. What the force's end moves by, w,
    makes its work f'w: the energy E of a spring between the two, convex as it is, grows by at most f'(w - h u), and the
    kinetic energy by at most h f'u. So no energy comes from nowhere, however far w is.
    """
    grips, touches = np.zeros((plan.gripper_count, BOOKED_NUMBERS)), np.zeros((0, BOOKED_NUMBERS))
    contact = plan.contact
    if contact is not None:
        touches = np.zeros((contact.count, BOOKED_NUMBERS))
    for moment, weight, x, v in done.stages:
        if plan.gripper_count:
            grips += plan.grip_rates(moment, x, v, weight)
        if contact is not None:
            touches += contact.rates(moment, x, v, weight)
    if done.whole:
        for rows, paths in (
            (grips, None if plan.grips is None else plan.grips.paths),
            (touches, None if contact is None else contact.force.paths),
        ):
            for row, path in zip(rows, () if paths is None else paths, strict=True):
                if row.any():
                    row[6] = -in_order([a * b / h for a, b in zip(row[:6].tolist(), way_over(path, t, h), strict=True)])
    return grips, touches


def work(plan: Plan, t: float, h: float, done: Step) -> float:
    """Return the work of grippers, of obstacles and of moving air over a step [J]."""
    total = in_order([weight * plan.supply(moment, x, v) for moment, weight, x, v in done.stages])
    for rows in acted(plan, t, h, done):
        total = in_order(rows[:, 6].tolist(), total)
    return total


def note(book: Book, plan: Plan, t: float, h: float, done: Step) -> None:
    """Note a step of a length h [s] that began at time t."""
    grips, touches = acted(plan, t, h, done)
    lost = given = rubbed = 0.0
    for moment, weight, x, v in done.stages if book.powers else ():
        powers = plan.powers(moment, x, v)
        lost, given = lost + weight * powers[0], given + weight * powers[1]
        rubbed += weight * plan.contact.rubbed(x, v) if plan.contact is not None else 0.0
    book.add(grips, touches if book.obstacle_count else touches[:0], (lost, given), h, rubbed)
