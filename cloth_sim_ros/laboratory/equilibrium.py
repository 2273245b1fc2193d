# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Equilibrium of a scene by relaxation in viscous air.

The cloth moves in air that damps each velocity at the rate c, by explicit steps at their stability limit. The slowest
oscillation of angular frequency ω decays fastest at c = 2 ω. A sheet that hangs over a length l has ω near sqrt(g / l),
13 1/s for 6 cm. A draped one has softer modes, because its folds move along it. The default c is between both.

The residual is the largest out-of-balance force on a particle over its weight on Earth. A particle that moves at v has
lost the force c m v to the air, so that c |v| / g counts as well.
"""

from __future__ import annotations

import math

import attrs
import numpy as np

from cloth_sim_ros.physics.integrators.limit import leapfrog_limit
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.plan.thread_limit import single_threaded
from cloth_sim_ros.physics.state.controller_state import StateMemory
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import SetParameters
from cloth_sim_ros.simulation.simulation import Simulation

#: Drag of the air in which a cloth relaxes [1/s].
RELAXATION_DRAG = 8.0
#: Largest residual of an equilibrium.
MAX_RESIDUAL = 1e-3
#: Largest number of steps of all particles in a second of motion: about 10 minutes of one core.
_MAX_WORK = 1e10
#: Unit of accelerations [m/s^2].
_GRAVITY = 9.81


class LaboratoryError(ValueError):
    """Error: a test can't be done; the message, for the command line, gives the reason."""


@attrs.frozen(eq=False, kw_only=True)
class Equilibrium:
    """State of rest of a cloth, or the state at which its relaxation ended without one."""

    #: Positions [m], shape (n, 3).
    positions: Array
    #: Largest out-of-balance force on a particle over its weight.
    residual: float
    #: Simulated time of the relaxation [s].
    time: float
    #: `State.memory` at its end.
    memory: StateMemory
    #: True if the residual is below its limit.
    is_converged: bool


def find_equilibrium(
    scene: Scene,
    start: Array | None = None,
    *,
    memory: StateMemory | None = None,
    loading_time: float = 0.0,
    drag: float = RELAXATION_DRAG,
    loading_drag: float = RELAXATION_DRAG,
    max_residual: float = MAX_RESIDUAL,
    max_time: float = 30.0,
) -> Equilibrium:
    """Relax the cloth of a scene in viscous air, on one thread; return where it ends, at rest if `is_converged`.

    Args:
        scene: the cloth; its anchors and obstacles stay where they are.
        start: positions at the beginning, those of anchored particles included [m], shape (n, 3); None for the scene's.
        memory: `State.memory` at the beginning, with the plastic lengths of hinges; None for an empty one.
        loading_time: time during which gravity grows from zero to its value [s].
        drag: rate at which the air damps velocities once the load is complete [1/s].
        loading_drag: rate while the load grows [1/s].
        max_residual: residual below which the cloth is at rest.
        max_time: simulated time after which the relaxation ends [s].

    Raises:
        LaboratoryError: for wind, in which the air would move the cloth, and for a cloth whose steps are too short.
        UnstableError: if the motion does not stay finite.
    """
    if any(scene.wind.velocity):
        raise LaboratoryError(
            f"wind.velocity is {list(scene.wind.velocity)} m/s; relaxation needs still air: set it to [0.0, 0.0, 0.0]"
        )
    gravity = scene.gravity
    first = _scaled(gravity, 0.0) if loading_time else gravity
    still = {"air.drag": loading_drag if loading_time else drag, "wind.normal_drag": 0.0, "wind.tangential_drag": 0.0}
    quick = {"integrator": "leapfrog", "tolerance": 0.0, "step": 0.0, "work_limit": 0.0, "diagnostics.energy": False}
    relaxing = scene.changed({**still, **quick, "gravity": first})
    state = relaxing.starting_state()
    if start is not None:
        state = State(start, cloth=state.cloth, memory=dict(memory or {}))
    with single_threaded():
        simulation = Simulation(relaxing, state)
        _check_work(simulation)
        n_loading = math.ceil(loading_time * scene.rate)
        residual = math.inf
        for frame in range(math.ceil(max_time * scene.rate)):
            events = []
            if frame == n_loading > 0:
                events.append(SetParameters({"air.drag": drag}))
            if frame < n_loading:
                events.append(SetParameters({"gravity": _scaled(gravity, (frame + 1) / n_loading)}))
            simulation.advance(events)
            if frame >= n_loading:
                residual = out_of_balance(simulation.plan, simulation.state, simulation.time, drag)
                if residual < max_residual:
                    break
    return Equilibrium(
        positions=simulation.positions,
        residual=residual,
        time=simulation.time,
        memory=simulation.state.memory,
        is_converged=residual < max_residual,
    )


def _check_work(simulation: Simulation) -> None:
    """Raise LaboratoryError for a cloth whose relaxation would not end within hours."""
    step = leapfrog_limit(*simulation.plan.spectral_bounds(simulation.state.x))
    work = simulation.state.x.shape[1] / step if step > 0.0 else math.inf
    if not work <= _MAX_WORK:
        raise LaboratoryError(
            f"steps of at most {step:.2g} s for {simulation.state.x.shape[1]} particles make {work:.2g} in a second of "
            f"motion; at most {_MAX_WORK:g} are possible. Lower the fabric's moduli, raise its density, or take "
            "longer edges"
        )


def out_of_balance(plan: Plan, state: State, t: float, drag: float) -> float:
    """Return the largest force on a particle at rest, or drag if larger, over the particle's weight on Earth.

    Args:
        plan: equations of motion.
        state: positions, velocities and memory.
        t: time [s].
        drag: rate at which the air damps velocities [1/s].
    """
    acceleration = np.empty_like(state.x)
    plan.accelerations(t, state.x, np.zeros_like(state.x), acceleration, state.memory)
    return max(_max_length(acceleration), drag * _max_length(state.v)) / _GRAVITY


def _max_length(vectors: Array) -> float:
    """Return the length of the longest of vectors (3, n)."""
    x, y, z = vectors
    return math.sqrt(float((x * x + y * y + z * z).max()))


def _scaled(vector: tuple[float, ...], factor: float) -> list[float]:
    return [factor * coordinate for coordinate in vector]
