# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Changes of uniform forces by changed parameters.

Gusts change the wind many times a second. Small changes keep the step limit and the last error estimate.
"""

from __future__ import annotations

import math
from collections.abc import Collection

import numpy as np

from cloth_sim_ros.physics.arithmetic.deterministic_math import ordered_sum
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.scene import Scene

#: Change of velocity from one frame to the next [m/s] above which a motion counts as a jump.
MAX_VELOCITY_CHANGE = 0.5
_UNIFORM_PARAMETERS = frozenset(("gravity", "air.drag", "wind.velocity", "material.damping"))
#: Largest changes that keep the step limit within a quarter, so that it is not computed again: drag rate times period
#: [1], and damping k_d0 of springs [1].
_MAX_DRAG_CHANGE, _MAX_DAMPING_CHANGE = 0.04, 0.01


def acceleration_change(names: Collection[str], before: Scene, scene: Scene, model: Model, state: State) -> float:
    """Return the acceleration [m/s^2] that changed parameters add; infinite if they change more than uniform forces.

    A small change of damping adds none, because it excites no vibration.

    Args:
        names: names of the changed parameters.
        before: the scene in force.
        scene: the new scene.
        model: gives the masses, and the panels on which the wind acts.
        state: gives positions and velocities.
    """
    if not _UNIFORM_PARAMETERS.issuperset(names) or scene.step:
        return math.inf
    if scene.air.added_mass and scene.wind.velocity != before.wind.velocity:
        # The force of carried air is of second degree in the speed of the wind.
        return math.inf
    drag_change = abs(scene.air.drag - before.air.drag)
    damping_change = abs(scene.material.damping - before.material.damping)
    if drag_change * scene.period > _MAX_DRAG_CHANGE or damping_change > _MAX_DAMPING_CHANGE:
        return math.inf
    panel_drag_rate = 0.0
    if scene.wind.velocity != before.wind.velocity:
        from cloth_sim_ros.physics.model.forces.air_panels import AirPanels

        panels = [force for force in model.forces if isinstance(force, AirPanels)]
        panel_drag_rate = ordered_sum(force.max_drag_rate(state.x, model.inverse_masses) for force in panels)
    speeds = np.abs(state.v).max(axis=1).tolist() if drag_change else (0.0, 0.0, 0.0)
    components = zip(scene.gravity, before.gravity, scene.wind.velocity, before.wind.velocity, speeds, strict=True)
    largest = 0.0
    for new, old, wind, old_wind, speed in components:
        change = abs(new - old) + abs(scene.air.drag * wind - before.air.drag * old_wind)
        change = change + panel_drag_rate * abs(wind - old_wind) + drag_change * speed
        largest = change if not change <= largest else largest
    return largest
