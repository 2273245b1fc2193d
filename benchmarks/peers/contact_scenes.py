# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Contact scenes for all engines: drape over a ball, fold, pinch."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray
from support.problems import PERIOD

from benchmarks.peers.environment import thread_edges
from cloth_sim_ros import Scene
from cloth_sim_ros.physics.contact.obstacles import Obstacle
from cloth_sim_ros.physics.model.forces.force import Array

THICKNESS, FRICTION, GRAVITY, TOLERANCE = 2e-3, 0.5, 9.81, 1e-3
#: Drag of the air [1/s]; strong enough for sheets to come to rest. Bending modulus of the peers' sheets [N m].
DRAG, PEER_BENDING = 2.0, 8.3e-5
#: Radius of the ball of the drape, and initial height of the sheet above it [m].
RADIUS, DROP_HEIGHT = 0.1, 0.01
#: Size of the folded sheet [m]; time for which its edge is carried [s]; distance from the other edge at the end [m].
FOLD_SIZE, FOLD_TIME, FOLD_SHORTFALL = 0.3, 2.0, 3e-3
#: Size of a pad along its axes [m], y normal to the faces; distance from its lower edge to the sheet's upper edge [m];
#: force [N].
PAD_SIZE, CLAMPED_HEIGHT, PAD_FORCE = (0.04, 0.01, 0.05), 0.045, 4.0
#: Half the initial distance between the pads' faces [thicknesses].
PAD_CLEARANCE = 1.2
#: Parameters of all scenes: the default material, with explicit values of those that peers receive, and strong drag.
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


#: The peers' sheet as the product's material: isotropic, with zero Poisson ratio.
PEER_MATERIAL: dict[str, Any] = {
    "material.shear_modulus": 500.0,
    "material.bending_modulus": PEER_BENDING,
    "bending.model": "altitude",
}


@attrs.frozen(eq=False, kw_only=True)
class ContactScene:
    """Contact scene for all engines."""

    name: str
    #: Scene of the product.
    scene: Scene
    duration: float
    #: Static obstacles, at the positions below (m, 3) [m].
    solids: tuple[Obstacle, ...] = ()
    solid_positions: Array = attrs.field(factory=lambda: np.zeros((0, 3)))
    #: Pads, a box each, and initial positions of their centres, (2, 3) [m].
    pads: tuple[Obstacle, ...] = ()
    pad_positions: Array = attrs.field(factory=lambda: np.zeros((0, 3)))
    #: Held particles, and their positions at the start and the end of each frame of the hold [m],
    #: (frames + 1, held, 3).
    held: NDArray[np.int64] = attrs.field(factory=lambda: np.zeros(0, dtype=np.int64))
    path: Array = attrs.field(factory=lambda: np.zeros((1, 0, 3)))
    #: Whether self-contact is on.
    self_contact: bool = False

    @property
    def frames(self) -> int:
        """Number of frames."""
        return round(self.duration / PERIOD)

    @property
    def hold(self) -> int:
        """Number of frames in which particles are held."""
        return len(self.path) - 1

    @property
    def triangles(self) -> NDArray[np.int64]:
        """Triangles of the sheet, (t, 3)."""
        return np.asarray(self.scene.sheet.triangles())

    @property
    def edges(self) -> NDArray[np.int64]:
        """Edges along the threads, (m, 2)."""
        columns, rows = self.scene.cloth.resolution
        return thread_edges(rows, columns)

    @property
    def edge_lengths(self) -> Array:
        """Lengths of these edges at rest [m], (m,)."""
        return np.asarray(np.linalg.norm(np.subtract(*self.start[self.edges.T]), axis=1))

    @property
    def start(self) -> Array:
        """Initial positions [m], (n, 3)."""
        return self.scene.starting_state().positions

    def tables(self) -> dict[str, Any]:
        """Return the scene as plain tables for a peer.

        `kind` is the name of the scene. The sheet has `positions` (n, 3) [m], `masses` [kg], `anchored` (n,),
        `triangles`, `thickness` [m], `friction`, `modulus` [N/m] along the threads and `bending` modulus [N m]. Its
        `edges` along the threads have `edge_lengths` [m]. Its `retardation` [s] is the damping over the stiffness of
        its springs. `own` tells if self-contact is on; `held` and `path` describe held particles. The world has
        `gravity` [m/s^2] and `drag` of the air [1/s]. A ball has `radius` [m] about the origin; pads have `pad_size`
        [m], `pad_places` [m] and `force` [N]. A table's top is at z = 0.
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
            "edges": self.edges,
            "edge_lengths": self.edge_lengths,
            "thickness": THICKNESS,
            "friction": FRICTION,
            "modulus": material.stretch_modulus,
            "bending": PEER_BENDING,
            "retardation": material.damping * np.sqrt(heaviest / material.stretch_modulus),
            "gravity": np.array([0.0, 0.0, -GRAVITY]),
            "drag": DRAG,
            "own": self.self_contact,
            "held": self.held,
            "path": self.path,
            "radius": RADIUS,
            "pad_size": np.array(PAD_SIZE),
            "pad_places": self.pad_positions,
            "force": PAD_FORCE,
        }


def drape(resolution: int) -> ContactScene:
    """Return the drape: a square sheet of 0.5 m falls on a static ball."""
    friction = [FRICTION, FRICTION]
    values = {
        "cloth.size": [0.5, 0.5],
        "cloth.resolution": [resolution, resolution],
        "cloth.position": [0.0, 0.0, RADIUS + DROP_HEIGHT],
        "obstacles": ["ball"],
        "ball.shape": "sphere",
        "ball.size": [RADIUS],
        "ball.friction": friction,
    }
    ball = Obstacle(name="ball", shape="sphere", size=(RADIUS,), friction=friction)
    scene = Scene.from_parameters({**_COMMON, **values})
    return ContactScene(name="drape", scene=scene, duration=3.0, solids=(ball,), solid_positions=np.zeros((1, 3)))


def fold(resolution: int, **changes: Any) -> ContactScene:
    """Return the fold: one edge of a sheet on a table is carried to the other edge and released.

    The other edge is anchored, because otherwise sliding on the table would decide the line of the fold.

    Args:
        resolution: particles a side.
        changes: other values of parameters of the product's scene.
    """
    friction = [FRICTION, FRICTION]
    spacing = FOLD_SIZE / (resolution - 1)
    names = [f"hand{k}" for k in range(resolution)]
    values = {
        "cloth.size": [FOLD_SIZE, FOLD_SIZE],
        "cloth.resolution": [resolution, resolution],
        "cloth.position": [0.0, 0.0, THICKNESS],
        "cloth.anchors": ["bottom"],
        "contact.self": True,
        "contact.friction": friction,
        "obstacles": ["table"],
        "table.shape": "plane",
        "table.friction": friction,
        # Each gripper holds one particle of the edge.
        "grippers": names,
        "gripper.radius": 0.4 * spacing,
    }
    scene = Scene.from_parameters({**_COMMON, **values, **changes})
    # The first row of a grid is the upper edge.
    held = np.arange(resolution)
    start = scene.starting_state().positions[held]
    return ContactScene(
        name="fold",
        scene=scene,
        duration=FOLD_TIME + 1.0,
        solids=(Obstacle(name="table", shape="plane", friction=friction),),
        solid_positions=np.zeros((1, 3)),
        held=held,
        path=start + edge_path()[:, None, :],
        self_contact=True,
    )


def edge_path() -> Array:
    """Return the displacement of a carried edge by frame [m], (frames + 1, 3): half a circle towards -y.

    The edge is grasped in the first frame. It moves from rest to rest with minimum jerk and ends 1.5 thicknesses above
    the lower layer.
    """
    count = round(FOLD_TIME / PERIOD)
    u = np.concatenate([[0.0], np.linspace(0.0, 1.0, count + 1)])
    s = u * u * u * (10.0 - 15.0 * u + 6.0 * u * u)
    radius = 0.5 * (FOLD_SIZE - FOLD_SHORTFALL)
    across, up = radius * (np.cos(np.pi * s) - 1.0), radius * np.sin(np.pi * s) + 1.5 * THICKNESS * s
    return np.stack([np.zeros_like(s), across, up], axis=1)


def pinch(resolution: int) -> ContactScene:
    """Return the pinch: a sheet of nearly square cells hangs between two pads that press on its upper quarter."""
    values = {
        "cloth.size": [0.18, 0.09],
        "cloth.resolution": [resolution, max(3, round(0.5 * resolution))],
        # The default orientation: in a plane of constant y, the upper edge at z = 0.
        "cloth.orientation": [0.7071067811865476, 0.0, 0.0, 0.7071067811865476],
        "cloth.position": [0.0, 0.0, -0.09],
        "grippers": ["hand"],
        "gripper.mode": "pinch",
        "gripper.pad_size": list(PAD_SIZE),
        "gripper.opening": 2.0 * PAD_CLEARANCE * THICKNESS,
        "gripper.force": PAD_FORCE,
        "gripper.friction": [FRICTION, FRICTION],
    }
    away, middle = PAD_CLEARANCE * THICKNESS + 0.5 * PAD_SIZE[1], 0.5 * PAD_SIZE[2] - CLAMPED_HEIGHT
    return ContactScene(
        name="pinch",
        scene=Scene.from_parameters({**_COMMON, **values}),
        duration=10.0,
        pads=tuple(Obstacle(name=name, shape="box", size=PAD_SIZE) for name in ("left", "right")),
        pad_positions=np.array([[0.0, away, middle], [0.0, -away, middle]]),
    )


CONTACT_SCENES: dict[str, Callable[[int], ContactScene]] = {"drape": drape, "fold": fold, "pinch": pinch}
