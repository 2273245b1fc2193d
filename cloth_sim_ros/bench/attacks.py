# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Starts and events that try to make a cloth blow up, as scenes for the stability scan."""

from __future__ import annotations

from collections.abc import Callable

import attrs
import numpy as np

from cloth_sim_ros.events import Event, Grasp, Target
from cloth_sim_ros.physics.integrators.base import Advance, Observer
from cloth_sim_ros.physics.state import State
from cloth_sim_ros.physics.terms.base import Array
from cloth_sim_ros.physics.terms.grips import Grips
from cloth_sim_ros.scene import Scene
from cloth_sim_ros.simulation import Simulation

RESOLUTION = 12
DURATION = 0.5
#: Speed at which a gripper is yanked away [m/s].
YANK = 10.0


@attrs.frozen
class Attack:
    """How a case starts, and what happens to it."""

    #: Positions (n, 3) to start from, of the rest positions and a random generator.
    start: Callable[[Array, np.random.Generator], Array]
    #: Events before the frame that starts at a time [s] and lasts so long [s].
    events: Callable[[float, float, Array], list[Event]]


def _as_it_is(rest: Array, random: np.random.Generator) -> Array:
    return rest


def _stretched(rest: Array, random: np.random.Generator) -> Array:
    return rest[0] + 3.0 * (rest - rest[0])


def _crumpled(rest: Array, random: np.random.Generator) -> Array:
    return rest[0] + 0.2 * (rest - rest[0]) + 0.02 * random.normal(size=rest.shape)


def _coincident(rest: Array, random: np.random.Generator) -> Array:
    changed = rest.copy()
    changed[30:34] = changed[40]
    return changed


def _inverted(rest: Array, random: np.random.Generator) -> Array:
    changed = rest.copy()
    a, b = 5 * RESOLUTION + 5, 6 * RESOLUTION + 6
    changed[[a, b]] = changed[[b, a]]
    return changed


def _nothing(t: float, period: float, corner: Array) -> list[Event]:
    return []


def _at(t: float, period: float, moment: float) -> bool:
    return t <= moment < t + period * (1.0 - 1e-9)


def _release(t: float, period: float, corner: Array) -> list[Event]:
    if _at(t, period, 0.0):
        return [Target("gripper", corner), Grasp("gripper", True)]
    if t < 0.25:
        return [Target("gripper", corner + np.array([0.0, 0.8 * (t + period), 0.4 * (t + period)]))]
    return [Grasp("gripper", False)] if _at(t, period, 0.25 + period) else []


def _snap(t: float, period: float, corner: Array) -> list[Event]:
    if _at(t, period, 0.1):
        return [Target("gripper", corner), Grasp("gripper", True)]
    return [Target("gripper", corner + np.array([0.0, 0.3, 0.1]))] if _at(t, period, 0.1 + 2.0 * period) else []


def _yank(t: float, period: float, corner: Array) -> list[Event]:
    if _at(t, period, 0.0):
        return [Target("gripper", corner), Grasp("gripper", True)]
    if t < 0.15:
        return [Target("gripper", corner + YANK * (t + period) * np.array([0.0, 0.8, 0.6]))]
    return [Grasp("gripper", False)] if _at(t, period, 0.15 + period) else []


ATTACKS = {
    "hanging": Attack(_as_it_is, _nothing),
    "release": Attack(_as_it_is, _release),
    "snap grasp": Attack(_as_it_is, _snap),
    "yanked at 10 m/s": Attack(_as_it_is, _yank),
    "stretched x 3": Attack(_stretched, _nothing),
    "crumpled": Attack(_crumpled, _nothing),
    "coincident": Attack(_coincident, _nothing),
    "inverted cell": Attack(_inverted, _nothing),
}


class WorkObserver(Observer):
    """Work of the grippers over a frame, in place of the wrenches: it goes term by term, which is slower."""

    def __init__(self, grips: Grips) -> None:
        self._grips = grips
        self._scratch: Array | None = None
        #: Work done on the cloth over the frame [J], what the grips store and lose included.
        self.work = 0.0

    def restart(self) -> None:
        self.work = 0.0

    def observe(self, t: float, x: Array, v: Array, weight: float) -> None:
        if self._scratch is None:
            self._scratch = np.zeros_like(x)
        self._grips.add_force(t, x, v, self._scratch)
        self.work += weight * float(self._grips.wrenches[:, 6].sum())

    @property
    def mean_wrenches(self) -> Array:
        """None are measured."""
        return np.zeros((self._grips.gripper_count, 6))


class WatchedSimulation(Simulation):
    """A simulation that tells the grippers' work instead of their wrenches while something is held."""

    def __init__(self, scene: Scene, state: State) -> None:
        super().__init__(scene, state)
        grips = self.model.term("grips")
        assert isinstance(grips, Grips)
        self._plain = self._wrenches
        self._watcher = WorkObserver(grips)

    def _move(self) -> Advance:
        holds = self.state.memory["grip.particles"].size > 0
        self._wrenches = self._watcher if holds else self._plain  # type: ignore[assignment]
        self._watcher.restart()
        return super()._move()

    @property
    def work(self) -> float:
        """Work done on the cloth over the last frame [J]."""
        return self._watcher.work


def scene(*, stiffness: float, damping: float, rate: float, integrator: str, step: float = 0.0) -> Scene:
    """A sheet of 12 x 12 hung by its upper edge, moduli times `stiffness`."""
    return Scene.from_parameters(
        {
            "rate": rate,
            "cloth.resolution": [RESOLUTION, RESOLUTION],
            "material.stretch_modulus": 1000.0 * stiffness,
            "material.shear_modulus": 100.0 * stiffness,
            "material.damping": damping,
            "bending.stiffness": 2.0 * stiffness,
            "gripper.stiffness": 1000.0 * min(stiffness, 1e4),
            "gripper.radius": 0.15,
            "integrator": integrator,
            "step": step,
            "tolerance": 1e-3,
        }
    )


def start_of(attack: Attack, built: Scene) -> State:
    """The state in which a case starts."""
    return State(attack.start(built.initial_positions(), np.random.default_rng(3)))
