# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Contacts that an event finds compressed: they go on with a reduced thickness and regain the whole one."""

from __future__ import annotations

import attrs

from cloth_sim_ros.physics.contact_thickness import check_gaps, recovery_time, reduced_thickness, regained
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.remembered import THICKNESS
from cloth_sim_ros.physics.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.event_checks import EventError


@attrs.frozen(kw_only=True)
class ContactRecovery:
    """Contacts of a state with a reduced thickness."""

    #: Names of the obstacles that they are with, "the cloth itself" for its own.
    names: tuple[str, ...]
    #: Number of particles that have one; 0 where edges of obstacles alone have.
    particles: int
    #: Largest difference to the whole thickness [m]: further apart by that, none has a reduced one.
    lift: float
    #: Until all have the whole thickness [s].
    duration: float


def reduce_contacts(plan: Plan, state: State, t: float, *, limited: bool) -> None:
    """Let contacts that hold more than the rest gap's energy go on with a reduced thickness, at time t [s].

    Args:
        plan: whose obstacles stand where they are at that time.
        state: which keeps the thickness.
        t: time [s].
        limited: whether contacts that are too narrow are refused.

    Raises:
        EventError: for such a contact; the end of a sentence about the cloth.
    """
    state.memory.pop(THICKNESS, None)
    contact = plan.contact
    if contact is None or not contact.force.acts:
        return
    contact.take(state)
    gaps, thickness = contact.gap_rows(t, state.x), contact.force.thickness
    if limited:
        try:
            check_gaps(gaps, thickness, [obstacle.name for obstacle in contact.force.obstacles])
        except ValueError as error:
            raise EventError(str(error)) from error
    reduced = reduced_thickness(gaps, thickness)
    if reduced is not None:
        state.memory[THICKNESS] = reduced


def recover_contacts(plan: Plan, state: State, t: float, duration: float) -> None:
    """Let the contacts of a state regain their thickness over a frame that ended at time t [s]."""
    contact = plan.contact
    if contact is None:
        return
    contact.force.recover(t, 0.0)
    reduced = state.memory.pop(THICKNESS, None)
    after = None if reduced is None else regained(reduced, contact.force.thickness, duration)
    if after is not None:
        state.memory[THICKNESS] = after


def contact_recovery(plan: Plan, state: State) -> ContactRecovery | None:
    """Return what is known of a state's contacts with a reduced thickness; None where there are none."""
    reduced, contact = state.memory.get(THICKNESS), plan.contact
    if reduced is None or contact is None:
        return None
    thickness = contact.force.thickness
    below = reduced < thickness
    named = [*(obstacle.name for obstacle in contact.force.obstacles), "the cloth itself"]
    return ContactRecovery(
        names=tuple(name for name, row in zip(named, below, strict=True) if row.any()),
        particles=int(below[:, :-1].any(axis=0).sum()),
        lift=thickness - float(reduced.min()),
        duration=recovery_time(reduced, thickness),
    )


def touches_differ(before: Scene, scene: Scene) -> bool:
    """Whether two scenes differ in what contact keeps apart, or how far."""
    return _surfaces(before) != _surfaces(scene)


def _surfaces(scene: Scene) -> tuple[object, ...]:
    obstacles = [(name, attrs.evolve(scene.described[name], frame="")) for name in scene.obstacle_names]
    contact = scene.contact
    return (
        obstacles,
        contact.self_,
        contact.thickness,
        scene.gripper.pad_size,
        scene.gripper.opening,
        scene.cloth.anchors,
    )
