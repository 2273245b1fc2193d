# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Scenes with and without each feature, in motion: what the cost of a feature is taken from."""

from __future__ import annotations

from typing import Any

import attrs
import numpy as np

from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Event, Grasp, Target
from cloth_sim_ros.simulation.simulation import Simulation

#: A scene in which nothing is used beyond springs that are needed to be a cloth.
BARE: dict[str, Any] = {
    "grippers": [""],
    "tolerance": 0.0,
    "integrator": "leapfrog",
    "material.damping": 0.0,
    "air.drag": 0.0,
    "wind.normal_drag": 0.0,
    "gravity": [0.0, 0.0, 0.0],
    "bending.model": "none",
}
#: All forces of a sheet that hangs in air, without grippers or error control.
FORCES: dict[str, Any] = {"grippers": [""], "tolerance": 0.0, "integrator": "leapfrog", "wind.normal_drag": 0.0}
#: A bending modulus for the models that have one [N m]: that of a thin cotton.
_BENDING = {"material.bending_modulus": 1e-5}
#: Frames that a scene is moved before it is timed: all that is made once is made, and the sheet swings.
_FRAMES_BEFORE = 20


@attrs.frozen(kw_only=True)
class Variant:
    """One scene with a feature absent, idle or active."""

    feature: str
    #: `absent`, `idle` (present without effect) or `active`, with further words if there are several.
    presence: str
    values: dict[str, Any]
    #: A gripper closes on the sheet's last corner.
    holds: bool = False
    #: Every frame has events, from the frame's index and the corner's position.
    turns: bool = False
    #: The sheet sleeps.
    asleep: bool = False

    @property
    def name(self) -> str:
        """Name among candidates."""
        return f"{self.feature}: {self.presence}"


def variants() -> list[Variant]:
    """All of them; of each feature the one without it comes first, and what is compared differs by it alone."""
    gripper = {"grippers": ["gripper"]}
    controlled = {"tolerance": 1e-4, "integrator": "auto"}

    def make(feature: str, presence: str, values: dict[str, Any] | None = None, **more: bool) -> Variant:
        return Variant(feature=feature, presence=presence, values={**FORCES, **(values or {})}, **more)

    return [
        make("damping", "absent", {"material.damping": 0.0}),
        make("damping", "active"),
        make("drag", "absent", {"air.drag": 0.0}),
        make("drag", "active"),
        make("air across the sheet", "absent"),
        make("air across the sheet", "active", {"wind.normal_drag": 0.45}),
        make("gravity", "absent", {"gravity": [0.0, 0.0, 0.0]}),
        make("gravity", "active"),
        make("bending", "absent", {"bending.model": "none"}),
        make("bending", "active, axial"),
        make("bending", "active, crossed", {"bending.model": "crossed", **_BENDING}),
        make("bending", "active, altitude", {"bending.model": "altitude", **_BENDING}),
        make("bending", "active, quadratic", {"bending.model": "quadratic", **_BENDING}),
        make("bending", "active, shape operator", {"bending.model": "shape_operator", **_BENDING}),
        make("gripper", "absent"),
        make("gripper", "idle", gripper),
        make("gripper", "active, holding", gripper, holds=True),
        make("gripper", "active, turning", gripper, holds=True, turns=True),
        make("energy balance", "absent"),
        make("energy balance", "active", {"diagnostics.energy": True}),
        make("error control", "absent"),
        make("error control", "active", controlled),
        make("sleep", "absent", gripper),
        make("sleep", "idle, moving", {**controlled, **gripper}),
        make("sleep", "active, asleep", {**controlled, **gripper, "air.drag": 1e3}, asleep=True),
    ]


def swinging(scene: Scene) -> State:
    """The start of a hung scene with a push out of its plane, from nothing at the top to 0.5 m/s a metre below."""
    state = scene.starting_state()
    state.v[1] = 0.5 * (state.x[2].max() - state.x[2])
    state.v[:, scene.anchored_particles()] = 0.0
    return state


class Running:
    """A variant in motion.

    Args:
        variant: what it is.
        resolution: particles a side.
    """

    def __init__(self, variant: Variant, resolution: int) -> None:
        values = {**variant.values, "cloth.resolution": [resolution, resolution]}
        self._turns = variant.turns
        if variant.asleep:
            # Flat and without weight it is at rest from the start.
            values["gravity"] = [0.0, 0.0, 0.0]
        scene = Scene.from_parameters(values)
        self.simulation = Simulation(scene, None if variant.asleep else swinging(scene))
        self._corner = self.simulation.positions[-1]
        self._frames = 0
        begin: list[Event] = []
        if self.simulation.grippers.names:
            begin.append(Target("gripper", self._corner))
        if variant.holds:
            begin.append(Grasp("gripper", True))
        self.simulation.advance(begin)
        for _ in range(_FRAMES_BEFORE):
            self.frame()
        while variant.asleep and not self.simulation.asleep:
            self.frame()

    def frame(self) -> None:
        """Advance by one frame."""
        self._frames += 1
        events: list[Event] = []
        if self._turns:
            angle = 0.3 * np.sin(0.1 * self._frames)
            events.append(Target("gripper", self._corner, (0.0, 0.0, np.sin(angle), np.cos(angle))))
        self.simulation.advance(events)
