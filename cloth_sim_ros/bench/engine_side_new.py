# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The measured pieces of this tree: a plan for every scene."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from cloth_sim_ros.engine.binding import library
from cloth_sim_ros.physics.control.automatic import make_integrator
from cloth_sim_ros.physics.forces.drag import Drag
from cloth_sim_ros.physics.forces.force import Array, Force
from cloth_sim_ros.physics.forces.gravity import Gravity
from cloth_sim_ros.physics.forces.grid_springs import GridSprings
from cloth_sim_ros.physics.forces.pair_springs import lecture_damping
from cloth_sim_ros.physics.model import Model
from cloth_sim_ros.physics.parts import GridFamily
from cloth_sim_ros.physics.plan import Plan, compile
from cloth_sim_ros.physics.sheets.mesh import MeshSheet
from cloth_sim_ros.physics.sheets.surface import Surface
from cloth_sim_ros.physics.state import State

_STILL = 1e-9
_GRAVITY = (0.0, 0.0, -9.81)


def sheet_runner(resolution: int, narrow: bool, x: Array, v: Array) -> Callable[[int], None]:
    """Runs so many steps of the raw sheet on one thread, from the same start each time."""
    return _runner(_curtain(resolution), x, v, narrow=narrow)


def sheet_forces(resolution: int, x: Array, v: Array) -> Callable[[], None]:
    """Evaluates the raw sheet's springs once."""
    masses, springs = _sheet(resolution)
    plan, out = compile(Model(masses, [springs], anchors=range(resolution))), np.empty_like(x)
    return lambda: plan.accelerations(0.0, x, v, out)


def mesh_runner(rest: Array, triangles: Any) -> Callable[[int], None]:
    """Runs so many steps of a mesh."""
    sheet = MeshSheet(rest=rest, surface=Surface.from_triangles(triangles))
    springs = sheet.springs(stretch_modulus=1000.0, k_d0=0.2, density=0.2)
    plan = compile(Model(sheet.masses(0.2), [springs, Gravity(_GRAVITY), Drag(0.5)], anchors=[0]))
    x = np.ascontiguousarray(rest.T)
    return _runner(plan, x, np.zeros_like(x))


def simulation_runner(simulation: Any) -> Callable[[int], None]:
    """Runs so many steps of a simulation's cloth."""
    return _runner(simulation.plan, simulation.state.x, np.array(simulation.state.v))


def curtain(resolution: int, tolerance: float) -> tuple[Callable[[], Any], Callable[..., Any]]:
    """Makes scene C and its start; advances it with one and the same integrator."""

    def build() -> Any:
        along = np.linspace(0.0, 1.0, resolution)
        flat = np.zeros((resolution, resolution, 3))
        flat[..., 0], flat[..., 1] = along, -along[:, None]
        return _curtain(resolution), State(flat.reshape(-1, 3))

    return build, make_integrator("auto", tolerance=tolerance).advance


class EngineTimer:
    """Adds up the time spent in the engine's functions, from when it is made until it is stopped."""

    def __init__(self) -> None:
        self.seconds = 0.0
        self._library = library()
        self._plain: dict[str, Any] = {}
        # ctypes keeps a function as an attribute of the library once it was asked for.
        for name, function in list(vars(self._library).items()):
            if name.startswith("cloth_"):
                self._plain[name] = function
                setattr(self._library, name, self._timed(function))

    def _timed(self, function: Any) -> Any:
        def call(*arguments: Any) -> Any:
            begin = time.perf_counter()
            try:
                return function(*arguments)
            finally:
                self.seconds += time.perf_counter() - begin

        return call

    def stop(self) -> float:
        """Time no longer; return the time so far [s]."""
        for name, function in self._plain.items():
            setattr(self._library, name, function)
        return self.seconds


def _runner(plan: Plan, x: Array, v: Array, *, narrow: bool = False) -> Callable[[int], None]:
    def run(steps: int) -> None:
        plan.runs(0.0, steps * _STILL, (x, v), [steps], narrow=narrow, threads=1)

    return run


def _sheet(resolution: int) -> tuple[Array, Force]:
    """Masses and the six damped families of the raw sheet: 1 m x 1 m, 0.2 kg, moduli of 1000, 200 and 10 N/m."""
    spacing, mass = 1.0 / (resolution - 1), 0.2 / resolution**2
    kinds = [("right", 1.0, 1000.0), ("down", 1.0, 1000.0)]
    kinds += [("diagonal", 2.0**0.5, 200.0), ("antidiagonal", 2.0**0.5, 200.0)]
    kinds += [("right2", 2.0, 10.0), ("down2", 2.0, 10.0)]
    families = []
    for name, reach, modulus in kinds:
        rest, k_s = reach * spacing, modulus * spacing
        damping = float(lecture_damping(0.2, k_s / rest, mass))
        families.append(GridFamily(name=name, stiffness=k_s, rest_length=rest, damping=damping))
    return np.full(resolution**2, mass), GridSprings(resolution, resolution, families)


def _curtain(resolution: int) -> Plan:
    masses, springs = _sheet(resolution)
    return compile(Model(masses, [springs, Gravity(_GRAVITY), Drag(1.0)], anchors=range(resolution)))
