# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Contact stress cases: fast obstacles, pinching, crushing and small initial gaps."""

from __future__ import annotations

from typing import Any

import numpy as np

from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.simulation.events import Event, Grasp, Move, Target
from validation.stability.stress_cases import YANK, Attack, Moment

#: Contact thickness in these cases [m]: the cells of the cloth are 0.14 m wide.
THICKNESS = 0.01
#: Gaps relative to the thickness: of the start at an obstacle, of the folded start, and of the crushing plates.
NEARLY_ON, FOLDED, CRUSHED = 0.021, 0.3, 0.3
_COMMON: dict[str, Any] = {"cloth.resolution": [8, 8], "contact.thickness": THICKNESS, "gripper.max_speed": 0.0}
_PLATE: dict[str, Any] = {"shape": "box", "size": [1.2, 0.1, 1.2], "friction": [0.5, 0.4]}


def _plate(name: str, y: float) -> dict[str, Any]:
    """Return the parameters of a plate parallel to the sheet, its centre at y [m]."""
    return {**{f"{name}.{key}": value for key, value in _PLATE.items()}, f"{name}.position": [0.0, y, 1.0]}


def _as_it_is(rest: Array, random: np.random.Generator) -> Array:
    return rest


def _folded(rest: Array, random: np.random.Generator) -> Array:
    """Mirror the lower half onto the upper one at a small gap."""
    changed = rest.copy()
    fold = rest[:, 2].mean()
    lower = rest[:, 2] < fold
    changed[lower, 1] += FOLDED * THICKNESS
    changed[lower, 2] = 2.0 * fold - rest[lower, 2]
    return changed


def _through(moment: Moment) -> list[Event]:
    return [Move("crate", (0.0, 0.8, 1.0))] if moment.is_first_after(0.05) else []


def _pinched(moment: Moment) -> list[Event]:
    """Close the jaws on the free corner, and yank them away."""
    if moment.is_first_after(0.0):
        return [Target("gripper", moment.corner), Grasp("gripper", True)]
    if 0.2 <= moment.t < 0.3:
        return [Target("gripper", moment.corner + YANK * (moment.t - 0.2 + moment.period) * np.array([0.0, 0.8, 0.6]))]
    return []


def _crush(moment: Moment) -> list[Event]:
    if moment.is_first_after(0.05):
        y = 0.05 + CRUSHED * THICKNESS
        return [Move("front", (0.0, -y, 1.0)), Move("back", (0.0, y, 1.0))]
    return [Move("back", (0.0, 0.3, 1.0))] if moment.is_first_after(0.3) else []


def _nothing(moment: Moment) -> list[Event]:
    return []


CONTACT_ATTACKS = {
    "driven through at 10 m/s": Attack(
        _as_it_is,
        _through,
        values={
            **_COMMON,
            "obstacles": ["crate"],
            "crate.shape": "box",
            "crate.size": [0.4, 0.4, 0.4],
            "crate.position": [0.0, -0.5, 1.0],
            "crate.friction": [0.5, 0.4],
        },
    ),
    "pinch yanked at 10 m/s": Attack(
        _as_it_is,
        _pinched,
        values={
            **_COMMON,
            "gripper.mode": "pinch",
            "gripper.pad_size": [0.4, 0.02, 0.4],
            "gripper.opening": 0.04,
            "gripper.speed": 0.5,
        },
    ),
    "crushed": Attack(
        _as_it_is,
        _crush,
        values={**_COMMON, "obstacles": ["front", "back"], **_plate("front", -0.2), **_plate("back", 0.2)},
    ),
    "nearly on it": Attack(
        _as_it_is,
        _nothing,
        values={**_COMMON, "obstacles": ["front"], **_plate("front", -0.05 - NEARLY_ON * THICKNESS)},
    ),
    "folded on itself": Attack(_folded, _nothing, values={**_COMMON, "contact.self": True}),
}
