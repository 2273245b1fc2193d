# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Forward kinematics of a robot, and bounds of what its links reach.

A joint's transform is linear in (1, sin q, cos q) for an angle q and in (1, q) for a displacement q. All of them follow
from one product; then they are chained from the root on. Fixed joints are folded into the transforms beside them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.scene.robot.description import ROTATING, Joint, Mimic, RobotDescription, cross_matrix, transform


class Kinematics:
    """Forward kinematics of a robot: transforms of bodies, rigidly joined links, from positions of joints.

    A body is what a movable joint carries, links of fixed joints included. Body 0 is the root's.
    """

    def __init__(self, description: RobotDescription) -> None:
        #: Body of each link, and the transform from the body's frame to the link's, shape (4, 4).
        self.placements: dict[str, tuple[int, Array]] = {description.root: (0, np.eye(4))}
        #: Parent body of each body from 1 on, and its joint.
        self._parents: list[int] = []
        self._joints: list[Joint] = []
        #: Transform from the parent body to each joint's frame.
        self._origins: list[Array] = []
        for joint in description.joints:
            body, placement = self.placements[joint.parent]
            if joint.is_movable:
                self._parents.append(body)
                self._joints.append(joint)
                self._origins.append(placement @ joint.origin)
                self.placements[joint.child] = (len(self._joints), np.eye(4))
            else:
                self.placements[joint.child] = (body, placement @ joint.origin)
        #: Names of the joints that have a position of their own.
        self.joint_names = tuple(joint.name for joint in self._joints if joint.mimic is None)
        self._named = {joint.name: joint for joint in self._joints}
        self._indices = {name: k for k, name in enumerate(self.joint_names)}
        self._constants = np.array([_constants(*pair) for pair in zip(self._origins, self._joints, strict=True)])
        self._constants.shape = (len(self._joints), 3, 16)
        self._is_rotating = np.array([joint.kind in ROTATING for joint in self._joints], dtype=bool)
        # Position of each joint: a multiple of that of an independent joint, plus an offset.
        sources = self._sources()
        self._source_indices = np.array([index for index, _, _ in sources], dtype=np.int64)
        self._multipliers = np.array([multiplier for _, multiplier, _ in sources])
        self._offsets = np.array([offset for _, _, offset in sources])

    def joint_positions(self, values: Mapping[str, float]) -> Array:
        """Convert joint positions by name to an array as `joint_names` [rad or m]; a missing one is 0 within limits."""
        joints = self._named
        return np.array(
            [
                float(values[name]) if name in values else min(max(0.0, joints[name].lower), joints[name].upper)
                for name in self.joint_names
            ]
        )

    def body_transforms(self, positions: Array, base: Array) -> Array:
        """Return transforms (bodies, 4, 4) of all bodies (rigidly joined links) at joint positions, the root at `base`.

        Args:
            positions: positions of `joint_names` [rad or m].
            base: transform of the root, shape (4, 4).
        """
        transforms = np.empty((len(self._joints) + 1, 4, 4))
        transforms[0] = base
        if not self._joints:
            return transforms
        q = self._multipliers * positions[self._source_indices] + self._offsets
        coefficients = np.ones((len(q), 1, 3))
        coefficients[:, 0, 1] = np.where(self._is_rotating, np.sin(q), q)
        coefficients[:, 0, 2] = np.where(self._is_rotating, np.cos(q), 0.0)
        locals_ = (coefficients @ self._constants).reshape(-1, 4, 4)
        for k, parent in enumerate(self._parents):
            np.dot(transforms[parent], locals_[k], out=transforms[k + 1])
        return transforms

    def bounding_ball(self, body: int, distance: float) -> tuple[Array, float]:
        """Return a ball, in the root's frame, that a point of a body never leaves: its centre (3,) and radius [m].

        The radius is the sum of the lengths between the joints on the way.

        Args:
            body: index of the body.
            distance: distance of the point from the body's origin [m].
        """
        radius, centre = distance, np.zeros(3)
        while body:
            joint, origin = self._joints[body - 1], self._origins[body - 1]
            if joint.kind not in ROTATING:
                radius += self._travel(body - 1)
            body = self._parents[body - 1]
            centre = origin[:3, 3]
            if body:
                radius += math.sqrt(float(centre @ centre))
        return centre, radius

    def moving_joints(self, body: int) -> list[int]:
        """Return the indices in `joint_names` of the joints that move a body, from the body on to the root."""
        indices: list[int] = []
        while body:
            indices.append(int(self._source_indices[body - 1]))
            body = self._parents[body - 1]
        return indices

    def _travel(self, index: int) -> float:
        """Return the largest displacement of a sliding joint [m]; infinite without limits."""
        joint = self._joints[index]
        source = self._named[self.joint_names[self._source_indices[index]]]
        multiplier, offset = self._multipliers[index], self._offsets[index]
        # 0 times an infinite limit is no number.
        ends = [(multiplier * end if multiplier else 0.0) + offset for end in (source.lower, source.upper)]
        return min(max(map(abs, ends)), max(abs(joint.lower), abs(joint.upper)))

    def _sources(self) -> list[tuple[int, float, float]]:
        """Return for each joint the index in `joint_names` that it follows, the multiplier and the offset."""
        sources = {name: (index, 1.0, 0.0) for name, index in self._indices.items()}
        for joint in self._joints:
            name, waiting = joint.name, list[tuple[str, Mimic]]()
            while name not in sources:
                mimic = self._named[name].mimic
                assert mimic is not None
                waiting.append((name, mimic))
                name = mimic.joint
            index, multiplier, offset = sources[name]
            for name, mimic in reversed(waiting):
                multiplier, offset = mimic.multiplier * multiplier, mimic.multiplier * offset + mimic.offset
                sources[name] = index, multiplier, offset
        return [sources[joint.name] for joint in self._joints]


def poses_of(transforms: Array) -> Array:
    """Convert transforms (n, 4, 4) to positions and unit quaternions x, y, z, w, shape (n, 7).

    The quaternion is the row of largest diagonal of 4 q q^T, divided by its length.
    """
    r = transforms[:, :3, :3]
    a, b, c, d, e, f, g, h, i = r.reshape(-1, 9).T
    products = np.empty((len(r), 4, 4))
    for k, diagonal in enumerate((1.0 + a - e - i, 1.0 - a + e - i, 1.0 - a - e + i, 1.0 + a + e + i)):
        products[:, k, k] = diagonal
    for k, m, entry in ((0, 1, b + d), (0, 2, c + g), (0, 3, h - f), (1, 2, f + h), (1, 3, c - g), (2, 3, d - b)):
        products[:, k, m] = products[:, m, k] = entry
    largest = np.argmax(np.einsum("nkk->nk", products), axis=1)
    rows = products[np.arange(len(r)), largest]
    poses = np.empty((len(r), 7))
    poses[:, :3] = transforms[:, :3, 3]
    poses[:, 3:] = rows / np.sqrt((rows * rows).sum(axis=1))[:, None]
    return poses


def transform_of(position: Sequence[float], orientation: Sequence[float]) -> Array:
    """Convert a position [m] and a unit quaternion x, y, z, w to a transform, shape (4, 4)."""
    from cloth_sim_ros.physics.plan.gripper_path import normalized, rotation_matrix

    return transform(position, rotation_matrix(normalized(orientation)))


def _constants(origin: Array, joint: Joint) -> Array:
    """Return the constants of a joint's transform: factors of 1, of sin q or q, and of cos q, shape (3, 4, 4)."""
    constants = np.zeros((3, 4, 4))
    constants[0, 3, 3] = 1.0
    if joint.kind in ROTATING:
        # R = 1 + sin q K + (1 - cos q) K^2
        k = cross_matrix(joint.axis)
        constants[0, :3, :3], constants[1, :3, :3], constants[2, :3, :3] = np.eye(3) + k @ k, k, -(k @ k)
    else:
        constants[0, :3, :3], constants[1, :3, 3] = np.eye(3), joint.axis
    return origin @ constants
