# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recovery of contacts that an event compresses or relieves.

Such a contact continues with a reduced thickness and regains the full one over time.
"""

from __future__ import annotations

from collections.abc import Sequence

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.contact.thickness import check_gaps, grown_thickness, recovery_time, reduced_thickness
from cloth_sim_ros.physics.model.forces.contact import Contact
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.state.controller_state import THICKNESS_KEY
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.event_checks import EventError

#: Radius around a released particle within which contacts are reduced, in longest edges of the cloth.
_REACH = 3.0


@attrs.frozen(kw_only=True)
class ContactRecovery:
    """Summary of the contacts with a reduced thickness: counterparts, particles, and time to the full thickness."""

    #: Names of the obstacles and pads in contact; "" is the cloth itself.
    names: tuple[str, ...]
    #: Number of particles with a reduced thickness; 0 if only edges of obstacles have one.
    particles: int
    #: Largest reduction [m]: the distance by which the bodies must separate to need no reduction.
    lift: float
    #: Time until every contact has the full thickness [s].
    duration: float

    def describe(self) -> str:
        """Return one sentence for the log: the affected contacts, the duration and the remedy."""
        counterparts = " and ".join(f"'{name}'" if name else "itself" for name in self.names)
        count = f"{self.particles} particle{'' if self.particles == 1 else 's'}" if self.particles else "no particle"
        return (
            f"closer than contact.thickness to {counterparts}: {count}; contact begins thinner there and grows to "
            f"contact.thickness in {self.duration:.3g} s or as soon as the cloth follows; move them "
            f"{1e3 * self.lift:.3g} mm apart to avoid it"
        )


def reduce_contacts(
    plan: Plan,
    state: State,
    t: float,
    subject: str = "",
    *,
    rows: NDArray[np.bool_] | None = None,
    relieved: NDArray[np.int64] | None = None,
) -> None:
    """Store in the state a reduced thickness of contacts that an event changes; raise EventError if one is too narrow.

    The reduced thickness is the one at which a contact stores the energy of the rest gap.

    Args:
        plan: its obstacles must stand at their poses of this time.
        state: keeps the reduced thickness.
        t: time [s].
        subject: first words of the error for a contact that is too narrow; "" checks nothing.
        rows: mask of the obstacles, pads and, last, the cloth itself that the event compresses. Without `rows` and
        `relieved` every contact counts.
        relieved: indices of particles that are pressed less than before; contacts near them count too.

    Raises:
        EventError: for a contact that is too narrow, naming the obstacle, the gap, the limit and the remedy.
    """
    old_thickness, contact = state.memory.pop(THICKNESS_KEY, None), plan.contact
    if contact is None or not contact.force.is_active:
        return
    gaps, thickness = contact.contact_gaps(t, state.x, state.memory), contact.force.thickness
    is_affected = np.full(gaps.shape, rows is None and relieved is None)
    if rows is not None:
        is_affected[rows] = True
    if relieved is not None:
        is_affected[:, np.append(_is_within_reach(contact.force, state.x, relieved), relieved.size > 0)] = True
    gaps[~is_affected] = np.inf
    if subject:
        try:
            check_gaps(gaps, thickness, _body_names(contact.force))
        except ValueError as error:
            raise EventError(f"{subject} {error}") from error
    reduced = reduced_thickness(gaps, thickness)
    if old_thickness is not None and old_thickness.shape == gaps.shape:
        bound = np.where(is_affected, thickness, old_thickness)
        reduced = bound if reduced is None else np.minimum(bound, reduced)
    if reduced is not None and (reduced < thickness).any():
        state.memory[THICKNESS_KEY] = reduced


def _is_within_reach(force: Contact, x: Array, particles: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return a mask (n,) of particles within `_REACH` edge lengths of given ones, at positions x [m], (3, n)."""
    surface = force.faces or force.surface
    reach = 0.0 if surface is None else _REACH * surface.max_edge
    is_near = np.zeros(x.shape[1], dtype=bool)
    for particle in particles.tolist():
        offsets = x - x[:, particle, None]
        is_near |= offsets[0] * offsets[0] + offsets[1] * offsets[1] + offsets[2] * offsets[2] <= reach * reach
    return is_near


def begin_recovery(plan: Plan, state: State, t: float, duration: float) -> None:
    """Let reduced contacts regain thickness in a frame of a duration [s] from time t [s], by the plan's controls."""
    contact = plan.contact
    if contact is None or (reduced := state.memory.get(THICKNESS_KEY)) is None:
        return
    gaps = contact.contact_gaps(t, state.x, state.memory)
    grown = grown_thickness(reduced, gaps, contact.force.thickness, duration)
    contact.force.start_recovery(t, duration, grown, reduced)


def end_recovery(plan: Plan, state: State, t: float) -> None:
    """Store in the state the contact thickness that its recovery reached in the frame that ended at time t [s]."""
    if plan.contact is None or (thickness := plan.contact.force.controls.recovery.target) is None:
        return
    force = plan.contact.force
    force.start_recovery(t)
    state.memory[THICKNESS_KEY] = thickness
    if not (thickness < force.thickness).any():
        del state.memory[THICKNESS_KEY]


def contact_recovery(plan: Plan, state: State) -> ContactRecovery | None:
    """Summarize the contacts of a state with a reduced thickness; return None if every contact has the full one."""
    reduced, contact = state.memory.get(THICKNESS_KEY), plan.contact
    if reduced is None or contact is None:
        return None
    thickness = contact.force.thickness
    is_reduced = reduced < thickness
    names = [*_body_names(contact.force), ""]
    in_contact = tuple(name for name, row in zip(names, is_reduced, strict=True) if row.any())
    particles = int(np.count_nonzero(is_reduced[:, :-1].any(axis=0)))
    lift, duration = thickness - float(reduced.min()), recovery_time(reduced, thickness)
    return ContactRecovery(names=in_contact, particles=particles, lift=lift, duration=duration)


def pad_rows(plan: Plan, gripper: str) -> NDArray[np.bool_]:
    """Return a mask of a gripper's pads, in rows of contact: obstacles, then pads, then the cloth itself."""
    assert plan.contact is not None
    return np.array([*(name.rpartition(".")[0] == gripper for name in _body_names(plan.contact.force)), False])


def compressed_rows(before: Scene, scene: Scene) -> NDArray[np.bool_]:
    """Return a mask of contact's rows (obstacles, pads, the cloth) whose shape or distance another scene changes."""
    pads = 2 * len(scene.pinching)
    gripper, old_gripper = scene.gripper, before.gripper
    pads_changed = (gripper.pad_size, gripper.opening) != (old_gripper.pad_size, old_gripper.opening)
    rows = [_contact_shape(before, name) != _contact_shape(scene, name) for name in scene.obstacle_names]
    is_compressed = np.array([*rows, *[pads_changed] * pads, scene.contact.self_ and not before.contact.self_])
    if scene.contact.thickness != before.contact.thickness or scene.cloth.anchors != before.cloth.anchors:
        is_compressed[:] = True
    return is_compressed


def relieved_particles(plan: Plan, state: State, t: float, before: Scene, scene: Scene) -> NDArray[np.int64]:
    """Return the indices of particles that lose a contact, or whose grip gets softer, by a change of scene.

    Such a particle touches an obstacle that the other scene lacks or reshapes, or is held by a softer gripper there.
    """
    particles = np.empty(0, dtype=np.int64)
    if scene.gripper.stiffness < before.gripper.stiffness:
        particles = state.memory["grip.particles"]
    is_gone = [_contact_shape(before, name) != _contact_shape(scene, name) for name in before.obstacle_names]
    return np.union1d(particles, particles_in_contact(plan, state, t, is_gone)) if any(is_gone) else particles


def particles_in_contact(plan: Plan, state: State, t: float, rows: Sequence[bool]) -> NDArray[np.int64]:
    """Return the indices of particles in contact with masked obstacles, the plan's first ones, at time t [s]."""
    assert plan.contact is not None
    gaps = plan.contact.contact_gaps(t, state.x, state.memory)[: len(rows), :-1][np.array(rows)]
    return np.flatnonzero((gaps < plan.contact.force.thickness).any(axis=0))


def _body_names(force: Contact) -> list[str]:
    """Return the names of the contact's rows except the last, the cloth: obstacles, then pads."""
    return [obstacle.name for obstacle in force.obstacles]


def _contact_shape(scene: Scene, name: str) -> object:
    """Return the parameters of an obstacle that its contact depends on; None if the scene lacks the obstacle."""
    if name not in scene.obstacle_names:
        return None
    return attrs.evolve(scene.described[name], frame="", friction=(0.0, 0.0))
