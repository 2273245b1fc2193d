# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sheets on obstacles that contact is measured by; nothing sleeps, for there is no simulation around them."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from cloth_sim_ros.physics.accounting.work_accumulator import WorkAccumulator
from cloth_sim_ros.physics.contact.obstacles import Obstacle
from cloth_sim_ros.physics.integrators.base import Advance
from cloth_sim_ros.physics.model.forces.contact import Contact
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.plan.plan import compile
from cloth_sim_ros.scene.scene import Scene
from support import garment
from support.random_meshes import shuffled_mesh

FRAME = 1.0 / 60.0
THICKNESS = 2e-3
#: Where contact bears a sheet's weight, in thicknesses (docs/contact.md).
BORNE = 0.98
#: A sheet of 0.3 m without air about it.
SHEET: dict[str, Any] = {
    "cloth.size": [0.3, 0.3],
    "cloth.anchors": [""],
    "grippers": [""],
    "air.drag": 0.0,
    "wind.normal_drag": 0.0,
    "contact.thickness": THICKNESS,
}


def sheet(kind: str, count: int) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Parameters and files of a sheet of count x count particles, as a grid or as an irregular mesh."""
    if kind == "grid":
        return {**SHEET, "cloth.resolution": [count, count]}, {}
    rest_positions, triangles = shuffled_mesh(count * count)
    values = {name: value for name, value in SHEET.items() if name != "cloth.size"}
    values |= {"cloth.mesh": "mesh.obj", "bending.model": "opposite"}
    return values, {"mesh.obj": garment.as_obj(0.3 * (rest_positions - [0.5, 0.5, 0.0]), triangles)}


class Motion:
    """A scene's cloth, advanced frame by frame."""

    def __init__(self, values: dict[str, Any], files: dict[str, bytes] | None = None) -> None:
        scene = Scene.from_parameters(values, files=files or {})
        self.plan, self.state, self._steps = scene.plan(), scene.starting_state(), scene.build_integrator()
        self.frames = 0

    def advance(self, accumulator: WorkAccumulator | None = None) -> Advance:
        """Advance by one frame."""
        done = self._steps.advance(self.plan, self.state, self.frames * FRAME, FRAME, accumulator)
        self.frames += 1
        return done

    def advance_frames(self, frames: int) -> None:
        """Advance by some frames."""
        for _ in range(frames):
            self.advance()


def slope(kind: str, count: int, degrees: float, friction: tuple[float, float], tolerance: float = 1e-4) -> Motion:
    """A sheet that is laid at rest on a plane turned about y."""
    turn = Rotation.from_euler("y", degrees, degrees=True)
    values, files = sheet(kind, count)
    values |= {
        "cloth.position": turn.apply([0.0, 0.0, BORNE * THICKNESS]).tolist(),
        "cloth.orientation": turn.as_quat().tolist(),
        "tolerance": tolerance,
        "obstacles": ["slope"],
        "slope.shape": "plane",
        "slope.orientation": turn.as_quat().tolist(),
        "slope.friction": list(friction),
    }
    return Motion(values, files)


class Capstan:
    """A limp strip, anchored at both ends, over a drum that turns under it. No gravity, no drag.

    Args:
        friction: coefficient, at rest and in motion.
        angle: over which the strip lies on the drum [rad].
        columns: particles along the strip; it is three wide.
        stretch: of the strip as it is laid.
    """

    radius, thickness, free, spin, rows = 0.05, 1e-3, 0.1, 4.0, 3

    def __init__(self, friction: float, angle: float, *, columns: int = 160, stretch: float = 0.02) -> None:
        r = self.radius + BORNE * self.thickness
        path_length = r * angle + 2.0 * self.free
        width = path_length / (1.0 + stretch) * (self.rows - 1) / (columns - 1)
        values = {
            **SHEET,
            "cloth.resolution": [self.rows, columns],
            "cloth.size": [width, path_length / (1.0 + stretch)],
            "bending.model": "none",
        }
        model = Scene.from_parameters(values).model()
        springs = [force for force in model.forces if force.name in ("structural", "shear")]
        drum = Obstacle(name="drum", shape="cylinder", size=(self.radius, 0.2), friction=(friction, friction))
        self._contact = Contact([drum], thickness=self.thickness)
        ends = [row * columns + end for row in range(self.rows) for end in (0, columns - 1)]
        self.plan = compile(Model(model.masses, [*springs, self._contact], anchors=ends))
        self._springs = compile(Model(model.masses, springs))
        arc = np.linspace(0.0, path_length, columns) - self.free
        wrapped = np.clip(arc, 0.0, r * angle)
        wrap_angle = wrapped / r - 0.5 * angle
        x = r * np.sin(wrap_angle) + (arc - wrapped) * np.cos(wrap_angle)
        z = r * np.cos(wrap_angle) - (arc - wrapped) * np.sin(wrap_angle)
        across = (np.arange(self.rows) - 1.0) * width / (self.rows - 1)
        self.start = np.stack([np.tile(x, self.rows), np.repeat(across, columns), np.tile(z, self.rows)], axis=1)
        self._columns = columns

    def turn(self, t: float) -> None:
        """Let the drum, its axis along y, turn on from time t [s] on."""
        path = np.zeros((1, 26))
        about = Rotation.from_rotvec([0.0, self.spin * t, 0.0]) * Rotation.from_euler("x", 90, degrees=True)
        path[0, 0], path[0, 13:17], path[0, 17:20] = t, about.as_quat(), [0.0, self.spin, 0.0]
        self._contact.set_paths(path)

    def tensions(self, x: Array, v: Array) -> tuple[float, float]:
        """Return the tensions of the two ends [N] at positions and velocities (3, n)."""
        f = np.zeros_like(x)
        self._springs.add_force(0.0, x, v, f)
        ends = f.reshape(3, self.rows, self._columns).sum(axis=1)[:, [0, -1]]
        first, last = np.linalg.norm(ends, axis=0)
        return float(first), float(last)
