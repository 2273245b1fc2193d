# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Stress cases: initial positions and events that provoke instability.

Those of contact have fast obstacles, pinching, crushing and small initial gaps.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import attrs
import numpy as np

from cloth_sim_ros import Grasp, Move, SetParameters, Target
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.simulation.events import Event

#: Speed of a gripper that is yanked away [m/s].
YANK_SPEED = 10.0
#: Radius of the gripper [m], and its radius in `zero-length springs`.
RADIUS, WIDE_RADIUS = 0.15, 0.4
#: Divisor of the moduli during the soft phase of `parameters change`.
SOFTENING_FACTOR = 10.0
_GRIPPER = "gripper"


@attrs.frozen
class StressFrame:
    """Frame before which an event may happen."""

    #: Time at its start, and its length [s].
    t: float
    period: float
    #: Rest position of the free corner of the sheet (3,) [m].
    corner: Array
    #: Moduli of the case [N/m] by parameter.
    moduli: dict[str, float]

    def is_first_after(self, time: float) -> bool:
        """Return true for the first frame that starts at a time [s] or later."""
        return time <= self.t + 1e-9 * self.period < time + self.period


@attrs.frozen
class StressCase:
    """Initial positions and events of a case."""

    #: Returns initial positions (n, 3) for rest positions (n, 3) and a random generator.
    start: Callable[[Array, np.random.Generator], Array] = lambda rest_positions, random: rest_positions
    #: Returns the events before a frame.
    events: Callable[[StressFrame], list[Event]] = lambda frame: []
    radius: float = RADIUS
    #: Additional parameters of its scene.
    values: dict[str, Any] = attrs.field(factory=dict)


def _stretched(rest_positions: Array, random: np.random.Generator) -> Array:
    return rest_positions[0] + 3.0 * (rest_positions - rest_positions[0])


def _crumpled(rest_positions: Array, random: np.random.Generator) -> Array:
    away = rest_positions - rest_positions[0]
    return rest_positions[0] + 0.2 * away + 0.02 * random.normal(size=rest_positions.shape)


def _by_distance_from_centre(rest_positions: Array) -> np.ndarray:
    """Return particles sorted by their distance from the centre of the sheet."""
    offsets = rest_positions - rest_positions.mean(axis=0)
    return np.argsort(np.sum(offsets * offsets, axis=1), kind="stable")


def _coincident(rest_positions: Array, random: np.random.Generator) -> Array:
    changed = rest_positions.copy()
    changed[_by_distance_from_centre(rest_positions)[:5]] = rest_positions[_by_distance_from_centre(rest_positions)[0]]
    return changed


def _collapsed(rest_positions: Array, random: np.random.Generator) -> Array:
    """Move the lower half to one point."""
    changed = rest_positions.copy()
    lower = rest_positions[:, 2] < rest_positions[:, 2].mean()
    changed[lower] = rest_positions[lower].mean(axis=0)
    return changed


def _inverted(rest_positions: Array, random: np.random.Generator) -> Array:
    changed = rest_positions.copy()
    nearest_to_centre = _by_distance_from_centre(rest_positions)[:6]
    changed[[nearest_to_centre[0], nearest_to_centre[5]]] = changed[[nearest_to_centre[5], nearest_to_centre[0]]]
    return changed


def _folded(rest_positions: Array, random: np.random.Generator, *, slope: float = 0.0, gap: float = 0.0) -> Array:
    """Mirror the lower half onto the upper one, at a distance that grows from a gap [m] at the fold by a slope."""
    changed = rest_positions.copy()
    fold_height = rest_positions[:, 2].mean()
    lower = rest_positions[:, 2] < fold_height
    changed[lower, 1] += gap + slope * (fold_height - rest_positions[lower, 2])
    changed[lower, 2] = 2.0 * fold_height - rest_positions[lower, 2]
    return changed


def _grasp_corner(frame: StressFrame) -> list[Event]:
    return [Target(_GRIPPER, frame.corner), Grasp(_GRIPPER, True)]


def _pull(frame: StressFrame, *, speed: float, direction: tuple[float, ...], end: float) -> list[Event]:
    """Pull the free corner along a direction until a time [s], and release it."""
    if frame.is_first_after(0.0):
        return _grasp_corner(frame)
    if frame.t < end:
        return [Target(_GRIPPER, frame.corner + speed * (frame.t + frame.period) * np.array(direction))]
    return [Grasp(_GRIPPER, False)] if frame.is_first_after(end + frame.period) else []


def _snap(frame: StressFrame) -> list[Event]:
    if frame.is_first_after(0.1):
        return _grasp_corner(frame)
    is_jump_frame = frame.is_first_after(0.1 + 2.0 * frame.period)
    return [Target(_GRIPPER, frame.corner + np.array([0.0, 0.3, 0.1]))] if is_jump_frame else []


def _jump(frame: StressFrame) -> list[Event]:
    """Move a grasped patch back and forth through the zero length of its springs, and turn it."""
    if frame.is_first_after(0.0):
        return _grasp_corner(frame)
    for k, jump_time in enumerate((0.1, 0.2, 0.3, 0.4)):
        if frame.is_first_after(jump_time):
            displacement = np.array([0.0, 0.2 if k % 2 else -0.2, 0.05])
            half_angle = 0.25 * np.pi * (k + 1)
            orientation = (0.0, 0.0, float(np.sin(half_angle)), float(np.cos(half_angle)))
            return [Target(_GRIPPER, frame.corner + displacement, orientation)]
    return []


def _parameters(frame: StressFrame) -> list[Event]:
    """Reduce the moduli during the run, and restore them."""
    if frame.is_first_after(0.1):
        return [SetParameters({name: value / SOFTENING_FACTOR for name, value in frame.moduli.items()})]
    return [SetParameters(dict(frame.moduli))] if frame.is_first_after(0.3) else []


#: The lower half is folded up by nearly 180 degrees.
_FOLDED_SHUT = partial(_folded, slope=0.02)
STRESS_CASES = {
    "hanging": StressCase(),
    "release": StressCase(events=partial(_pull, speed=1.0, direction=(0.0, 0.8, 0.4), end=0.25)),
    "snap grasp": StressCase(events=_snap),
    "yanked at 10 m/s": StressCase(events=partial(_pull, speed=YANK_SPEED, direction=(0.0, 0.8, 0.6), end=0.15)),
    "zero-length springs": StressCase(events=_jump, radius=WIDE_RADIUS),
    "parameters change": StressCase(_FOLDED_SHUT, _parameters),
    "stretched x 3": StressCase(_stretched),
    "crumpled": StressCase(_crumpled),
    "coincident": StressCase(_coincident),
    "half in one point": StressCase(_collapsed),
    "inverted cell": StressCase(_inverted),
    "folded shut": StressCase(_FOLDED_SHUT),
}

#: Contact thickness in these cases [m]: the cells of the cloth are 0.14 m wide.
THICKNESS = 0.01
#: Gaps relative to the thickness: of the start at an obstacle, of the folded start, and of the crushing plates.
START_GAP, FOLDED_GAP, CRUSHED_GAP = 0.021, 0.3, 0.3
_COMMON: dict[str, Any] = {"cloth.resolution": [8, 8], "contact.thickness": THICKNESS, "gripper.max_speed": 0.0}
_PLATE: dict[str, Any] = {"shape": "box", "size": [1.2, 0.1, 1.2], "friction": [0.5, 0.4]}


def _plate(name: str, y: float) -> dict[str, Any]:
    """Return the parameters of a plate parallel to the sheet, its centre at y [m]."""
    return {**{f"{name}.{key}": value for key, value in _PLATE.items()}, f"{name}.position": [0.0, y, 1.0]}


def _drive_through(frame: StressFrame) -> list[Event]:
    return [Move("crate", (0.0, 0.8, 1.0))] if frame.is_first_after(0.05) else []


def _pinch_and_yank(frame: StressFrame) -> list[Event]:
    """Close the jaws on the free corner, and yank them away."""
    if frame.is_first_after(0.0):
        return _grasp_corner(frame)
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
        events=_drive_through,
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
        events=_pinch_and_yank,
        values={
            **_COMMON,
            "gripper.mode": "pinch",
            "gripper.pad_size": [0.4, 0.02, 0.4],
            "gripper.opening": 0.04,
            "gripper.speed": 0.5,
        },
    ),
    "crushed": StressCase(
        events=_crush,
        values={**_COMMON, "obstacles": ["front", "back"], **_plate("front", -0.2), **_plate("back", 0.2)},
    ),
    "nearly on it": StressCase(
        values={**_COMMON, "obstacles": ["front"], **_plate("front", -0.05 - START_GAP * THICKNESS)},
    ),
    "folded on itself": StressCase(
        partial(_folded, gap=FOLDED_GAP * THICKNESS), values={**_COMMON, "contact.self": True}
    ),
}
