# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The measured pieces of a tree from before the engine, by its names.

Loaded by `engine_jobs` beside that tree's package, never beside this one's.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable
from typing import Any

import numpy as np

_STILL = 1e-9


if os.environ.get("NUMBA_CPU_NAME"):
    # That names a processor without AVX-512; the tree asks the machine itself, too, how wide its vectors are.
    _llvm: Any = importlib.import_module("llvmlite.binding")
    _features = _llvm.get_host_cpu_features()
    _features.update({name: False for name in _features if name.startswith("avx512")})
    _llvm.get_host_cpu_features = lambda: _features


def _old(module: str) -> Any:
    """A module that this tree no longer has."""
    return importlib.import_module(f"cloth_sim_ros.{module}")


def sheet_runner(resolution: int, narrow: bool, x: Any, v: Any) -> Callable[[int], None]:
    """Runs so many steps of the raw sheet on one thread, from the same start each time."""
    raw, loops = _old("bench.raw_sheet"), _old("physics.kernels.grid_leapfrog")
    sheet = raw.RawSheet(resolution=resolution, drag=1.0)
    inverse = np.full(resolution**2, 1.0 / sheet.mass)
    inverse[sheet.index[0]] = 0.0
    dtype = np.float32 if narrow else np.float64
    loop = loops.GridLeapfrog(_springs(sheet), inverse, gravity=raw.GRAVITY, drag=sheet.drag, dtype=dtype)
    loop.compile()
    ends = np.empty_like(x), np.empty_like(v)
    return lambda steps: loop.advance(*ends, steps, _STILL, start=(x, v))


def sheet_forces(resolution: int, x: Any, v: Any) -> Callable[[], None]:
    """Evaluates the raw sheet's springs once."""
    sheet = _old("bench.raw_sheet").RawSheet(resolution=resolution)
    kernel = _old("physics.kernels.grid_forces").GridForces(_springs(sheet))
    f = np.zeros_like(x)
    return lambda: kernel.add(x, v, f)


def mesh_runner(rest: Any, triangles: Any) -> Callable[[int], None]:
    """Runs so many steps of a mesh."""
    surface = _old("physics.surface").Surface.from_triangles(triangles)
    sheet = _old("physics.mesh_sheet").MeshSheet(rest=rest, surface=surface)
    masses = sheet.masses(0.2)
    terms = [
        sheet.springs(stretch_modulus=1000.0, k_d0=0.2, density=0.2),
        _old("physics.terms.gravity").Gravity(masses, (0.0, 0.0, -9.81)),
        _old("physics.terms.drag").Drag(masses, 0.5),
    ]
    dynamics = _old("physics.dynamics").Dynamics(_old("physics.model").Model(masses, terms, anchors=[0]))
    dynamics.plan = _old("physics.mesh_plan").MeshPlan(dynamics)
    x = np.ascontiguousarray(rest.T)
    return _runner(dynamics, x, np.zeros_like(x))


def simulation_runner(simulation: Any) -> Callable[[int], None]:
    """Runs so many steps of a simulation's cloth."""
    return _runner(simulation.dynamics, simulation.state.x, simulation.state.v)


def curtain(resolution: int, tolerance: float) -> tuple[Callable[[], Any], Callable[..., Any]]:
    """Makes scene C and its start; advances it with one and the same integrator."""
    sheet = _old("bench.raw_sheet").RawSheet(resolution=resolution, drag=1.0)
    make = _old("physics.automatic").make_integrator
    State = _old("physics.state").State

    def build() -> Any:
        return sheet.dynamics(sheet.index[0]), State(sheet.flat(hung=False))

    return build, make("auto", tolerance=tolerance).advance


def _runner(dynamics: Any, x: Any, v: Any) -> Callable[[int], None]:
    leapfrog = _old("physics.integrators.march").leapfrog
    ends = np.empty_like(x), np.empty_like(v)

    def run(steps: int) -> None:
        leapfrog(dynamics, 0.0, *ends, _STILL, steps, start=(x, v))

    return run


def _springs(sheet: Any) -> Any:
    springs = _old("physics.kernels.grid_springs").GridSprings
    return springs(sheet.resolution, sheet.resolution, sheet.families())
