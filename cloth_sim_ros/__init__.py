# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Mass-spring cloth with a stated error, for ROS 2 and as a library.

The package imports without ROS.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cloth_sim_ros.engine import __version__ as __version__
    from cloth_sim_ros.physics.control.extrapolated import Extrapolated
    from cloth_sim_ros.physics.control.leapfrog import Leapfrog
    from cloth_sim_ros.physics.integrators.base import Advance, UnstableError
    from cloth_sim_ros.physics.integrators.implicit import Implicit
    from cloth_sim_ros.physics.integrators.symplectic_euler import SymplecticEuler
    from cloth_sim_ros.physics.model.forces.added_mass import AddedMass
    from cloth_sim_ros.physics.model.forces.air_panels import AirPanels
    from cloth_sim_ros.physics.model.forces.altitude import AltitudeSprings
    from cloth_sim_ros.physics.model.forces.bending_friction import BendingFriction
    from cloth_sim_ros.physics.model.forces.candidates import CandidateSprings
    from cloth_sim_ros.physics.model.forces.crossed import CrossedSprings
    from cloth_sim_ros.physics.model.forces.drag import Drag
    from cloth_sim_ros.physics.model.forces.force import Force
    from cloth_sim_ros.physics.model.forces.gravity import Gravity
    from cloth_sim_ros.physics.model.forces.grid_springs import GridSprings
    from cloth_sim_ros.physics.model.forces.grips import Grips
    from cloth_sim_ros.physics.model.forces.membrane_triangles import MembraneTriangles
    from cloth_sim_ros.physics.model.forces.opposite import OppositeSprings
    from cloth_sim_ros.physics.model.forces.pair_springs import PairSprings
    from cloth_sim_ros.physics.model.forces.quadratic import QuadraticHinges
    from cloth_sim_ros.physics.model.forces.wind import Wind
    from cloth_sim_ros.physics.model.model import Model
    from cloth_sim_ros.physics.model.parts import GridFamily
    from cloth_sim_ros.physics.plan.plan import Plan, compile
    from cloth_sim_ros.physics.simulate import Motion, simulate
    from cloth_sim_ros.physics.state.state import State
    from cloth_sim_ros.scene.distribution import Distribution
    from cloth_sim_ros.scene.scene import Scene
    from cloth_sim_ros.simulation.ensemble import Ensemble, EnsembleFrame
    from cloth_sim_ros.simulation.events import (
        Grasp,
        Move,
        MoveObstacles,
        Pause,
        Relax,
        Reset,
        SetParameters,
        Step,
        Target,
    )
    from cloth_sim_ros.simulation.simulation import Frame, Simulation

_MODULES = {
    "__version__": "engine",
    "Advance": "physics.integrators.base",
    "AddedMass": "physics.model.forces.added_mass",
    "AirPanels": "physics.model.forces.air_panels",
    "AltitudeSprings": "physics.model.forces.altitude",
    "BendingFriction": "physics.model.forces.bending_friction",
    "CandidateSprings": "physics.model.forces.candidates",
    "compile": "physics.plan.plan",
    "CrossedSprings": "physics.model.forces.crossed",
    "Distribution": "scene.distribution",
    "Drag": "physics.model.forces.drag",
    "Ensemble": "simulation.ensemble",
    "EnsembleFrame": "simulation.ensemble",
    "Extrapolated": "physics.control.extrapolated",
    "Force": "physics.model.forces.force",
    "Frame": "simulation.simulation",
    "Grasp": "simulation.events",
    "Gravity": "physics.model.forces.gravity",
    "GridFamily": "physics.model.parts",
    "GridSprings": "physics.model.forces.grid_springs",
    "MembraneTriangles": "physics.model.forces.membrane_triangles",
    "Grips": "physics.model.forces.grips",
    "Implicit": "physics.integrators.implicit",
    "Leapfrog": "physics.control.leapfrog",
    "Model": "physics.model.model",
    "Motion": "physics.simulate",
    "Move": "simulation.events",
    "MoveObstacles": "simulation.events",
    "OppositeSprings": "physics.model.forces.opposite",
    "PairSprings": "physics.model.forces.pair_springs",
    "QuadraticHinges": "physics.model.forces.quadratic",
    "Pause": "simulation.events",
    "Plan": "physics.plan.plan",
    "Relax": "simulation.events",
    "Reset": "simulation.events",
    "Scene": "scene.scene",
    "SetParameters": "simulation.events",
    "simulate": "physics.simulate",
    "Simulation": "simulation.simulation",
    "State": "physics.state.state",
    "Step": "simulation.events",
    "SymplecticEuler": "physics.integrators.symplectic_euler",
    "Target": "simulation.events",
    "UnstableError": "physics.integrators.base",
    "Wind": "physics.model.forces.wind",
}

__all__ = [
    "AddedMass",
    "Advance",
    "AirPanels",
    "AltitudeSprings",
    "BendingFriction",
    "CandidateSprings",
    "CrossedSprings",
    "Distribution",
    "Drag",
    "Ensemble",
    "EnsembleFrame",
    "Extrapolated",
    "Force",
    "Frame",
    "Grasp",
    "Gravity",
    "GridFamily",
    "GridSprings",
    "Grips",
    "Implicit",
    "Leapfrog",
    "MembraneTriangles",
    "Model",
    "Motion",
    "Move",
    "MoveObstacles",
    "OppositeSprings",
    "PairSprings",
    "Pause",
    "Plan",
    "QuadraticHinges",
    "Relax",
    "Reset",
    "Scene",
    "SetParameters",
    "Simulation",
    "State",
    "Step",
    "SymplecticEuler",
    "Target",
    "UnstableError",
    "Wind",
    "compile",
    "simulate",
]


def __getattr__(name: str) -> Any:
    """Import a public name's module at its first use."""
    if name not in _MODULES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
