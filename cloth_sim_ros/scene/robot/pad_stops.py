# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Stops of a robot's fingers: pads keep room for a layer of cloth between them."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from cloth_sim_ros.physics.contact.obstacle_features import ObstacleFeatures, obstacle_features
from cloth_sim_ros.physics.contact.obstacles import Obstacle
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.old_names import with_old_names
from cloth_sim_ros.physics.plan.gripper_path import rotation_matrix, to_body_frame
from cloth_sim_ros.scene.robot.links import RobotLinks
from cloth_sim_ros.scene.scene import Scene

#: Bisections of a step of the joints: they find the stop within 1 % of the step.
_BISECTIONS = 7
#: Difference step of a joint for the derivative of the gap [rad or m].
_DERIVATIVE_STEP = 1e-6
#: Corrections of a position along the stop, and their excess over the smallest gap as a fraction of it.
_CORRECTIONS, _EXCESS = 3, 0.01


@with_old_names(stopped="limit_positions")
class PadStops:
    """Limit of a robot's finger joints: their pads stay at least `robot.pad_gap` contact thicknesses apart.

    Two pads are a pair if they belong to one hand and different joints move them. Single pads of two arms are a pair
    too. Each side of a cloth's layer then has half the gap, and its contact pushes back. Without stops a closed gripper
    would crush the layer, and all obstacles would stop. Pads of two hands, and of two links of one finger, may come
    closer.

    A stop takes only the closing part of a motion away. Joints that move both pads alike go on. So two arms carry what
    is between their palms, and fingers turn it.

    Args:
        scene: has the pads as obstacles, `robot.pads`, `robot.pad_gap` and `contact.thickness`.
        links: the links of its robot.
    """

    def __init__(self, scene: Scene, links: RobotLinks) -> None:
        self._links, self._thickness = links, scene.contact.thickness
        self._min_gap = scene.robot.pad_gap * self._thickness
        solids = {solid.name: solid for solid in scene.solids}
        pads = [k for k, link in enumerate(links.links) if link in scene.robot.pads and links.names[k] in solids]
        self._solids = {k: solids[links.names[k]] for k in pads}
        self._features = self._features_of_pads()
        #: Pairs of pads, and the joints that move one relative to the other.
        self._pairs: list[tuple[int, int, list[int]]] = []
        bodies = {k: links.kinematics.placements[links.links[k]][0] for k in pads}
        chains = {k: links.kinematics.moving_joints(bodies[k]) for k in pads}
        opposite = [
            (a, b)
            for a, b in combinations(pads, 2)
            if bodies[a] != bodies[b] and not _one_carries(chains[a], chains[b])
        ]
        # A pad shares more joints with the pads of its hand than with others.
        common = {pair: len(set(chains[pair[0]]) & set(chains[pair[1]])) for pair in opposite}
        most = {k: max((count for pair, count in common.items() if k in pair), default=0) for k in pads}
        for a, b in opposite:
            if not common[a, b] == most[a] == most[b]:
                continue
            # Fingers that mimic one joint share all joints; that one is the last of them.
            last = chains[max((a, b), key=bodies.__getitem__)]
            joints = sorted(set(chains[a]) ^ set(chains[b])) or last[:1]
            self._pairs.append((a, b, joints))
        #: Positions of the joints in force [rad or m]; None before the first ones.
        self.accepted: Array | None = None

    def update(self, scene: Scene) -> None:
        """Take the contact thickness, and with it the smallest gap between pads, from a changed scene."""
        if scene.contact.thickness != self._thickness:
            self._thickness = scene.contact.thickness
            self._min_gap = scene.robot.pad_gap * self._thickness
            self._features = self._features_of_pads()

    def limit_positions(self, positions: Array) -> Array:
        """Return joint positions that bring no pair of pads closer than permitted, or than before; remember them.

        Args:
            positions: commanded positions of the robot's joints [rad or m].
        """
        if not self._pairs:
            return positions
        result, has_slid = positions.copy(), False
        poses = self._links.poses(result)
        for a, b, joints in self._pairs:
            if self._gap(a, b, poses) >= self._min_gap:
                continue
            if self.accepted is None:
                break
            open_positions = result.copy()
            open_positions[joints] = self.accepted[joints]
            stopped = open_positions + self._fraction(a, b, open_positions, result) * (result - open_positions)
            if len(joints) > 1:
                stopped, has_slid = self._slide(a, b, joints, stopped, result), True
            result = stopped
            poses = self._links.poses(result)
        if has_slid and self.accepted is not None and self._is_any_too_close(poses):
            # Pairs with a common finger push it to each other. The accepted positions keep every gap.
            common = sorted({joint for _, _, joints in self._pairs for joint in joints})
            result[common] = self.accepted[common]
        self.accepted = result
        return result

    def _fraction(self, a: int, b: int, start: Array, end: Array) -> float:
        """Return the largest fraction of a joint step, start to end, at which two pads keep their smallest gap."""

        def is_open(fraction: float) -> bool:
            return self._gap(a, b, self._links.poses(start + fraction * (end - start))) >= self._min_gap

        low, high = 0.0, 1.0
        # Closed fingers stay at their stop in most frames.
        if not is_open(0.5**_BISECTIONS):
            return low
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if is_open(middle) else (low, middle)
        return low

    def _slide(self, a: int, b: int, joints: list[int], stopped: Array, end: Array) -> Array:
        """Return joint positions on the way from a stop to `end`, without the motion that closes two pads.

        Each joint makes a fraction of its step, from -1 to 1. Joints that close the pads make less of it. A joint
        without a step stands. The pads move by the smallest gap at most relative to each other, so that they do not
        pass each other. The stop itself is returned if no such position keeps the gap.
        """
        poses, step = self._links.poses(stopped), (end - stopped)[joints]
        gap, slopes = self._gap(a, b, poses), np.zeros(len(joints))
        for k, joint in enumerate(joints):
            if step[k]:
                moved = stopped.copy()
                moved[joint] += _DERIVATIVE_STEP
                slopes[k] = (self._gap(a, b, self._links.poses(moved)) - gap) / _DERIVATIVE_STEP * step[k]
        square = float(slopes @ slopes)
        if not square:
            return stopped
        result, scale = stopped.copy(), 1.0
        fractions = np.clip(1.0 - min(0.0, float(slopes.sum())) / square * slopes, -1.0, 1.0)
        result[joints] += fractions * step
        travel = self._travel(a, b, poses, self._links.poses(result))
        if travel > self._min_gap:
            scale = self._min_gap / travel
        for _ in range(_CORRECTIONS):
            result[joints] = stopped[joints] + scale * fractions * step
            gap = self._gap(a, b, self._links.poses(result))
            if gap >= self._min_gap:
                return result
            excess = ((1.0 + _EXCESS) * self._min_gap - gap) / (scale * square)
            fractions = np.clip(fractions + excess * slopes, -1.0, 1.0)
        return stopped

    def _travel(self, a: int, b: int, before: Array, after: Array) -> float:
        """Return the largest displacement of a point of one pad relative to the other [m]."""
        moved = _points_in(after[b], self._features[a], after[a]) - _points_in(before[b], self._features[a], before[a])
        return float(np.sqrt((moved * moved).sum(axis=0)).max())

    def _is_any_too_close(self, poses: Array) -> bool:
        return any(self._gap(a, b, poses) < self._min_gap for a, b, _ in self._pairs)

    def _features_of_pads(self) -> dict[int, ObstacleFeatures]:
        return {k: obstacle_features(solid, self._thickness) for k, solid in self._solids.items()}

    def _gap(self, a: int, b: int, poses: Array) -> float:
        """Return the least distance of the points of one pad from the other [m] at poses (count, 7), or a bound."""
        solid_a, solid_b = self._solids[a], self._solids[b]
        features_a, features_b = self._features[a], self._features[b]
        offset = poses[a, :3] - poses[b, :3]
        distance = float(np.sqrt(offset @ offset)) - solid_a.bounding_radius - solid_b.bounding_radius
        if distance > self._min_gap:
            return distance
        return min(
            _min_gap_of(solid_b, poses[b], features_a, poses[a]), _min_gap_of(solid_a, poses[a], features_b, poses[b])
        )


def _one_carries(first: list[int], second: list[int]) -> bool:
    """Return True if one of two pads carries the other, by the joints that move each, as from `moving_joints`."""
    short, long = sorted((first, second), key=len)
    return len(short) < len(long) and long[len(long) - len(short) :] == short


def _min_gap_of(solid: Obstacle, pose: Array, features: ObstacleFeatures, features_pose: Array) -> float:
    """Return the least gap between an obstacle and the points of another one's features [m]."""
    return float(solid.distance(_points_in(pose, features, features_pose))[0].min()) - features.radius


def _points_in(pose: Array, features: ObstacleFeatures, features_pose: Array) -> Array:
    """Return the points of an obstacle's features in the frame of another one's pose [m], shape (3, n)."""
    points = features.points @ rotation_matrix(features_pose[3:]).T + features_pose[:3]
    return to_body_frame(pose, points.T)
