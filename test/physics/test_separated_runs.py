# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Runs of a sheet that is away from itself: contact that they leave out, and when they may not."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.optimize import brentq
from support.contact_scenes import flat_sheet
from support.self_scenes import self_contact

from cloth_sim_ros.physics.control.automatic import make_integrator
from cloth_sim_ros.physics.model.forces.force import Array, Force
from cloth_sim_ros.physics.model.sheets.grid import GridSheet
from cloth_sim_ros.physics.plan.plan import Plan, compile
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Grasp, Target
from cloth_sim_ros.simulation.simulation import Simulation

PERIOD, THICKNESS, SPACING, ROWS = 1.0 / 24.0, 2e-3, 0.05, 11
#: Distance from itself that a sheet needs at the start of a frame, so that it leaves contact out [m].
NEEDED = THICKNESS + 0.1 * PERIOD


def _tube_scene(columns: int, **values: Any) -> Scene:
    """Return a scene of a soft sheet without gravity, from which a tube is bent."""
    return Scene.from_parameters(
        {
            "rate": 1.0 / PERIOD,
            "cloth.resolution": [ROWS, columns],
            "cloth.size": [SPACING * (ROWS - 1), SPACING * (columns - 1)],
            "cloth.anchors": [""],
            "contact.self": True,
            "contact.thickness": THICKNESS,
            "gravity": [0.0, 0.0, 0.0],
            "wind.normal_drag": 0.0,
            "air.drag": 0.0,
            "bending.model": "none",
            "material.damping": 0.05,
            **values,
        }
    )


def _open_tube(columns: int, gap: float) -> Array:
    """Return positions (n, 3) [m] of a sheet that is bent to a tube, whose borders have a gap [m]."""
    length = SPACING * (ROWS - 1)

    def excess(radius: float) -> float:
        angle = 2.0 * (ROWS - 1) * np.arcsin(SPACING / (2.0 * radius))
        return float(2.0 * radius * np.sin(0.5 * (2.0 * np.pi - angle)) - gap)

    radius = brentq(excess, length / (2.0 * np.pi) * 1.0005, length / (2.0 * np.pi) * 1.5)
    angles = np.arange(ROWS)[:, None] * 2.0 * np.arcsin(SPACING / (2.0 * radius))
    across = np.arange(columns)[None] * SPACING
    x, y, z = np.broadcast_arrays(across, radius * np.sin(angles), 1.0 + radius * np.cos(angles))
    return np.stack((x, y, z), axis=-1).reshape(-1, 3)


def test_prescribed_particle_that_jumps_meets_contact() -> None:
    # Its velocity is zero at both ends of the frame, and at the only step.
    columns = 5
    soft = {"material.stretch_modulus": 0.01, "material.shear_modulus": 0.002}
    scene = _tube_scene(columns, **soft, **{"gripper.model": "prescribed", "gripper.radius": 4e-3})
    tube = _open_tube(columns, NEEDED + 1e-6)
    simulation, held, facing = Simulation(scene, State(tube, np.zeros_like(tube))), len(tube) - 1, columns - 1
    simulation.advance([Target("gripper", tuple(tube[held]))])
    simulation.advance([Grasp("gripper", True), Target("gripper", tuple(tube[held]))])
    direction = (tube[facing] - tube[held]) / np.linalg.norm(tube[facing] - tube[held])
    simulation.advance([Target("gripper", tuple(tube[held] + 1.7 * 0.1 * PERIOD * direction))])

    start = np.ascontiguousarray(tube.T), np.zeros((3, len(tube)))
    for steps in (1, 2, 6, 20):
        plan = scene.plan()
        plan.controls = simulation.plan.controls
        (run,), _ = plan.runs(simulation.time - PERIOD, PERIOD, start, [steps], memory=simulation.state.memory)
        assert run.repeated_without_culling


def test_motion_does_not_depend_on_earlier_runs() -> None:
    # A run with waves in the sheet changes what the next runs record first. In strong gravity, the path of
    # each particle does not show that the sheet stays apart; their relative velocities do.
    columns, speed = 7, 0.5
    moduli = {"material.stretch_modulus": 0.015, "material.shear_modulus": 0.003}
    scene = _tube_scene(columns, gravity=[0.0, 0.0, -120.0], **moduli)
    tube = _open_tube(columns, NEEDED + speed * PERIOD + 1e-5)
    velocities = np.zeros_like(tube)
    velocities[-columns:] = speed * (tube[0] - tube[-columns]) / np.linalg.norm(tube[0] - tube[-columns])

    def motion(plan: Plan) -> list[tuple[int, str]]:
        state, integrator, frames = State(tube, velocities), make_integrator("auto", tolerance=1e-2), []
        for k in range(2):
            done = integrator.advance(plan, state, k * PERIOD, PERIOD)
            frames.append((done.evaluations, state.digest()))
        return frames

    used = scene.plan()
    start = np.ascontiguousarray(tube.T), np.ascontiguousarray(-1.15 * velocities.T)
    used.runs(0.0, 0.065, start, [1], memory={})
    assert motion(used) == motion(scene.plan())


class NotFinite(Force):
    """A force that is no number at a particle from a time on."""

    name = "not finite"

    def add_force(self, t: float, x: Array, v: Array, f: Array) -> None:
        if t > 0.009:
            f[:, 5] = np.nan

    def energy(self, t: float, x: Array) -> float:
        return 0.0

    def add_stiffness(self, x: Array, blocks: Array) -> None:
        """Add none."""


def test_motion_that_is_not_finite_is_not_separated() -> None:
    sheet = GridSheet(height=0.3, width=0.3, rows=8, columns=8, layout="alternating")
    contact = self_contact(sheet.triangles(), sheet.positions(), 4e-3)
    model, places = flat_sheet(8, 8, contact, NotFinite(), size=0.3)
    plan, x = compile(model), np.ascontiguousarray(places.T)
    assert plan.contact is not None
    assert plan.contact.is_clear_of_itself(0.01, x, np.zeros_like(x))
    (run,), _ = plan.runs(0.0, 0.01, (x, np.zeros_like(x)), [20], memory={})
    assert run.repeated_without_culling
