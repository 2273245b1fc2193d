# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Contact stress cases: fast obstacles, pinching, crushing and small initial gaps."""

from __future__ import annotations

from typing import Any

import numpy as np

from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.simulation.events import Event, Grasp, Move, Target
from validation.stability.stress_cases import YANK_SPEED, StressCase, StressFrame, no_events, unchanged

#: Contact thickness in these cases [m]: the cells of the cloth are 0.14 m wide.
THICKNESS = 0.01
#: Gaps relative to the thickness: of the start at an obstacle, of the folded start, and of the crushing plates.
START_GAP, FOLDED_GAP, CRUSHED_GAP = 0.021, 0.3, 0.3
_COMMON: dict[str, Any] = {"cloth.resolution": [8, 8], "contact.thickness": THICKNESS, "gripper.max_speed": 0.0}
_PLATE: dict[str, Any] = {"shape": "box", "size": [1.2, 0.1, 1.2], "friction": [0.5, 0.4]}


def _plate(name: str, y: float) -> dict[str, Any]:
    """Return the parameters of a plate parallel to the sheet, its centre at y [m]."""
    return {**{f"{name}.{key}": value for key, value in _PLATE.items()}, f"{name}.position": [0.0, y, 1.0]}


def _folded(rest_positions: Array, random: np.random.Generator) -> Array:
    """Mirror the lower half onto the upper one at a small gap."""
    changed = rest_positions.copy()
    fold_height = rest_positions[:, 2].mean()
    lower = rest_positions[:, 2] < fold_height
    changed[lower, 1] += FOLDED_GAP * THICKNESS
    changed[lower, 2] = 2.0 * fold_height - rest_positions[lower, 2]
    return changed


def _drive_through(frame: StressFrame) -> list[Event]:
    return [Move("crate", (0.0, 0.8, 1.0))] if frame.is_first_after(0.05) else []


def _pinch_and_yank(frame: StressFrame) -> list[Event]:
    """Close the jaws on the free corner, and yank them away."""
    if frame.is_first_after(0.0):
        return [Target("gripper", frame.corner), Grasp("gripper", True)]
    if 0.2 <= frame.t < 0.3:
        displacement = YANK_SPEED * (frame.t - 0.2 + frame.period) * np.array([0.0, 0.8, 0.6])
        return [Target("gripper", frame.corner + displacement)]
    return []


def _crush(frame: StressFrame) -> list[Event]:
    if frame.is_first_after(0.05):
        y = 0.05 + CRUSHED_GAP * THICKNESS
        return [Move("front", (0.0, -y, 1.0)), Move("back", (0.0, y, 1.0))]
    return [Move("back", (0.0, 0.3, 1.0))] if frame.is_first_after(0.3) else []


CONTACT_STRESS_CASES = {
    "driven through at 10 m/s": StressCase(
        unchanged,
        _drive_through,
        values={
            **_COMMON,
            "obstacles": ["crate"],
            "crate.shape": "box",
            "crate.size": [0.4, 0.4, 0.4],
            "crate.position": [0.0, -0.5, 1.0],
            "crate.friction": [0.5, 0.4],
        },
    ),
    "pinch yanked at 10 m/s": StressCase(
        unchanged,
        _pinch_and_yank,
        values={
            **_COMMON,
            "gripper.mode": "pinch",
            "gripper.pad_size": [0.4, 0.02, 0.4],
            "gripper.opening": 0.04,
            "gripper.speed": 0.5,
        },
    ),
    "crushed": StressCase(
        unchanged,
        _crush,
        values={**_COMMON, "obstacles": ["front", "back"], **_plate("front", -0.2), **_plate("back", 0.2)},
    ),
    "nearly on it": StressCase(
        unchanged,
        no_events,
        values={**_COMMON, "obstacles": ["front"], **_plate("front", -0.05 - START_GAP * THICKNESS)},
    ),
    "folded on itself": StressCase(_folded, no_events, values={**_COMMON, "contact.self": True}),
}
