# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Starts and events that try to make a cloth blow up."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import attrs
import numpy as np

from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.simulation.events import Event, Grasp, SetParameters, Target

#: Speed at which a gripper is yanked away [m/s].
YANK = 10.0
#: Radius within which the gripper holds particles [m], and within which it does in `zero-length springs`.
RADIUS, WIDE_RADIUS = 0.15, 0.4
#: What the moduli are divided by for a while where `parameters change`.
SOFTENED = 10.0
_GRIPPER = "gripper"


@attrs.frozen
class Moment:
    """The frame that an event may precede."""

    #: Time at its start, and its length [s].
    t: float
    period: float
    #: Where the free corner of the sheet was at rest [m].
    corner: Array
    #: Moduli of the case [N/m] by parameter.
    moduli: dict[str, float]

    def is_first_after(self, moment: float) -> bool:
        """Whether this is the first frame that starts at a time [s] or later."""
        return moment <= self.t + 1e-9 * self.period < moment + self.period


@attrs.frozen
class Attack:
    """How a case starts, and what happens to it."""

    #: Positions (n, 3) to start from, of the rest positions and a random generator.
    start: Callable[[Array, np.random.Generator], Array]
    #: Events before a frame.
    events: Callable[[Moment], list[Event]]
    radius: float = RADIUS
    #: Parameters that its scene has besides.
    values: dict[str, Any] = attrs.field(factory=dict)


def _as_it_is(rest: Array, random: np.random.Generator) -> Array:
    return rest


def _stretched(rest: Array, random: np.random.Generator) -> Array:
    return rest[0] + 3.0 * (rest - rest[0])


def _crumpled(rest: Array, random: np.random.Generator) -> Array:
    return rest[0] + 0.2 * (rest - rest[0]) + 0.02 * random.normal(size=rest.shape)


def _middle(rest: Array) -> np.ndarray:
    """Particles by their distance from the middle of the sheet."""
    away = rest - rest.mean(axis=0)
    return np.argsort(np.sum(away * away, axis=1), kind="stable")


def _coincident(rest: Array, random: np.random.Generator) -> Array:
    changed = rest.copy()
    changed[_middle(rest)[:5]] = rest[_middle(rest)[0]]
    return changed


def _to_a_point(rest: Array, random: np.random.Generator) -> Array:
    """All of the lower half in one place."""
    changed = rest.copy()
    lower = rest[:, 2] < rest[:, 2].mean()
    changed[lower] = rest[lower].mean(axis=0)
    return changed


def _inverted(rest: Array, random: np.random.Generator) -> Array:
    changed = rest.copy()
    near = _middle(rest)[:6]
    changed[[near[0], near[5]]] = changed[[near[5], near[0]]]
    return changed


def _folded(rest: Array, random: np.random.Generator) -> Array:
    """The lower half folded up by nearly 180 degrees, onto the upper one."""
    changed = rest.copy()
    fold = rest[:, 2].mean()
    lower = rest[:, 2] < fold
    changed[lower, 1] += 0.02 * (fold - rest[lower, 2])
    changed[lower, 2] = 2.0 * fold - rest[lower, 2]
    return changed


def _nothing(moment: Moment) -> list[Event]:
    return []


def _close(moment: Moment) -> list[Event]:
    return [Target(_GRIPPER, moment.corner), Grasp(_GRIPPER, True)]


def _release(moment: Moment) -> list[Event]:
    if moment.is_first_after(0.0):
        return _close(moment)
    if moment.t < 0.25:
        return [Target(_GRIPPER, moment.corner + (moment.t + moment.period) * np.array([0.0, 0.8, 0.4]))]
    return [Grasp(_GRIPPER, False)] if moment.is_first_after(0.25 + moment.period) else []


def _snap(moment: Moment) -> list[Event]:
    if moment.is_first_after(0.1):
        return _close(moment)
    late = moment.is_first_after(0.1 + 2.0 * moment.period)
    return [Target(_GRIPPER, moment.corner + np.array([0.0, 0.3, 0.1]))] if late else []


def _yank(moment: Moment) -> list[Event]:
    if moment.is_first_after(0.0):
        return _close(moment)
    if moment.t < 0.15:
        return [
            Target(_GRIPPER, moment.corner + YANK * (moment.t + moment.period) * np.array([0.0, 0.8, 0.6])),
        ]
    return [Grasp(_GRIPPER, False)] if moment.is_first_after(0.15 + moment.period) else []


def _jumps(moment: Moment) -> list[Event]:
    """A held patch is thrown through its own springs' zero, back and forth, and turned."""
    if moment.is_first_after(0.0):
        return _close(moment)
    for k, moment_of_jump in enumerate((0.1, 0.2, 0.3, 0.4)):
        if moment.is_first_after(moment_of_jump):
            side = np.array([0.0, 0.2 if k % 2 else -0.2, 0.05])
            half = 0.25 * np.pi * (k + 1)
            return [Target(_GRIPPER, moment.corner + side, (0.0, 0.0, float(np.sin(half)), float(np.cos(half))))]
    return []


def _parameters(moment: Moment) -> list[Event]:
    """The moduli fall in mid-run, and grow again."""
    if moment.is_first_after(0.1):
        return [SetParameters({name: value / SOFTENED for name, value in moment.moduli.items()})]
    return [SetParameters(dict(moment.moduli))] if moment.is_first_after(0.3) else []


ATTACKS = {
    "hanging": Attack(_as_it_is, _nothing),
    "release": Attack(_as_it_is, _release),
    "snap grasp": Attack(_as_it_is, _snap),
    "yanked at 10 m/s": Attack(_as_it_is, _yank),
    "zero-length springs": Attack(_as_it_is, _jumps, radius=WIDE_RADIUS),
    "parameters change": Attack(_folded, _parameters),
    "stretched x 3": Attack(_stretched, _nothing),
    "crumpled": Attack(_crumpled, _nothing),
    "coincident": Attack(_coincident, _nothing),
    "half in one point": Attack(_to_a_point, _nothing),
    "inverted cell": Attack(_inverted, _nothing),
    "folded shut": Attack(_folded, _nothing),
}
