# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How much faster whole leapfrog runs are by a fused plan than by terms: meshes, hinges, and grippers that turn."""

from __future__ import annotations

import time
from collections.abc import Callable

import attrs
import numpy as np

from cloth_sim_ros.bench.speed_turns import take_turns
from cloth_sim_ros.events import Grasp, Target
from cloth_sim_ros.physics.dynamics import Dynamics
from cloth_sim_ros.physics.integrators.march import leapfrog, leapfrog_by_terms
from cloth_sim_ros.physics.mesh_plan import MeshPlan
from cloth_sim_ros.physics.mesh_sheet import MeshSheet
from cloth_sim_ros.physics.model import Model
from cloth_sim_ros.physics.surface import Surface
from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.forces.drag import Drag
from cloth_sim_ros.physics.forces.gravity import Gravity
from cloth_sim_ros.scene import Scene
from cloth_sim_ros.simulation import Simulation

#: A step so short [s] that nothing moves, however many are timed.
_STILL = 1e-9
#: Particles times steps of one turn: some milliseconds.
_UPDATES_A_TURN = 500_000
_FEWEST_STEPS = 20


@attrs.frozen(kw_only=True)
class PlanTime:
    """Nanoseconds per particle and step, medians; the ratio by terms to by plan is that of fair rounds."""

    particles: int
    terms: float
    plan: float
    #: As `plan`, particles taken in the order in which they are given; None where that is not asked for.
    as_given: float | None
    ratio: float
    ratio_as_given: float | None


def mesh_time(particles: int, *, seconds: float) -> PlanTime:
    """Time an irregular mesh, damped, in air, with about so many vertices in random order."""
    sheet = shuffled_sheet(particles)
    masses = sheet.masses(0.2)
    springs = sheet.springs(stretch_modulus=1000.0, k_d0=0.2, density=0.2)
    model = Model(masses, [springs, Gravity(masses, (0.0, 0.0, -9.81)), Drag(masses, 0.5)], anchors=[0])
    dynamics = Dynamics(model)
    dynamics.plan = MeshPlan(dynamics)
    given = Dynamics(model)
    given.plan = MeshPlan(given, reorder=False)
    x = np.ascontiguousarray(sheet.positions().T)
    return _time(dynamics, 0.0, x, np.zeros_like(x), given=given, seconds=seconds)


def bending_time(resolution: int, bending: str, *, seconds: float) -> PlanTime:
    """Time a square grid with a bending model of hinges."""
    values: dict[str, object] = {"cloth.resolution": [resolution, resolution], "bending.model": bending}
    if bending != "opposite":
        values["material.bending_modulus"] = 1e-5
    simulation = Simulation(Scene.from_parameters(values))
    return _time(simulation.dynamics, 0.0, simulation.state.x, simulation.state.v, seconds=seconds)


def grip_time(resolution: int, *, turning: bool, seconds: float) -> PlanTime:
    """Time a square grid held by a gripper that moves, and turns or not."""
    simulation = Simulation(Scene.from_parameters({"cloth.resolution": [resolution, resolution]}))
    name = simulation.scene.gripper_names[0]
    corner = simulation.positions[-1]
    simulation.advance([Target(name, corner)])
    simulation.advance([Grasp(name, True)])
    angle = 0.05 if turning else 0.0
    simulation.advance([Target(name, corner + 0.005, (0.0, 0.0, float(np.sin(angle)), float(np.cos(angle))))])
    begin = simulation.time - simulation.scene.period
    return _time(simulation.dynamics, begin, simulation.state.x, simulation.state.v, seconds=seconds)


def shuffled_sheet(particles: int) -> MeshSheet:
    """A square sheet of irregular triangles whose vertices come in random order."""
    from scipy.spatial import Delaunay

    random = np.random.default_rng(5)
    side = max(round(particles**0.5), 2)
    plane = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2) / (side - 1.0)
    inner = ((plane > 0.0) & (plane < 1.0)).all(axis=1)
    plane[inner] += random.uniform(-0.3, 0.3, (int(inner.sum()), 2)) / side
    plane = plane[random.permutation(len(plane))]
    rest = np.concatenate([plane, np.zeros((len(plane), 1))], axis=1)
    return MeshSheet(rest=rest, surface=Surface.from_triangles(Delaunay(plane).simplices.astype(np.int64)))


def _time(
    dynamics: Dynamics, t: float, x: Array, v: Array, *, given: Dynamics | None = None, seconds: float
) -> PlanTime:
    count = x.shape[1]
    steps = max(_UPDATES_A_TURN // count, _FEWEST_STEPS)

    def turn(equations: Dynamics, *, terms: bool) -> Callable[[], None]:
        position, velocity = x.copy(), v.copy()
        if terms:
            return lambda: leapfrog_by_terms(equations, t, position, velocity, _STILL, steps, None, 1.0)

        def run() -> None:
            leapfrog(equations, t, position, velocity, _STILL, steps)

        return run

    candidates = {"terms": turn(dynamics, terms=True), "plan": turn(dynamics, terms=False)}
    if given is not None:
        candidates["given"] = turn(given, terms=False)
    # A plan's second thread would hide in the processor time of one: those sheets are smaller than it takes.
    turns = take_turns(candidates, seconds=seconds, clock=time.thread_time)
    unit = 1e9 / (steps * count)
    return PlanTime(
        particles=count,
        terms=unit * turns.median("terms"),
        plan=unit * turns.median("plan"),
        as_given=unit * turns.median("given") if given is not None else None,
        ratio=turns.ratio("terms", "plan"),
        ratio_as_given=turns.ratio("given", "plan") if given is not None else None,
    )
