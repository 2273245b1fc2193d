# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Scenes with contact that other engines run too: a sheet falls on a ball, is folded on a table, hangs between pads."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray
from support.problems import PERIOD

from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.obstacles import Obstacle
from cloth_sim_ros.scene.scene import Scene

THICKNESS, FRICTION, GRAVITY, TOLERANCE = 2e-3, 0.5, 9.81, 1e-3
#: Of the air [1/s]: thick enough for sheets to come to rest.
DRAG = 2.0
#: Ball of the drape, and how far above it the sheet starts [m].
RADIUS, ABOVE = 0.1, 0.01
#: Size of the folded sheet [m]; how long its edge is carried [s]; by how much short of the other edge it lands [m].
TOWEL, CARRIED, SHORT = 0.3, 2.0, 3e-3
#: Pads along their own axes [m], y across their faces; the way from their lower edge to the sheet's upper one; their
#: force [N].
PAD, BETWEEN, FORCE = (0.04, 0.01, 0.05), 0.045, 4.0
#: Half the way between the pads' faces at the start, in thicknesses.
APART = 1.2
#: All our scenes: the default material, with the numbers that peers are given said again, in thick air.
_COMMON: dict[str, Any] = {
    "rate": 1.0 / PERIOD,
    "cloth.anchors": [""],
    "cloth.orientation": [0.0, 0.0, 0.0, 1.0],
    "material.density": 0.2,
    "material.stretch_modulus": 1000.0,
    "air.drag": DRAG,
    "wind.normal_drag": 0.0,
    "contact.thickness": THICKNESS,
    "grippers": [""],
    "tolerance": TOLERANCE,
}


@attrs.frozen(eq=False, kw_only=True)
class Contest:
    """One scene, for all engines."""

    name: str
    #: Ours.
    scene: Scene
    duration: float
    #: What stands still, at the places below (m, 3) [m].
    solids: tuple[Obstacle, ...] = ()
    places: Array = attrs.field(factory=lambda: np.zeros((0, 3)))
    #: Pads, a box each, and where their centres start, (2, 3) [m].
    pads: tuple[Obstacle, ...] = ()
    pad_places: Array = attrs.field(factory=lambda: np.zeros((0, 3)))
    #: Particles that are held, and where they are at the start and at the end of each frame in which they are,
    #: (frames + 1, held, 3) [m].
    held: NDArray[np.int64] = attrs.field(factory=lambda: np.zeros(0, dtype=np.int64))
    path: Array = attrs.field(factory=lambda: np.zeros((1, 0, 3)))
    #: Whether the cloth is kept out of itself.
    own: bool = False

    @property
    def frames(self) -> int:
        """How many there are in all."""
        return round(self.duration / PERIOD)

    @property
    def hold(self) -> int:
        """Frames in which particles are held."""
        return len(self.path) - 1

    @property
    def triangles(self) -> NDArray[np.int64]:
        """Of the sheet, (t, 3)."""
        found: NDArray[np.int64] = self.scene.sheet.triangles()
        return found

    @property
    def start(self) -> Array:
        """Where particles start [m], (n, 3)."""
        return self.scene.starting_state().positions

    def tables(self) -> dict[str, Any]:
        """Return what a peer is told, as plain tables.

        `kind`; of the sheet `positions` (n, 3) [m], `masses` [kg], `anchored` (n,), `triangles`, `thickness` [m],
        `friction`, `modulus` [N/m] along the threads, `retardation` [s], the damping over the stiffness of its
        springs; `gravity` [m/s^2]; `drag` of the air [1/s]; `own`, whether it is kept out of itself; `held`, `path`;
        of a ball `radius` [m] about the origin; of pads `pad_size`, `pad_places` [m] and `force` [N]. A table's top is
        at z = 0.
        """
        cloth, material, model = self.scene.cloth, self.scene.material, self.scene.model()
        spacing = cloth.size[0] / (cloth.resolution[0] - 1)
        heaviest = material.density * spacing * spacing
        return {
            "kind": self.name,
            "positions": self.start,
            "masses": model.masses,
            "anchored": model.inverse_masses == 0.0,
            "triangles": self.triangles,
            "thickness": THICKNESS,
            "friction": FRICTION,
            "modulus": material.stretch_modulus,
            "retardation": material.damping * np.sqrt(heaviest / material.stretch_modulus),
            "gravity": np.array([0.0, 0.0, -GRAVITY]),
            "drag": DRAG,
            "own": self.own,
            "held": self.held,
            "path": self.path,
            "radius": RADIUS,
            "pad_size": np.array(PAD),
            "pad_places": self.pad_places,
            "force": FORCE,
        }


def drape(resolution: int) -> Contest:
    """A square sheet of 0.5 m falls on a ball that stands still."""
    rough = [FRICTION, FRICTION]
    values = {
        "cloth.size": [0.5, 0.5],
        "cloth.resolution": [resolution, resolution],
        "cloth.position": [0.0, 0.0, RADIUS + ABOVE],
        "obstacles": ["ball"],
        "ball.shape": "sphere",
        "ball.size": [RADIUS],
        "ball.friction": rough,
    }
    ball = Obstacle(name="ball", shape="sphere", size=(RADIUS,), friction=rough)
    scene = Scene.from_parameters({**_COMMON, **values})
    return Contest(name="drape", scene=scene, duration=3.0, solids=(ball,), places=np.zeros((1, 3)))


def fold(resolution: int) -> Contest:
    """A square sheet lies on a table; one edge is carried in half a circle over to the other, and let go.

    The other edge is anchored: without, how the sheet slides on the table would decide where it is folded.
    """
    rough = [FRICTION, FRICTION]
    spacing = TOWEL / (resolution - 1)
    names = [f"hand{k}" for k in range(resolution)]
    values = {
        "cloth.size": [TOWEL, TOWEL],
        "cloth.resolution": [resolution, resolution],
        "cloth.position": [0.0, 0.0, THICKNESS],
        "cloth.anchors": ["bottom"],
        "contact.self": True,
        "contact.friction": rough,
        "obstacles": ["table"],
        "table.shape": "plane",
        "table.friction": rough,
        # Each holds one particle of the edge.
        "grippers": names,
        "gripper.radius": 0.4 * spacing,
    }
    scene = Scene.from_parameters({**_COMMON, **values})
    # Of a grid the first row is the upper edge.
    held = np.arange(resolution)
    start = scene.starting_state().positions[held]
    return Contest(
        name="fold",
        scene=scene,
        duration=CARRIED + 1.0,
        solids=(Obstacle(name="table", shape="plane", friction=rough),),
        places=np.zeros((1, 3)),
        held=held,
        path=start + carried()[:, None, :],
        own=True,
    )


def carried() -> Array:
    """Where an edge is carried, from where it was [m], frame by frame, (frames + 1, 3): half a circle towards -y.

    The first frame is that in which it is taken hold of. From rest to rest, with the least jerk. It lands one and a
    half thicknesses above what lies below.
    """
    count = round(CARRIED / PERIOD)
    u = np.concatenate([[0.0], np.linspace(0.0, 1.0, count + 1)])
    s = u * u * u * (10.0 - 15.0 * u + 6.0 * u * u)
    radius = 0.5 * (TOWEL - SHORT)
    across, up = radius * (np.cos(np.pi * s) - 1.0), radius * np.sin(np.pi * s) + 1.5 * THICKNESS * s
    return np.stack([np.zeros_like(s), across, up], axis=1)


def pinch(resolution: int) -> Contest:
    """A sheet hangs between two pads that press on the upper quarter of it. Its cells are square, or nearly so."""
    values = {
        "cloth.size": [0.18, 0.09],
        "cloth.resolution": [resolution, max(3, round(0.5 * resolution))],
        # The default orientation: in a plane of constant y, the upper edge at z = 0.
        "cloth.orientation": [0.7071067811865476, 0.0, 0.0, 0.7071067811865476],
        "cloth.position": [0.0, 0.0, -0.09],
        "grippers": ["hand"],
        "gripper.mode": "pinch",
        "gripper.pad_size": list(PAD),
        "gripper.opening": 2.0 * APART * THICKNESS,
        "gripper.force": FORCE,
        "gripper.friction": [FRICTION, FRICTION],
    }
    away, middle = APART * THICKNESS + 0.5 * PAD[1], 0.5 * PAD[2] - BETWEEN
    return Contest(
        name="pinch",
        scene=Scene.from_parameters({**_COMMON, **values}),
        duration=10.0,
        pads=tuple(Obstacle(name=name, shape="box", size=PAD) for name in ("left", "right")),
        pad_places=np.array([[0.0, away, middle], [0.0, -away, middle]]),
    )


CONTESTS: dict[str, Callable[[int], Contest]] = {"drape": drape, "fold": fold, "pinch": pinch}
