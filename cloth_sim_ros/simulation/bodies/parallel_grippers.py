# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pinching grippers of a simulation: state of their pads and their grasps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.contact.parallel_jaw import NO_SETPOINT, ParallelJaw
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.gripper_path import rotation_matrix
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.state.controller_state import JAWS_AT_REST_KEY, JAWS_KEY, SETPOINTS_KEY
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.simulation.bodies.grippers import GraspResult, Grippers
from cloth_sim_ros.simulation.bodies.kinematic_bodies import writable_copy
from cloth_sim_ros.simulation.bodies.obstacles import gaps
from cloth_sim_ros.simulation.events import Grasp

#: Pads are at rest if their speed and residual force are below this fraction of the drive's speed and force.
_REST_FRACTION = 1e-3


class ParallelGrippers:
    """Pads of the pinching grippers of one simulation; the state's memory keeps openings and speeds.

    Args:
        pads: pads of each pinching gripper; their order is that of every array.
        grippers: every gripper of the simulation.
        state: keeps the pads; missing entries are added, with open pads.
    """

    def __init__(self, pads: tuple[ParallelJaw, ...], grippers: Grippers, state: State) -> None:
        self.pads, self._state = pads, state
        self.names = [jaw.gripper for jaw in pads]
        self._indices = [grippers.names.index(name) for name in self.names]
        grippers.pad_reaches = {index: jaw.bounding_radius for index, jaw in zip(self._indices, pads, strict=True)}
        #: The pads as obstacles, two for each gripper.
        self.boxes = [box for jaw in pads for box in jaw.boxes()]
        state.memory.setdefault(JAWS_KEY, np.array([jaw.initial_state for jaw in pads]))
        state.memory.setdefault(JAWS_AT_REST_KEY, np.ones(len(pads), dtype=bool))
        if len(state.memory[JAWS_KEY]) != len(pads):
            raise ValueError(
                f"the state has {len(state.memory[JAWS_KEY])} grippers that pinch, the scene {len(pads)} "
                f"({', '.join(self.names)})"
            )

    def poses(self) -> Array:
        """Return the poses of all pads: position [m] and quaternion x, y, z, w, shape (pads, 7)."""
        memory, poses = self._state.memory, list[Array]()
        for jaw, index, (half_opening, _) in zip(self.pads, self._indices, memory[JAWS_KEY].tolist(), strict=True):
            poses += _pad_poses(jaw, memory["gripper.pose"][index], half_opening)
        return np.array(poses)

    def placed_pads(self) -> list[int]:
        """Return the indices of the pads whose gripper has a pose, because it has received a target."""
        placed = self._state.memory["gripper.placed"]
        return [2 * k + pad for k, index in enumerate(self._indices) if placed[index] for pad in range(2)]

    def pad_paths(self, paths: Array) -> Array:
        """Return for each pad the path of its gripper, shape (pads, PATH_NUMBERS), from the paths of all grippers."""
        return np.repeat(paths[self._indices], 2, axis=0)

    def drive_flags(self) -> NDArray[np.bool_]:
        """Return two flags by pinching gripper: it has a pose, and it closes; shape (pinching grippers, 2)."""
        memory = self._state.memory
        return np.stack([memory[name][self._indices] for name in ("gripper.placed", "gripper.closed")], axis=1)

    def move_pad_wrenches(self, obstacle_wrenches: Array, gripper_wrenches: Array) -> Array:
        """Add wrenches on pads, the last rows, to `gripper_wrenches` in place; return the rows of obstacles."""
        n_obstacles = len(obstacle_wrenches) - len(self.boxes)
        for k, index in enumerate(self._indices):
            left, right = obstacle_wrenches[n_obstacles + 2 * k : n_obstacles + 2 * k + 2]
            gripper_wrenches[index] += left + right
        return obstacle_wrenches[:n_obstacles]

    def setpoint(self, name: str) -> tuple[float, float, float]:
        """Return a gripper's commanded half opening [m], force [N], speed [m/s]; `NO_SETPOINT` without one."""
        setpoints = self.setpoints
        return NO_SETPOINT if setpoints is None else tuple(setpoints[self.names.index(name)].tolist())

    @property
    def setpoints(self) -> Array | None:
        """Commanded half opening [m], force [N] and speed [m/s] by gripper, shape (k, 3); None without commands."""
        return self._state.memory.get(SETPOINTS_KEY)

    def set_setpoint(self, event: Grasp) -> None:
        """Store the opening, force and speed that a grasp commands, or that it leaves them to the scene."""
        if event.opening is None and not event.force and not event.speed and self.setpoints is None:
            return
        self._state.memory.setdefault(SETPOINTS_KEY, np.array([NO_SETPOINT] * len(self.pads)))
        half_opening = NO_SETPOINT[0] if event.opening is None else 0.5 * event.opening
        writable_copy(self._state, SETPOINTS_KEY)[self.names.index(event.gripper)] = (
            half_opening,
            event.force,
            event.speed,
        )

    def drive_state(self, name: str) -> tuple[float, float, float]:
        """Return the distance between a gripper's pads [m], its rate [m/s], and the force of the drive at each pad [N].

        The force closes the pads if it is above 0.
        """
        k = self.names.index(name)
        half_opening, jaw_speed = self._state.memory[JAWS_KEY][k].tolist()
        _, force, speed = self.setpoint(name)
        jaw, direction = self.pads[k].with_limits(force, speed), 1.0 if self.drive_flags()[k, 1] else -1.0
        return 2.0 * half_opening, 2.0 * jaw_speed, jaw.force * (direction + jaw_speed / jaw.speed)

    def request_rest_result(self, name: str) -> None:
        """Request an entry in a later `rest_results` when the pads of a gripper come to rest."""
        writable_copy(self._state, JAWS_AT_REST_KEY)[self.names.index(name)] = False

    def grasped_count(self, plan: Plan, t: float, name: str) -> int:
        """Return the number of particles between a gripper's pads: the smaller contact count of both pads."""
        contact, k = plan.contact, self.names.index(name)
        if contact is None or not self.drive_flags()[k].all():
            return 0
        counts = contact.obstacle_gaps(t, self._state.x, self._state.memory)[contact.force.n_solids + 2 * k :][:2, 0]
        return int(counts.min())

    def rest_results(self, plan: Plan, t: float) -> list[GraspResult]:
        """Return requested results of pads that came to rest in the frame that ended at time t [s], each once.

        Pads that open entirely are not reported.
        """
        is_rested = self._state.memory[JAWS_AT_REST_KEY]
        if is_rested.all() or plan.contact is None:
            return []
        results, is_driven = [], self.drive_flags()
        x, v, memory = self._state.x, self._state.v, self._state.memory
        accelerations = plan.contact.jaw_accelerations(t, x, v, memory).tolist()
        for k, (pads, (half_opening, jaw_speed)) in enumerate(zip(self.pads, memory[JAWS_KEY].tolist(), strict=True)):
            is_placed, is_closed = is_driven[k].tolist()
            setpoint, force, speed = self.setpoint(pads.gripper)
            if is_rested[k] or not is_placed or not (is_closed or setpoint >= 0.0):
                continue
            jaw = pads.with_limits(force, speed)
            is_moving = abs(jaw_speed) > _REST_FRACTION * jaw.speed
            if is_moving or abs(accelerations[k]) * jaw.inertia > _REST_FRACTION * 2.0 * jaw.force:
                continue
            writable_copy(self._state, JAWS_AT_REST_KEY)[k] = True
            n_grasped = self.grasped_count(plan, t, jaw.gripper)
            thickness = plan.contact.force.thickness
            is_at_stop = half_opening < jaw.half_opening_range(True, setpoint, thickness)[0] + 0.25 * thickness
            reached = not is_closed or (is_at_stop and (n_grasped == 0 or setpoint > 0.0))
            reason = ""
            if setpoint > 0.0 and reached:
                reason = f"its pads are {2.0 * setpoint:.4g} m apart, as commanded"
            elif not n_grasped:
                reason = "its pads closed with no particle between them"
            results.append(GraspResult(jaw.gripper, is_closed, n_grasped, reason, reached=reached))
        return results


def check_first_pose(jaw: ParallelJaw, pose: Array, state: State) -> Array:
    """Return the poses (2, 7) of open pads at a gripper's first pose; raise ValueError if particles are inside a pad.

    Returns:
        Position [m] and quaternion x, y, z, w, shape (2, 7).

    Raises:
        ValueError: naming the pad and the deepest particle.
    """
    pad_poses = _pad_poses(jaw, pose, jaw.initial_state[0])
    for box, pad_pose in zip(jaw.boxes(), pad_poses, strict=True):
        gap = gaps(box, pad_pose, state.x, max_distance=0.0)
        particle = int(np.argmin(gap))
        if gap[particle] <= 0.0:
            position = [round(c, 6) for c in state.x[:, particle].tolist()]
            raise ValueError(
                f"{box.name} would be in the cloth: particle {particle} at {position} is {-gap[particle]:.4g} m deep "
                "in it; begin where the open gripper is clear of the cloth"
            )
    return np.array(pad_poses)


def _pad_poses(jaw: ParallelJaw, pose: Array, half_opening: float) -> list[Array]:
    """Return the poses of both pads of a gripper; `half_opening`: half the distance between their faces [m]."""
    axis, offset = rotation_matrix(pose[3:])[:, 1], half_opening + 0.5 * jaw.size[1]
    return [np.concatenate([pose[:3] + sign * offset * axis, pose[3:]]) for sign in (1.0, -1.0)]
