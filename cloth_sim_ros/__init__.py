# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Live, accurate cloth for ROS 2 graphs: a mass-spring sheet with a stated error, usable as a library without ROS."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cloth_sim_ros.events import Grasp, Pause, Relax, Reset, SetParameters, Step, Target
    from cloth_sim_ros.physics.dynamics import Dynamics
    from cloth_sim_ros.physics.integrators.leapfrog import Leapfrog
    from cloth_sim_ros.physics.model import Model
    from cloth_sim_ros.physics.state import State
    from cloth_sim_ros.physics.terms.drag import Drag
    from cloth_sim_ros.physics.terms.gravity import Gravity
    from cloth_sim_ros.physics.terms.pair_springs import PairSprings
    from cloth_sim_ros.scene import Scene
    from cloth_sim_ros.simulation import Frame, Simulation

__version__ = "0.1.0"

_PLACES = {
    "Drag": "physics.terms.drag",
    "Dynamics": "physics.dynamics",
    "Frame": "simulation",
    "Grasp": "events",
    "Gravity": "physics.terms.gravity",
    "Leapfrog": "physics.integrators.leapfrog",
    "Model": "physics.model",
    "PairSprings": "physics.terms.pair_springs",
    "Pause": "events",
    "Relax": "events",
    "Reset": "events",
    "Scene": "scene",
    "SetParameters": "events",
    "Simulation": "simulation",
    "State": "physics.state",
    "Step": "events",
    "Target": "events",
}

__all__ = [
    "Drag",
    "Dynamics",
    "Frame",
    "Grasp",
    "Gravity",
    "Leapfrog",
    "Model",
    "PairSprings",
    "Pause",
    "Relax",
    "Reset",
    "Scene",
    "SetParameters",
    "Simulation",
    "State",
    "Step",
    "Target",
]


def __getattr__(name: str) -> Any:
    """Import a public name's module when the name is first used: nothing that is not used is loaded."""
    if name not in _PLACES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(importlib.import_module(f"{__name__}.{_PLACES[name]}"), name)
