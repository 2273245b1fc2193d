# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Cache of the plan of a scene that changes while it runs.

Parts that a change does not concern are not rebuilt.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import attrs
import numpy as np

from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.scene.build import build_plan, uniform_forces

if TYPE_CHECKING:
    from cloth_sim_ros.physics.plan.plan import Plan
    from cloth_sim_ros.scene.scene import Scene


class PlanCache:
    """Plan of the scene in force; another is compiled only if a change requires it.

    The plan is reused as long as springs, hinges, panels, masses and anchors stay. Gravity, drag and wind, which act on
    all particles alike, are updated in place.

    Args:
        scene: initial scene in force.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        #: Plan of the scene in force.
        self.plan = build_plan(scene)
        # Scene of the last query, and its plan.
        self._candidate: tuple[Scene, Plan] | None = None

    def change(self, scene: Scene) -> Plan:
        """Put a scene in force and return its plan: the present one, updated in place, if its elements are the same."""
        before, self._scene = self._scene, scene
        if not same_elements(before, scene):
            candidate, self._candidate = self._candidate, None
            self.plan = candidate[1] if candidate is not None and candidate[0] == scene else build_plan(scene)
        elif _uniform(before) != _uniform(scene):
            self._update_uniform(before, scene)
        return self.plan

    def _update_uniform(self, before: Scene, scene: Scene) -> None:
        """Update gravity, drag and wind of the plan in place, from those of `before` to those of `scene`."""
        uniform, replaced = uniform_forces(scene), {force.name for force in uniform_forces(before)}
        remaining, air = [force for force in self.plan.model.forces if force.name not in replaced], None
        if scene.wind.normal_drag or scene.wind.tangential_drag or scene.air.added_mass:
            from cloth_sim_ros.physics.model.forces.added_mass import AddedMass
            from cloth_sim_ros.physics.model.forces.air_panels import AirPanels

            wind = scene.wind.velocity
            remaining = [
                force.in_wind(wind) if isinstance(force, (AirPanels, AddedMass)) else force for force in remaining
            ]
            air = np.array([scene.wind.normal_drag, scene.wind.tangential_drag, *wind])
        self.plan.change_uniform([*remaining, *uniform], uniform, air_coefficients=air)

    def spectral_bounds(self, scene: Scene, x: Array) -> tuple[float, float]:
        """Return bounds of squared angular frequency [1/s^2] and damping rate [1/s] of another scene; may compile it.

        If its elements differ, this builds its plan and keeps it for `change`.

        Args:
            scene: the other scene.
            x: positions [m], (3, n).
        """
        if same_elements(self._scene, scene):
            omega2, damping = self.plan.spectral_bounds(x)
            return omega2, damping + scene.air.drag - self._scene.air.drag
        # A queried change usually follows.
        self._candidate = scene, build_plan(scene)
        return self._candidate[1].spectral_bounds(x)


def same_elements(before: Scene, scene: Scene) -> bool:
    """Return True if scenes have the same springs, hinges, panels, masses, anchors, grippers, obstacles and contact."""
    return _elements(before) == _elements(scene)


def _elements(scene: Scene) -> tuple[Any, ...]:
    panels = scene.wind.normal_drag, scene.wind.tangential_drag, scene.air.added_mass
    obstacles = [(name, attrs.evolve(scene.described[name], frame="")) for name in scene.obstacle_names]
    gripper = scene.gripper
    pads = gripper.pad_size, gripper.opening, gripper.force, gripper.speed, gripper.friction
    pinching = (scene.pinching, pads) if scene.pinching else None
    contact = (obstacles, scene.contact, pinching) if obstacles or pinching or scene.contact.self_ else None
    return scene.cloth, scene.material, scene.membrane, scene.bending, scene.grippers, panels, contact


def _uniform(scene: Scene) -> tuple[Any, ...]:
    return scene.gravity, scene.air.drag, scene.wind.velocity
