# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Friction between two pads against theory: holding force, creep, and excursion while carried.

A sheet of 0.18 x 0.09 m and 0.2 kg/m^2 hangs by its upper part between two pads; thickness 2 mm, tolerance 1e-5 m.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
from support import garment
from support.obstacle_sheets import FRAME, SHEET, THICKNESS
from support.random_meshes import shuffled_mesh

from cloth_sim_ros.physics.contact.parallel_jaw import ParallelJaw, drive_inertia
from cloth_sim_ros.physics.control.automatic import make_integrator
from cloth_sim_ros.physics.model.forces.contact import Contact
from cloth_sim_ros.physics.model.forces.drag import Drag
from cloth_sim_ros.physics.model.forces.gravity import Gravity
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.plan.plan import compile
from cloth_sim_ros.physics.state.controller_state import ANCHORS_KEY, JAWS_KEY
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.scene import Scene
from validation.report import Report, Table

G = 9.81
HEIGHT, WIDTH = 0.18, 0.09
#: Height of the clamped part [m].
CLAMPED_HEIGHT = 0.045
#: Frames until the full weight acts and the sheet is at rest, and frames in which it must then stay.
SETTLING_FRAMES, OBSERVED_FRAMES = 70, 60
#: Relative error of the holding force; excursion [spacings]; creep and residual displacement [m].
FORCE_MARGIN, MAX_EXCURSION, MAX_CREEP = 0.01, 0.01, 1e-6
#: Largest speed [m/s] and acceleration [m/s^2] while carried.
CARRY_SPEED, CARRY_ACCELERATION = 1.0, 2.0


class PinchedSheet:
    """Sheet that hangs between closed pads.

    Args:
        kind: grid or mesh.
        columns: particles across; a grid is twice as high.
        mu: coefficient of static and of kinetic friction.
        share: force of a pad over the smallest holding force, m g / (2 mu).
    """

    def __init__(self, kind: str, columns: int, mu: float, share: float) -> None:
        values, files = _sheet(kind, columns)
        scene = Scene.from_parameters(values, files=files)
        rest_positions, free = scene.sheet.positions(), scene.model()
        places = np.stack([rest_positions[:, 0], np.zeros(len(rest_positions)), rest_positions[:, 1]], axis=1)
        places[:, 0] -= 0.5 * (places[:, 0].min() + places[:, 0].max())
        places[:, 2] -= places[:, 2].max()
        mass = float(free.masses.sum())
        force, speed = share * mass * G / (2.0 * mu), 0.05
        pads = ParallelJaw(
            gripper="hand",
            size=(2.0 * WIDTH, 0.01, 2.0 * CLAMPED_HEIGHT),
            friction=(mu, mu),
            force=force,
            speed=speed,
            opening=0.02,
            inertia=drive_inertia(mass, force, speed),
        )
        self.contact = Contact([], thickness=THICKNESS, jaws=[pads])
        sheet_forces = [term for term in free.forces if term.name not in ("gravity", "drag")]
        self.plan = compile(Model(free.masses, [*sheet_forces, self.contact]))
        self.state = State(places)
        self.state.memory[JAWS_KEY] = np.array([[1.2 * THICKNESS, 0.0]])
        self._steps, self._frames = make_integrator("auto", tolerance=1e-5), 0
        self.between = places[:, 2] > -CLAMPED_HEIGHT
        self.spacing = WIDTH / (columns - 1)
        self.move(np.zeros(3), np.zeros(3), np.zeros(3))
        self.contact.set_jaw_commands(np.array([[True, True]]))
        # Gravity ramps up within half a second, with strong drag, so that the sheet does not fall into the pads.
        for k in range(SETTLING_FRAMES):
            self.set_uniform_forces(G * min(1.0, max(0.0, (k - 10) / 30)), 5.0)
            self.advance()
        self.set_uniform_forces(G, 0.2)

    def set_uniform_forces(self, gravity: float, drag: float) -> None:
        """Set gravity downward [m/s^2] and drag [1/s]."""
        uniform = [*([Gravity((0.0, 0.0, -gravity))] if gravity else []), Drag(drag)]
        forces = [force for force in self.plan.model.forces if force.name not in ("gravity", "drag")]
        self.plan.change_uniform([*forces, *uniform], uniform)

    def move(self, position: Any, speed: Any, acceleration: Any) -> None:
        """Set position [m], speed [m/s] and acceleration [m/s^2] of both pads, each (3,), for the next frame."""
        path = np.zeros((2, 26))
        path[:, 0], path[:, 16] = self._frames * FRAME, 1.0
        path[:, 1:4], path[:, 4:7], path[:, 7:10] = position, speed, 0.5 * np.asarray(acceleration)
        self.contact.set_paths(path)

    def advance(self, frames: int = 1) -> None:
        """Advance by some frames."""
        for _ in range(frames):
            self._steps.advance(self.plan, self.state, self._frames * FRAME, FRAME)
            self._frames += 1

    @property
    def anchors(self) -> Any:
        """Copy of the friction anchors."""
        return self.state.memory[ANCHORS_KEY].copy()


def _sheet(kind: str, columns: int) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Return parameters and files of the sheet, which starts in a plane of constant z."""
    values = {**SHEET, "cloth.orientation": [0.0, 0.0, 0.0, 1.0], "cloth.size": [HEIGHT, WIDTH]}
    values["material.density"] = 0.2
    if kind == "grid":
        return {**values, "cloth.resolution": [2 * columns - 1, columns]}, {}
    rest_positions, triangles = shuffled_mesh(2 * columns * columns)
    del values["cloth.size"]
    values |= {"cloth.mesh": "mesh.obj", "bending.model": "opposite"}
    return values, {"mesh.obj": garment.as_obj(rest_positions * [WIDTH, HEIGHT, 1.0], triangles)}


def pinch(report: Report, options: argparse.Namespace) -> None:
    """Measure sheets just below and above the holding force, a long hold, and carried sheets."""
    _measure_holding_force(report)
    _measure_creep(report, options.drift)
    _measure_carrying(report)


def _measure_holding_force(report: Report) -> None:
    columns = ["mu", "sheet", "at 0.99: way mm", "at 1.01: way mm", "anchors that moved"]
    table = report.add_table("A pinch: force over m g / (2 mu) at which a sheet slides and is held", columns)
    for mu in (0.2, 0.5, 1.0):
        for kind, count in (("grid", 4), ("grid", 8), ("mesh", 6)):
            displacements, moved = [], 0
            for share in (1.0 - FORCE_MARGIN, 1.0 + FORCE_MARGIN):
                pinched = PinchedSheet(kind, count, mu, share)
                start, start_anchors = pinched.state.x[2].mean(), pinched.anchors
                pinched.advance(OBSERVED_FRAMES)
                displacements.append(float(start - pinched.state.x[2].mean()))
                moved = int((pinched.anchors != start_anchors).any(axis=1).sum())
            name = f"{kind} of {pinched.state.particle_count}"
            table.rows.append([mu, name, 1e3 * displacements[0], 1e3 * displacements[1], moved])
            if not (displacements[0] > 1e-3 and displacements[1] < MAX_CREEP and not moved):
                report.fail(
                    f"mu {mu}, {name}: it slides {1e3 * displacements[0]:.3g} mm, is held to {displacements[1]:.2g} m"
                )


def _measure_creep(report: Report, seconds: float) -> None:
    pinched = PinchedSheet("grid", 4, 0.5, 2.0)
    pinched.advance(OBSERVED_FRAMES)
    start, start_anchors = pinched.state.x.copy(), pinched.anchors
    pinched.advance(round(seconds / FRAME))
    displacement = float(np.abs(pinched.state.x - start).max())
    slipped = int((pinched.anchors != start_anchors).sum())
    columns = ["seconds", "largest way um", "numbers of anchors that changed"]
    report.tables.append(Table("A pinch at twice that force", columns, [[seconds, 1e6 * displacement, slipped]]))
    if displacement >= MAX_CREEP or slipped:
        report.fail(f"a sheet that is pinched crept by {displacement:.2g} m, {slipped} numbers of anchors changed")


def _measure_carrying(report: Report) -> None:
    columns = ["along", "force over m g / (2 mu)", "sheet", "largest excursion in spacings", "left at rest um"]
    table = report.add_table("Carried by a pinch at 1 m/s and 2 m/s^2", [*columns, "anchors that slipped"])
    for direction, axis, share in (("sideways, in its plane", 0, 4.0), ("across", 1, 2.0), ("up", 2, 2.0)):
        for kind, count in (("grid", 4), ("grid", 8)):
            excursion, residual, moved = _carry(PinchedSheet(kind, count, 0.5, share), axis)
            table.rows.append([direction, share, f"{kind} {count}", excursion, 1e6 * residual, moved])
            if excursion > MAX_EXCURSION or residual > MAX_CREEP:
                report.fail(
                    f"carried {direction}, {kind} {count}: gives by {excursion:.2g} spacings, {residual:.2g} m left"
                )
    report.note(
        "a sheet that is carried sideways in its own plane turns about the pads and loads their ends alone: that takes "
        "more than twice the force that bears its weight"
    )


def _carry(pinched: PinchedSheet, axis: int) -> tuple[float, float, int]:
    """Carry the sheet by 1 m and wait; return largest excursion [spacings], residual [m], number of moved anchors."""
    pinched.advance(OBSERVED_FRAMES)
    start, start_anchors = pinched.state.x[:, pinched.between], pinched.anchors
    along, position, speed, max_excursion = np.eye(3)[axis], 0.0, 0.0, 0.0
    ramp_frames = round(0.5 * CARRY_SPEED / (0.5 * CARRY_ACCELERATION) / FRAME)
    for k in range(4 * ramp_frames):
        acceleration = 0.0
        if k < ramp_frames:
            acceleration = CARRY_ACCELERATION
        elif 2 * ramp_frames <= k < 3 * ramp_frames:
            acceleration = -CARRY_ACCELERATION
        pinched.move(position * along, speed * along, acceleration * along)
        pinched.advance()
        position, speed = position + speed * FRAME + 0.5 * acceleration * FRAME**2, speed + acceleration * FRAME
        excursion = np.abs(pinched.state.x[:, pinched.between] - position * along[:, None] - start).max()
        max_excursion = max(max_excursion, float(excursion))
    # Without the higher drag the swing decays within minutes.
    pinched.set_uniform_forces(G, 5.0)
    pinched.advance(240)
    excursion = np.abs(pinched.state.x[:, pinched.between] - position * along[:, None] - start).max()
    return max_excursion / pinched.spacing, float(excursion), int((pinched.anchors != start_anchors).any(axis=1).sum())
