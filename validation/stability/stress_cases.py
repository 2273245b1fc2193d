# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Stress cases: initial positions and events that provoke instability."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import attrs
import numpy as np

from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.simulation.events import Event, Grasp, SetParameters, Target

#: Speed of a gripper that is yanked away [m/s].
YANK = 10.0
#: Radius of the gripper [m], and its radius in `zero-length springs`.
RADIUS, WIDE_RADIUS = 0.15, 0.4
#: Divisor of the moduli during the soft phase of `parameters change`.
SOFTENED = 10.0
_GRIPPER = "gripper"


@attrs.frozen
class Moment:
    """Frame before which an event may happen."""

    #: Time at its start, and its length [s].
    t: float
    period: float
    #: Rest position of the free corner of the sheet (3,) [m].
    corner: Array
    #: Moduli of the case [N/m] by parameter.
    moduli: dict[str, float]

    def is_first_after(self, moment: float) -> bool:
        """Return true for the first frame that starts at a time [s] or later."""
        return moment <= self.t + 1e-9 * self.period < moment + self.period


@attrs.frozen
class Attack:
    """Initial positions and events of a case."""

    #: Returns initial positions (n, 3) for rest positions (n, 3) and a random generator.
    start: Callable[[Array, np.random.Generator], Array]
    #: Returns the events before a frame.
    events: Callable[[Moment], list[Event]]
    radius: float = RADIUS
    #: Additional parameters of its scene.
    values: dict[str, Any] = attrs.field(factory=dict)


def _as_it_is(rest: Array, random: np.random.Generator) -> Array:
    return rest


def _stretched(rest: Array, random: np.random.Generator) -> Array:
    return rest[0] + 3.0 * (rest - rest[0])


def _crumpled(rest: Array, random: np.random.Generator) -> Array:
    return rest[0] + 0.2 * (rest - rest[0]) + 0.02 * random.normal(size=rest.shape)


def _middle(rest: Array) -> np.ndarray:
    """Return particles sorted by their distance from the centre of the sheet."""
    away = rest - rest.mean(axis=0)
    return np.argsort(np.sum(away * away, axis=1), kind="stable")


def _coincident(rest: Array, random: np.random.Generator) -> Array:
    changed = rest.copy()
    changed[_middle(rest)[:5]] = rest[_middle(rest)[0]]
    return changed


def _to_a_point(rest: Array, random: np.random.Generator) -> Array:
    """Move the lower half to one point."""
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
    """Fold the lower half up by nearly 180 degrees, onto the upper one."""
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
    """Move a grasped patch back and forth through the zero length of its springs, and turn it."""
    if moment.is_first_after(0.0):
        return _close(moment)
    for k, moment_of_jump in enumerate((0.1, 0.2, 0.3, 0.4)):
        if moment.is_first_after(moment_of_jump):
            side = np.array([0.0, 0.2 if k % 2 else -0.2, 0.05])
            half = 0.25 * np.pi * (k + 1)
            return [Target(_GRIPPER, moment.corner + side, (0.0, 0.0, float(np.sin(half)), float(np.cos(half))))]
    return []


def _parameters(moment: Moment) -> list[Event]:
    """Reduce the moduli during the run, and restore them."""
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
