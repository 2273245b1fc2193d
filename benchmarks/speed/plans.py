# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Step time of meshes, hinges, grippers, air, and a force in numpy."""

from __future__ import annotations

import statistics
import time

import attrs
import numpy as np
from support.random_meshes import shuffled_mesh

from benchmarks.speed.kernels import steps_runner
from benchmarks.timing import time_interleaved
from cloth_sim_ros.physics.model.forces.drag import Drag
from cloth_sim_ros.physics.model.forces.force import Array, Force
from cloth_sim_ros.physics.model.forces.gravity import Gravity
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.model.sheets.mesh import MeshSheet
from cloth_sim_ros.physics.model.sheets.surface import Surface
from cloth_sim_ros.physics.plan.plan import Plan, compile
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Grasp, Target
from cloth_sim_ros.simulation.simulation import Simulation

#: Particles times steps of one turn: some milliseconds.
_UPDATES_A_TURN = 500_000
_MIN_STEPS = 20


@attrs.frozen(kw_only=True)
class PlanTime:
    """Nanoseconds per particle and step: the median, and the plan's estimate for the choice of integrator."""

    particles: int
    step: float
    estimate: float


def mesh_time(particles: int, *, seconds: float) -> PlanTime:
    """Time an irregular, damped mesh in air, with about `particles` vertices in random order."""
    sheet = shuffled_sheet(particles)
    springs = sheet.springs(stretch_modulus=1000.0, k_d0=0.2, density=0.2)
    model = Model(sheet.masses(0.2), [springs, Gravity(), Drag(0.5)], anchors=[0])
    x = np.ascontiguousarray(sheet.positions().T)
    return _time(compile(model), 0.0, x, np.zeros_like(x), seconds=seconds)


def bending_time(resolution: int, bending: str, *, seconds: float) -> PlanTime:
    """Time a square grid with a bending model of hinges."""
    values: dict[str, object] = {"cloth.resolution": [resolution, resolution], "bending.model": bending}
    values["wind.normal_drag"] = 0.0
    if bending in ("crossed", "altitude", "quadratic"):
        values["material.bending_modulus"] = 1e-5
    simulation = Simulation(Scene.from_parameters(values))
    return _time(simulation.plan, 0.0, simulation.state.x, simulation.state.v, seconds=seconds)


def grip_time(resolution: int, *, turning: bool, seconds: float) -> PlanTime:
    """Time a square grid held by a gripper that moves and, if `turning`, rotates."""
    values = {"cloth.resolution": [resolution, resolution], "wind.normal_drag": 0.0}
    simulation = Simulation(Scene.from_parameters(values))
    name = simulation.scene.gripper_names[0]
    corner = simulation.positions[-1]
    simulation.advance([Target(name, corner)])
    simulation.advance([Grasp(name, True)])
    angle = 0.05 if turning else 0.0
    simulation.advance([Target(name, corner + 0.005, (0.0, 0.0, float(np.sin(angle)), float(np.cos(angle))))])
    begin = simulation.time - simulation.scene.period
    return _time(simulation.plan, begin, simulation.state.x, simulation.state.v, seconds=seconds)


def shuffled_sheet(particles: int) -> MeshSheet:
    """Return a square sheet of irregular triangles with vertices in random order."""
    rest_positions, triangles = shuffled_mesh(particles)
    return MeshSheet(rest_positions=rest_positions, surface=Surface.from_triangles(triangles))


class _Swirl(Force):
    """Example of a user-defined force in numpy."""

    name = "swirl"

    def add_force(self, t: float, x: Array, v: Array, f: Array) -> None:
        f[0] -= 1e-6 * x[1]
        f[1] += 1e-6 * x[0]


def force_times(resolution: int, *, seconds: float) -> list[tuple[str, PlanTime]]:
    """Time a square grid with air drag on its surface, and with a force in numpy."""
    scene = Scene.from_parameters({"cloth.resolution": [resolution, resolution], "wind.normal_drag": 1.0})
    windy, x = scene.plan(), np.ascontiguousarray(scene.initial_positions().T)
    plain = scene.changed({"wind.normal_drag": 0.0}).plan().model
    with_user_force = compile(Model(plain.masses, [*plain.forces, _Swirl()], anchors=plain.anchors))
    v = np.zeros_like(x)
    plans = (("air on its surface", windy), ("a force in numpy", with_user_force))
    return [(label, _time(plan, 0.0, x, v, seconds=seconds)) for label, plan in plans]


def _time(plan: Plan, t: float, x: Array, v: Array, *, seconds: float) -> PlanTime:
    count = x.shape[1]
    steps, short_steps = max(_UPDATES_A_TURN // count, _MIN_STEPS), 1
    runs = {
        name: steps_runner(plan, (x, v), n, t=t) for name, n in (("few", short_steps), ("many", short_steps + steps))
    }
    turns = time_interleaved(runs, seconds=seconds, clock=time.thread_time)
    step = 1e9 / (steps * count) * statistics.median(turns.differences("many", "few"))
    return PlanTime(particles=count, step=step, estimate=plan.step_cost)
