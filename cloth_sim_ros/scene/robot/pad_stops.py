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
#: Largest number of joints that move two pads of one hand relative to each other. More are those of two arms, whose
#: joints must not stop.
_MAX_HAND_JOINTS = 8


@with_old_names(stopped="limit_positions")
class PadStops:
    """Limit of a robot's finger joints: their pads stay at least `robot.pad_gap` contact thicknesses apart.

    Two pads are a pair if they belong to one hand and different joints move them. Pads that more than eight joints move
    relative to each other belong to two arms. Each side of a cloth's layer then has half the gap, and its contact
    pushes back. Without stops a closed gripper would crush the layer, and all obstacles would stop. Pads of two hands,
    and of two links of one finger, may come closer.

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
            if len(joints) <= _MAX_HAND_JOINTS:
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
        result = positions.copy()
        poses = self._links.poses(result)
        for a, b, joints in self._pairs:
            if self._gap(a, b, poses) >= self._min_gap:
                continue
            if self.accepted is None:
                break
            open_positions = result.copy()
            open_positions[joints] = self.accepted[joints]
            result = open_positions + self._fraction(a, b, open_positions, result) * (result - open_positions)
            poses = self._links.poses(result)
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
    points = features.points @ rotation_matrix(features_pose[3:]).T + features_pose[:3]
    return float(solid.distance(to_body_frame(pose, points.T))[0].min()) - features.radius
