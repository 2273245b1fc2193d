# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pinching grippers of a simulation: state of their pads and their grasps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.gripper_path import rotation_matrix
from cloth_sim_ros.physics.pinch import Pads
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.remembered import PINCHED, SETTLED
from cloth_sim_ros.physics.state import State
from cloth_sim_ros.simulation.grippers import GraspResult, Grippers
from cloth_sim_ros.simulation.movers import renewed
from cloth_sim_ros.simulation.obstacles import gaps

#: Pads are at rest if their speed and residual force are below this fraction of the drive's speed and force.
_AT_REST = 1e-3


class Pinching:
    """Pads of the pinching grippers of one simulation. Everything that changes is in ``state.memory``.

    Args:
        pads: pads of each pinching gripper; their order is that of every array.
        grippers: every gripper of the simulation.
        state: keeps the pads; missing entries are added, with open pads.
    """

    def __init__(self, pads: tuple[Pads, ...], grippers: Grippers, state: State) -> None:
        self.pads, self._state = pads, state
        self.names = [each.gripper for each in pads]
        self._indices = [grippers.names.index(name) for name in self.names]
        grippers.reaches = {index: each.reach for index, each in zip(self._indices, pads, strict=True)}
        #: The pads as obstacles, two for each gripper.
        self.boxes = [box for each in pads for box in each.boxes()]
        state.memory.setdefault(PINCHED, np.array([each.start for each in pads]))
        state.memory.setdefault(SETTLED, np.ones(len(pads), dtype=bool))
        if len(state.memory[PINCHED]) != len(pads):
            raise ValueError(
                f"the state has {len(state.memory[PINCHED])} grippers that pinch, the scene {len(pads)} "
                f"({', '.join(self.names)})"
            )

    def poses(self) -> Array:
        """Return the poses of all pads: position [m] and quaternion x, y, z, w, shape (pads, 7)."""
        memory, found = self._state.memory, list[Array]()
        for pads, index, (way, _) in zip(self.pads, self._indices, memory[PINCHED].tolist(), strict=True):
            found += _places(pads, memory["gripper.pose"][index], way)
        return np.array(found)

    def shown(self) -> list[int]:
        """Return the indices of the pads whose gripper is placed."""
        placed = self._state.memory["gripper.placed"]
        return [2 * k + side for k, index in enumerate(self._indices) if placed[index] for side in range(2)]

    def rows(self, paths: Array) -> Array:
        """Return the gripper path of each pad, from the paths of all grippers."""
        return np.repeat(paths[self._indices], 2, axis=0)

    def driven(self) -> NDArray[np.bool_]:
        """Return for each pinching gripper if it is placed and if it closes, shape (pinching grippers, 2)."""
        memory = self._state.memory
        return np.stack([memory[name][self._indices] for name in ("gripper.placed", "gripper.closed")], axis=1)

    def take_over(self, loads: Array, wrenches: Array) -> Array:
        """Add the wrenches on pads, the last rows, to those of their grippers; return the wrenches on obstacles."""
        solids = len(loads) - len(self.boxes)
        for k, index in enumerate(self._indices):
            wrenches[index] += loads[solids + 2 * k] + loads[solids + 2 * k + 1]
        return loads[:solids]

    def unsettle(self, name: str) -> None:
        """Request a report when the pads of a gripper come to rest."""
        renewed(self._state, SETTLED)[self.names.index(name)] = False

    def held(self, plan: Plan, t: float, name: str) -> int:
        """Return the number of particles between a gripper's pads: the smaller contact count of both pads."""
        contact, k = plan.contact, self.names.index(name)
        if contact is None or not self.driven()[k].all():
            return 0
        counts = contact.gaps_of(self._state, t)[contact.force.solid_count + 2 * k :][:2, 0]
        return int(counts.min())

    def settle(self, plan: Plan, t: float) -> list[GraspResult]:
        """Return results of the grippers whose closed pads came to rest in the frame that ended at time t [s]."""
        settled = self._state.memory[SETTLED]
        if settled.all() or plan.contact is None:
            return []
        found, driven = [], self.driven()
        plan.contact.take(self._state)
        pushed = plan.contact.pad_accelerations(t, self._state.x, self._state.v).tolist()
        for k, (pads, (_, rate)) in enumerate(zip(self.pads, self._state.memory[PINCHED].tolist(), strict=True)):
            if settled[k] or not driven[k].all():
                continue
            if abs(rate) > _AT_REST * pads.speed or abs(pushed[k]) * pads.inertia > _AT_REST * 2.0 * pads.force:
                continue
            renewed(self._state, SETTLED)[k] = True
            held = self.held(plan, t, pads.gripper)
            reason = "" if held else "its pads closed with no particle between them"
            found.append(GraspResult(pads.gripper, True, held, reason))
        return found


def check_placed(pads: Pads, pose: Array, state: State) -> Array:
    """Return the poses of a gripper's open pads at its first pose. Refuse a pose with particles inside a pad.

    Returns:
        Position [m] and quaternion x, y, z, w, shape (2, 7).

    Raises:
        ValueError: naming the pad and the deepest particle.
    """
    places = _places(pads, pose, pads.start[0])
    for box, place in zip(pads.boxes(), places, strict=True):
        gap = gaps(box, place, state.x, within=0.0)
        particle = int(np.argmin(gap))
        if gap[particle] <= 0.0:
            where = [round(c, 6) for c in state.x[:, particle].tolist()]
            raise ValueError(
                f"{box.name} would be in the cloth: particle {particle} at {where} is {-gap[particle]:.4g} m deep in "
                "it; begin where the open gripper is clear of the cloth"
            )
    return np.array(places)


def _places(pads: Pads, pose: Array, way: float) -> list[Array]:
    """Return the poses of both pads of a gripper at a pose; `half_opening`: half the distance between the pads' faces
    [m].
    """
    axis, out = rotation_matrix(pose[3:])[:, 1], way + 0.5 * pads.size[1]
    return [np.concatenate([pose[:3] + side * out * axis, pose[3:]]) for side in (1.0, -1.0)]
