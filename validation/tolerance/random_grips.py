# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Random gripper scripts: grasp, carry, turn, jump, hold still and release."""

from __future__ import annotations

import math

import attrs
import numpy as np
from support.random_meshes import drawn_alike

from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.gripper_path import normalized, quaternion_product
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Event, Grasp, Target
from cloth_sim_ros.simulation.simulation import Simulation

ACTIONS = ("carry", "turn", "jump", "hold", "swing")
#: Number of frames before a grasp in which the open gripper follows its particle.
APPROACH = 3


@attrs.frozen(kw_only=True, eq=False)
class GraspInterval:
    """Interval from the grasp of one particle to its release, and the actions in it."""

    gripper: str
    particle: int
    #: Frames before which the gripper grasps and releases.
    grasp: int
    release: int
    #: First frame, name and vector of each action; the vector's length is a distance [m] or an angle [rad].
    actions: tuple[tuple[int, str, Array], ...]
    #: Number of frames between targets.
    stride: int


@attrs.frozen(kw_only=True, eq=False)
class RandomGripScript:
    """Grasp intervals of a scene."""

    holds: tuple[GraspInterval, ...] = ()

    @classmethod
    def random(cls, rng: np.random.Generator, scene: Scene, frames: int, *, pace: float = 1.0) -> RandomGripScript:
        """Draw a script for a number of frames; `pace` scales the speeds."""
        rest_positions = scene.initial_positions()
        size = float(np.ptp(rest_positions, axis=0).max()) or 1.0
        rate = scene.rate
        holds = []
        for name in scene.gripper_names:
            frame = int(rng.uniform(0.0, 0.5) * rate)
            while frame < frames - 2:
                release = frame + max(2, int(rng.uniform(0.3, 2.0) * rate))
                actions, action_frame = [], frame + 1
                while action_frame < release:
                    action_name = str(rng.choice(ACTIONS))
                    direction = rng.normal(size=3)
                    reach = {"turn": 2.0, "jump": 0.25 * size}.get(action_name, 0.4 * size)
                    displacement = pace * rng.uniform(0.1, 1.0) * reach * direction / np.linalg.norm(direction)
                    actions.append((action_frame, action_name, displacement))
                    action_frame += max(2, int(rng.uniform(0.15, 0.8) * rate))
                stride = int(rng.choice([1, 1, 1, 2, 4]))
                holds.append(
                    GraspInterval(
                        gripper=name,
                        particle=int(rng.integers(len(rest_positions))),
                        grasp=frame,
                        release=release,
                        actions=tuple(actions),
                        stride=stride,
                    )
                )
                frame = release + max(2, int(rng.uniform(0.2, 1.0) * rate)) + APPROACH
        return cls(holds=tuple(holds))

    @property
    def words(self) -> str:
        """Short description."""
        grippers = {hold.gripper for hold in self.holds}
        return f"{len(grippers)} grippers, {len(self.holds)} holds" if grippers else "nothing held"

    def moments(self) -> list[int]:
        """Return the frames before which an action begins, sorted."""
        frames = {frame for hold in self.holds for frame in (hold.grasp, hold.release, *(a[0] for a in hold.actions))}
        return sorted(frames)


class RandomGripPlayer:
    """Player of a script on a simulation; a gripper's path starts at the particle's position at the grasp."""

    def __init__(self, script: RandomGripScript, simulation: Simulation) -> None:
        self._script, self._simulation = script, simulation
        self._orientations = {hold.gripper: np.array([0.0, 0.0, 0.0, 1.0]) for hold in script.holds}
        self._positions: dict[str, Array] = {}

    def events(self, frame: int) -> list[Event]:
        """Return the events before a frame, counted from 0."""
        events: list[Event] = []
        for hold in self._script.holds:
            if hold.grasp - APPROACH <= frame <= hold.grasp:
                events.append(self._target(hold.gripper, self._simulation.state.x[:, hold.particle].copy()))
            if frame == hold.grasp:
                events.append(Grasp(hold.gripper, True))
            elif frame == hold.release:
                events.append(Grasp(hold.gripper, False))
            elif hold.grasp < frame < hold.release and (frame - hold.grasp) % hold.stride == 0:
                events.append(self._follow(hold, frame))
        return events

    def _target(self, gripper: str, position: Array) -> Target:
        self._positions[gripper] = position
        return Target(gripper, drawn_alike(position), drawn_alike(self._orientations[gripper]))

    def _follow(self, hold: GraspInterval, frame: int) -> Target:
        position = self._positions[hold.gripper]
        begin, action_name, vector = [action for action in hold.actions if action[0] <= frame][-1]
        seconds = hold.stride * self._simulation.scene.period
        if action_name == "jump" and frame - hold.stride < begin:
            position = position + vector
        elif action_name == "carry":
            position = position + seconds * vector
        elif action_name == "swing":
            angle = 12.0 * (frame - begin) * self._simulation.scene.period
            position = position + seconds * 4.0 * math.cos(angle) * vector
        elif action_name == "turn":
            speed = float(np.linalg.norm(vector))
            half = 0.5 * seconds * speed
            step = (*(math.sin(half) * vector / speed).tolist(), math.cos(half))
            turned = normalized(quaternion_product(step, self._orientations[hold.gripper].tolist()))
            self._orientations[hold.gripper] = turned
        return self._target(hold.gripper, position)
