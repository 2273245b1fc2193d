# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Random scenes with all kinds of contact, and their parameter changes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock

import numpy as np

from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.state.controller_state import ANCHORS_KEY
from cloth_sim_ros.simulation.simulation import Frame, Simulation

#: Number of sizes by shape of obstacle.
SIZES = {"plane": 0, "box": 3, "sphere": 1, "capsule": 2, "cylinder": 2}


def random_obstacles(random: np.random.Generator) -> list[str]:
    """Return the names of random obstacles in random order."""
    names = [f"{shape}_1" for shape in SIZES if random.random() < 0.5]
    return [str(name) for name in random.permutation(names)] or [""]


def contact_values(random: np.random.Generator, values: dict[str, Any]) -> dict[str, Any]:
    """Return parameters of a small cloth just above a floor with obstacles.

    Grippers pinch or attach, and self-contact is on or off, with equal probability.
    """
    rows, columns = (int(n) for n in random.integers(3, 7, 2))
    spacing = float(random.uniform(0.03, 0.06))
    size = [spacing * (rows - 1), spacing * (columns - 1)]
    thickness = float(random.uniform(0.1, 0.4)) * spacing
    contact_parameters = {
        **values,
        "rate": float(random.choice([60.0, 120.0])),
        "tolerance": 1e-2,
        "cloth.size": size,
        "cloth.resolution": [rows, columns],
        "cloth.position": [0.0, 0.0, 0.02],
        "cloth.orientation": [0.0, 0.0, float(random.uniform(-1.0, 1.0)), 1.0],
        "contact.thickness": thickness,
        "contact.damping": float(random.uniform(0.0, 20.0)),
        "contact.self": bool(random.random() < 0.5),
        "gripper.mode": str(random.choice(["attach", "pinch"])),
        "gripper.pad_size": (random.uniform(2.0, 3.0, 3) * [spacing, 0.01, spacing]).tolist(),
        "gripper.opening": float(random.uniform(2.5, 5.0)) * thickness,
        "gripper.force": float(random.uniform(0.1, 2.0)),
        "gripper.speed": float(random.uniform(0.05, 0.5)),
    }
    for shape, count in SIZES.items():
        name = f"{shape}_1"
        contact_parameters[f"{name}.shape"] = shape
        if count:
            contact_parameters[f"{name}.size"] = random.uniform(0.02, 0.1, count).tolist()
        obstacle_position = (
            [0.0, 0.0, 0.0] if shape == "plane" else (0.15 * random.normal(size=3) + [0.0, 0.0, 0.1]).tolist()
        )
        contact_parameters[f"{name}.position"] = obstacle_position
        contact_parameters[f"{name}.friction"] = [float(random.choice([0.0, random.uniform(0.0, 1.0)]))]
    return {**contact_parameters, "obstacles": random_obstacles(random)}


def change(random: np.random.Generator) -> dict[str, Any]:
    """Return a random change of contact parameters during a run."""
    name = f"{random.choice(list(SIZES))}_1"
    changes: list[dict[str, Any]] = [
        {"obstacles": random_obstacles(random)},
        {f"{name}.friction": [float(random.uniform(0.0, 1.0))]},
        {"contact.damping": float(random.uniform(0.0, 20.0))},
        {"contact.thickness": float(random.uniform(0.004, 0.01))},
        {"gripper.force": float(random.uniform(0.1, 2.0))},
    ]
    return changes[random.integers(len(changes))]


class Coverage:
    """Counts sessions by the features of contact that occurred; called with each frame."""

    def __init__(self) -> None:
        self.sessions: Counter[str] = Counter()
        self._seen: set[str] = set()

    def __call__(self, simulation: Simulation, frame: Frame) -> None:
        gaps, contact = simulation.gaps(), simulation.plan.contact
        if gaps is None or contact is None or not frame.moved:
            return
        contacted = [solid for solid, (count, _) in zip(contact.force.obstacles, gaps, strict=True) if count]
        self._seen.update("a pad" if k.name.endswith((".left", ".right")) else f"a {k.shape}" for k in contacted)
        anchors = simulation.state.memory.get(ANCHORS_KEY)
        if anchors is not None and anchors[: len(gaps), 3].any():
            self._seen.add("friction on obstacles")
        if contact.self_gaps(simulation.state.x)[0]:
            self._seen.add("the cloth itself")
        if any(result.grasped_count for result in frame.pinches):
            self._seen.add("a closed pinch that holds")
        if frame.stopped:
            self._seen.add("obstacles or grippers halted")
        if frame.advance is not None and frame.advance.flagged:
            self._seen.add("flagged frames")

    def close(self) -> None:
        """Add the features of a finished session to the counts."""
        self.sessions.update(self._seen)
        self._seen.clear()

    def __str__(self) -> str:
        return ", ".join(f"{feature} {count}" for feature, count in sorted(self.sessions.items()))


@contextmanager
def threads(count: int) -> Iterator[None]:
    """Set the number of threads of every run."""
    with mock.patch.object(Plan, "threads", return_value=count):
        yield
