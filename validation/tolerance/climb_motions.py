# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Random scenes of few particles with moving obstacles, or with grippers that move, stop and turn."""

from __future__ import annotations

import json
from itertools import combinations
from typing import Any

import attrs
import numpy as np

from cloth_sim_ros import Grasp, Move, Scene, Target
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.gripper_path import normalized, rotated_by
from cloth_sim_ros.simulation.events import Event
from validation.tolerance.random_scenes import RandomScene, log_uniform

#: Longest time before a body moves [s].
_SETTLING = 0.6
#: Particles of a chain; a lattice has two rows of them.
_COLUMNS = 6
#: Index of its first particle, after two anchors and a particle that swings.
_FIRST = 3


@attrs.frozen(kw_only=True, eq=False)
class Shake:
    """Motion of a body: some frames of motion, then a pause, again and again."""

    #: First frame, and frames of motion and of pause.
    first: int
    motion: int
    pause: int
    #: True if every other motion goes back.
    reverses: bool
    #: Displacement [m] and rotation vector [rad] of one motion.
    displacement: Array
    rotation: Array

    @classmethod
    def random(cls, rng: np.random.Generator, first: int, normal_share: float) -> Shake:
        """Draw a motion; `normal_share`: largest ratio of its vertical to its horizontal displacement."""
        motion, pause = int(rng.integers(1, 5)), int(rng.integers(0, 9))
        angle, travel = float(rng.uniform(0.0, 2.0 * np.pi)), log_uniform(rng, 1e-5, 5e-2)
        vertical = normal_share * max(0.0, float(rng.uniform(-1.0, 1.0)))
        rotation = log_uniform(rng, 1e-4, 0.5) * rng.normal(size=3) if rng.random() < 0.4 else np.zeros(3)
        displacement = travel * np.array([np.cos(angle), np.sin(angle), vertical])
        reverses = bool(rng.random() < 0.6)
        return cls(
            first=first, motion=motion, pause=pause, reverses=reverses, displacement=displacement, rotation=rotation
        )

    @property
    def words(self) -> str:
        """Short description."""
        size, turn = 1e3 * np.linalg.norm(self.displacement), np.linalg.norm(self.rotation)
        pace = f"{size:.2g} mm and {turn:.2g} rad in {self.motion} of {self.motion + self.pause} frames"
        return f"{pace}{' to and fro' if self.reverses else ''}"

    def poses(self, frames: int, position: Array) -> dict[int, tuple[Array, list[float]]]:
        """Return positions [m] and quaternions (x, y, z, w) by the frame at whose end the body is there."""
        poses, orientation, sign = dict[int, tuple[Array, list[float]]](), [0.0, 0.0, 0.0, 1.0], 1.0
        for frame in range(self.first, frames):
            cycle, phase = divmod(frame - self.first, self.motion + self.pause)
            if phase < self.motion:
                sign = -1.0 if self.reverses and cycle % 2 else 1.0
                position = position + sign / self.motion * self.displacement
                turn = (sign / self.motion * self.rotation).tolist()
                orientation = normalized(rotated_by(orientation, turn)).tolist()
                poses[frame] = position, orientation
        return poses


def draw_shaken(rng: np.random.Generator) -> RandomScene:
    """Draw particles on an obstacle that moves; another particle may swing above it."""
    kind, thickness = str(rng.choice(["plane", "box", "sphere"])), log_uniform(rng, 1e-3, 1e-2)
    friction = float(rng.choice([0.0, log_uniform(rng, 0.03, 1.0), 4.0], p=[0.15, 0.65, 0.2]))
    radius = log_uniform(rng, 0.05, 0.5)
    tables, anchors, words = _draw_tables(rng, thickness * float(rng.uniform(2.0, 8.0)), is_hung=False)
    positions = np.array(tables["positions"])
    gap = thickness * float(rng.choice([rng.uniform(0.9, 1.0), rng.uniform(1.0, 2.0)], p=[0.8, 0.2]))
    positions[_FIRST:, 2] = gap
    if kind == "sphere":
        across = np.minimum(np.hypot(positions[_FIRST:, 0], positions[_FIRST:, 1]), 0.7 * radius)
        positions[_FIRST:, 2] = np.sqrt((radius + gap) ** 2 - across**2) - radius
    tables["positions"] = positions.tolist()
    values, files = _values(rng, tables, anchors)
    offset = Scene.from_parameters(values, files=files).starting_state().positions[0] - positions[0]
    heights = {"plane": 0.0, "box": -0.2, "sphere": -radius}
    # Part of the particles may lie beyond the edge of the box.
    edge = float(rng.uniform(-1.0, 1.0)) * thickness if rng.random() < 0.5 else -0.5
    center = offset + np.array([1.0 + edge if kind == "box" else 0.0, 0.0, heights[kind]])
    sizes = {"box": [2.0, 2.0, 0.4], "sphere": [radius]}
    values |= {"obstacles": ["thing"], "thing.shape": kind, "thing.position": center.tolist()}
    values |= {"thing.friction": [friction], "contact.thickness": thickness}
    values |= {"thing.size": sizes[kind]} if kind in sizes else {}
    shake = Shake.random(rng, int(rng.uniform(0.0, _SETTLING) * values["rate"]), 0.3)
    scene = Scene.from_parameters(values, files=files)
    state, first, frames = scene.starting_state(), shake.first, shake.first + round(scene.rate)
    poses = shake.poses(frames, center)
    events: dict[int, list[Event]] = {frame: [Move("thing", *pose)] for frame, pose in poses.items()}
    words = f"{kind}, friction {friction:.2g}, {words}, {shake.words}"
    return RandomScene(scene=scene, state=state, frames=frames, words=words, events=events, first=first)


def draw_prescribed(rng: np.random.Generator) -> RandomScene:
    """Draw particles in one or two grippers that prescribe their motion or are springs; another particle may swing."""
    spacing = log_uniform(rng, 0.01, 0.2)
    tables, anchors, words = _draw_tables(rng, spacing, is_hung=True)
    values, files = _values(rng, tables, anchors)
    names = [f"gripper{k}" for k in range(int(rng.choice([1, 2])))]
    values |= {
        "grippers": names,
        "gripper.model": str(rng.choice(["prescribed", "spring"], p=[0.6, 0.4])),
        "gripper.radius": spacing * float(rng.uniform(0.3, 2.5)),
        "gripper.stiffness": log_uniform(rng, 1.0, 1e4),
        "gripper.damping": float(rng.uniform(0.0, 2.0)),
        "gripper.max_speed": 0.0,
    }
    values |= {"gravity": [0.0, 0.0, 0.0]} if rng.random() < 0.4 else {}
    scene = Scene.from_parameters(values, files=files)
    state, first = scene.starting_state(), 1 + int(rng.uniform(0.0, _SETTLING) * scene.rate)
    frames, events, pace = first + round(scene.rate), dict[int, list[Event]](), list[str]()
    for name, particle in zip(names, (_FIRST, len(tables["positions"]) - 1), strict=False):
        center, shake = state.positions[particle], Shake.random(rng, first, 1.0)
        events.setdefault(0, []).extend([Target(name, center), Grasp(name, True)])
        for frame, pose in shake.poses(frames, center).items():
            events.setdefault(frame, []).append(Target(name, *pose))
        pace.append(shake.words)
    words = f"{values['gripper.model']}, {words}, {', '.join(pace)}"
    return RandomScene(scene=scene, state=state, frames=frames, words=words, events=events, first=first)


def _values(
    rng: np.random.Generator, tables: dict[str, Any], anchors: list[str]
) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Return parameters of raw springs with a drawn rate, tolerance and drag, and the springs' file."""
    values = {
        "rate": float(rng.integers(10, 121)),
        "tolerance": log_uniform(rng, 1e-6, 1e-2),
        "cloth.springs": "springs.yaml",
        "cloth.anchors": anchors,
        "cloth.size": [1.0, 1e-6],
        "cloth.orientation": [0.0, 0.0, 0.0, 1.0],
        "bending.model": "none",
        "air.drag": log_uniform(rng, 0.02, 5.0) if rng.random() < 0.3 else 0.0,
        "wind.normal_drag": 0.0,
        "grippers": [""],
    }
    return values, {"springs.yaml": json.dumps(tables).encode()}


def _draw_tables(rng: np.random.Generator, spacing: float, *, is_hung: bool) -> tuple[dict[str, Any], list[str], str]:
    """Draw a particle that swings below an anchor, and a chain or lattice along x, or hung along z.

    A weak joint may tie its last particle to another anchor.
    """
    rows, columns = int(rng.choice([1, 2], p=[0.7, 0.3])), int(rng.integers(1, _COLUMNS + 1))
    joint = log_uniform(rng, 0.02, 5.0) if rng.random() < 0.6 else 0.0
    swing, speed = log_uniform(rng, 1.0, 10.0), float(rng.uniform(0.0, 12.0)) if rng.random() < 0.7 else 0.0
    frequency, mass = log_uniform(rng, 1.0, 300.0), log_uniform(rng, 1e-2, 1.0)
    damping = float(rng.uniform(0.0, 2.0)) if rng.random() < 0.6 else 0.0
    slack = float(rng.choice([0.0, 1.0, rng.uniform(0.8, 1.2)]))
    nodes = [(row, column) for column in range(columns) for row in range(rows)]
    axes = np.array([[0.0, spacing, 0.0], [0.0, 0.0, -spacing] if is_hung else [spacing, 0.0, 0.0]])
    top = 1.0 + 9.81 / swing**2
    positions = [[0.0, 0.0, top], [0.0, 0.0, 1.0], [0.0, 0.0, 0.05], *(np.array(nodes, dtype=float) @ axes).tolist()]
    # Particles, rest length and stiffness of each spring.
    springs: list[tuple[list[int], float, float]] = [([0, 1], 0.0, mass * swing**2)]
    for (a, node), (b, end) in combinations(enumerate(nodes, _FIRST), 2):
        rows_apart, columns_apart = abs(node[0] - end[0]), abs(node[1] - end[1])
        if max(rows_apart, columns_apart) == 1:
            length = slack * spacing * float(np.hypot(rows_apart, columns_apart))
            springs.append(([a, b], length, mass * frequency**2 * (length or 1.0)))
    if joint:
        springs.append(([2, len(positions) - 1], 0.0, mass * joint**2))
    pairs, lengths, stiffness = zip(*springs, strict=True)
    tables = {
        "positions": positions,
        "velocities": [[0.0, 0.0, 0.0], [speed, 0.0, 0.0], *([[0.0, 0.0, 0.0]] * (len(nodes) + 1))],
        "masses": [mass] * len(positions),
        "springs": list(pairs),
        "rest_lengths": list(lengths),
        "stiffness": list(stiffness),
        "k_d0": damping,
    }
    words = f"{rows} x {columns} particles, {frequency:.2g}/s, joint {joint:.2g}/s, swing {swing:.2g}/s {speed:.2g} m/s"
    return tables, ["0", "2"], words
