# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Joints (S4) between particles and obstacles.

A joint is a grip whose gripper is an obstacle. Its point on the obstacle is where the particle was when the joint
began: at the start, or when the obstacle was added.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.model.controls import Grasps, GripControls
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.state.controller_state import JOINTS_KEY
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.build import attachment_points, joint_grasps, obstacle_joints
from cloth_sim_ros.scene.scene import Scene


class ObstacleJoints:
    """Spring joints (S4) between particles and the present obstacles.

    Args:
        scene: gives the joints, at least one.
        masses: particle masses [kg], shape (n,).
        state: keeps the joints' points; new ones are added.

    Raises:
        ValueError: for a state with another number of joints.
    """

    def __init__(self, scene: Scene, masses: Array, state: State) -> None:
        joints, self._state = obstacle_joints(scene, scene.sheet), state
        if JOINTS_KEY not in state.memory:
            state.memory[JOINTS_KEY] = _points(joints, scene, state)
        n_points = len(state.memory[JOINTS_KEY])
        if n_points != len(joints):
            raise ValueError(f"the state has {n_points} joints to obstacles, the scene {len(joints)} (cloth.joints)")
        #: Joined obstacles, by index.
        self.obstacles, self._joints = joint_grasps(scene, joints, masses, state.memory[JOINTS_KEY])
        #: Grasped particles of grippers, then the joints.
        self._grasps: Grasps | None = None

    def gripper_grasps(self, present: Grasps) -> Grasps:
        """Return the part of the plan's present grasps that belongs to grippers, without the joints."""
        return present.source[0] if present is self._grasps else present

    def extend(self, grips: GripControls, obstacle_paths: Array) -> GripControls:
        """Return the controls of grippers, followed by those of the joints to obstacles, as further grips.

        Args:
            grips: controls of the grippers.
            obstacle_paths: paths of all obstacles, shape (obstacles, PATH_NUMBERS).
        """
        offsets, joints, grasps, extended = self._state.memory[JOINTS_KEY], self._joints, grips.grasps, self._grasps
        if extended is None or extended.source[0] is not grasps or extended.source[1] is not offsets:
            extended = self._grasps = Grasps(
                np.concatenate([grasps.starts, grasps.starts[-1] + joints.starts[1:]]),
                np.concatenate([grasps.particles, joints.particles]),
                np.concatenate([grasps.offsets, offsets]),
                np.concatenate([grasps.stiffness, joints.stiffness]),
                np.concatenate([grasps.damping, joints.damping]),
                (grasps, offsets),
                _with_joints(grasps.prescribed, len(offsets)),
            )
        return GripControls(np.concatenate([grips.paths, obstacle_paths[self.obstacles]]), extended)

    def move_wrenches(self, grip_wrenches: Array, obstacle_wrenches: Array) -> tuple[Array, Array]:
        """Add the joints' wrenches to copies of their obstacles'; return the wrenches on grippers and on obstacles.

        Args:
            grip_wrenches: wrenches on grippers and then on joined obstacles, shape (grippers + joined obstacles, 6).
            obstacle_wrenches: wrenches on all obstacles, shape (obstacles, 6).
        """
        gripper_count = len(grip_wrenches) - len(self.obstacles)
        total = obstacle_wrenches.copy()
        total[self.obstacles] += grip_wrenches[gripper_count:]
        return grip_wrenches[:gripper_count], total


def _with_joints(prescribed: NDArray[np.bool_] | None, count: int) -> NDArray[np.bool_] | None:
    """Return the flags of prescribed particles, followed by False for each of `count` joints, which are springs."""
    return None if prescribed is None else np.concatenate([prescribed, np.zeros(count, dtype=np.bool_)])


def replace_joints(state: State, before: Scene, scene: Scene) -> None:
    """Replace the joints in a state's memory by those of another scene; joints that remain keep their points.

    The state has the obstacles of the other scene already. Without joints in memory it stays unchanged.
    """
    if JOINTS_KEY not in state.memory:
        return
    state.memory = dict(state.memory)
    old_joints, old_points = obstacle_joints(before, before.sheet), state.memory.pop(JOINTS_KEY)
    joints = obstacle_joints(scene, scene.sheet)
    if not joints:
        return
    points = _points(joints, scene, state)
    for k, joint in enumerate(joints):
        if joint in old_joints:
            points[k] = old_points[old_joints.index(joint)]
    state.memory[JOINTS_KEY] = points


def _points(joints: list[tuple[str, int]], scene: Scene, state: State) -> Array:
    """Return the particles' present positions in the frames of their obstacles [m], shape (joints, 3)."""
    return attachment_points(joints, scene.obstacle_names, state.memory["obstacle.pose"], state.x)
