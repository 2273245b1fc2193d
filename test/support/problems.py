# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The scenes that accuracy is measured on: each with its horizon, and an exact solution where there is one."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import attrs
import numpy as np

from cloth_sim_ros.engine.binding import PATH_NUMBERS
from cloth_sim_ros.physics.model.forces.drag import Drag
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.forces.gravity import Gravity
from cloth_sim_ros.physics.model.forces.grips import Grips
from cloth_sim_ros.physics.model.forces.pair_springs import PairSprings, damping_coefficient
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.model.sheets.mesh import MeshSheet
from cloth_sim_ros.physics.model.sheets.surface import Surface
from cloth_sim_ros.physics.plan.plan import Plan, compile
from cloth_sim_ros.physics.state.state import State
from support.raw_sheet import RawSheet

PERIOD = 1.0 / 60.0


@attrs.frozen(kw_only=True)
class Problem:
    """One scene: how to build it, how long a pointwise error means something on it."""

    name: str
    #: Makes the equations of motion and the start.
    build: Callable[[], tuple[Plan, State]]
    #: Frames of `PERIOD` to the horizon.
    frames: int
    description: str
    #: Positions (3, n) at a time [s], where they are known in closed form.
    exact: Callable[[float], Array] | None = None

    @property
    def duration(self) -> float:
        """Horizon [s]."""
        return self.frames * PERIOD


def curtain(resolution: int) -> Problem:
    """Scene C: one whole edge pinned, dropped from flat, k_d0 0.2, drag 1/s."""
    frames = {16: 60, 32: 60, 64: 30, 128: 18}[resolution]

    def build() -> tuple[Plan, State]:
        sheet = RawSheet(resolution=resolution, drag=1.0)
        return sheet.plan(sheet.index[0]), State(sheet.flat(hung=False))

    return Problem(
        name=f"curtain{resolution}",
        build=build,
        frames=frames,
        description=f"C: {resolution} x {resolution}, an edge pinned, dropped from flat",
    )


def hung(resolution: int, stiffness: float = 1.0) -> Problem:
    """Scene H: hung by one edge, pushed out of plane, linearly from the top to 0.5 m/s, k_d0 0.2."""
    frames = 60 if stiffness < 1000.0 else 30

    def build() -> tuple[Plan, State]:
        sheet = RawSheet(resolution=resolution, stiffness=stiffness)
        positions = sheet.flat(hung=True)
        velocities = np.zeros_like(positions)
        velocities[:, 1] = -0.5 * positions[:, 2]
        return sheet.plan(sheet.index[0]), State(positions, velocities)

    return Problem(
        name=f"hung{resolution}" + (f"x{stiffness:g}" if stiffness != 1.0 else ""),
        build=build,
        frames=frames,
        description=f"H: {resolution} x {resolution}, hung and pushed, moduli x {stiffness:g}",
    )


def corner_drop(resolution: int) -> Problem:
    """Scene A: two adjacent corners pinned, dropped from flat, k_d0 0.05; chaotic after 0.5 s."""

    def build() -> tuple[Plan, State]:
        sheet = RawSheet(resolution=resolution, k_d0=0.05)
        return sheet.plan(sheet.index[0, [0, -1]]), State(sheet.flat(hung=False))

    return Problem(
        name=f"corners{resolution}",
        build=build,
        frames=30,
        description=f"A: {resolution} x {resolution}, two corners pinned, dropped from flat",
    )


def chain() -> Problem:
    """S2: 24 particles on a line between two anchors, a smooth longitudinal wave; exact by normal modes."""
    count, stiffness, mass, k_d0 = 24, 200.0, 0.01, 0.1
    damping = float(damping_coefficient(k_d0, stiffness, mass))
    spacing = 1.0 / (count + 1)
    places = np.arange(count + 2) * spacing
    bump = 0.2 * spacing * np.exp(-0.5 * ((np.arange(count + 2) - 8.0) / 2.0) ** 2)
    bump[[0, -1]] = 0.0

    def build() -> tuple[Plan, State]:
        pairs = np.stack([np.arange(count + 1), np.arange(1, count + 2)], axis=1)
        springs = PairSprings(pairs, spacing, stiffness * spacing, damping)
        positions = np.zeros((count + 2, 3))
        positions[:, 0] = places + bump
        model = Model(np.full(count + 2, mass), [springs], anchors=[0, count + 1])
        return compile(model), State(positions)

    def exact(t: float) -> Array:
        # Modes sin(j pi i / (n + 1)) with w = 2 sqrt(k/m) sin(j pi / (2 (n + 1))) and damping ratio k_d0 w / w_max.
        j = np.arange(1, count + 1)
        shapes = np.sin(np.pi * np.outer(np.arange(count + 2), j) / (count + 1))
        amplitudes = 2.0 / (count + 1) * np.einsum("ij,i->j", shapes, bump)
        sine = np.sin(0.5 * np.pi * j / (count + 1))
        omega, ratio = 2.0 * np.sqrt(stiffness / mass) * sine, k_d0 * sine
        ringing = omega * np.sqrt(1.0 - ratio**2)
        decay = np.exp(-ratio * omega * t)
        motion = decay * (np.cos(ringing * t) + ratio * omega / ringing * np.sin(ringing * t))
        x = np.zeros((3, count + 2))
        x[0] = places + np.einsum("ij,j->i", shapes, amplitudes * motion)
        return x

    return Problem(
        name="chain",
        build=build,
        frames=60,
        description="S2: 24 particles between anchors, a wave along it",
        exact=exact,
    )


def drumhead() -> Problem:
    """A stretched sheet with its border pinned, struck smoothly: large tension, small damping."""

    def build() -> tuple[Plan, State]:
        sheet = RawSheet(resolution=16, k_d0=0.1, relative_rest_length=0.9, gravity=(0.0, 0.0, 0.0), drag=0.5)
        index = sheet.index
        border = np.unique(np.concatenate([index[0], index[-1], index[:, 0], index[:, -1]]))
        positions = sheet.flat(hung=False)
        velocities = np.zeros_like(positions)
        away = (positions[:, 0] - 0.4) ** 2 + (positions[:, 1] + 0.45) ** 2
        velocities[:, 2] = 2.0 * np.exp(-away / 0.05)
        velocities[border] = 0.0
        return sheet.plan(border), State(positions, velocities)

    return Problem(
        name="drumhead", build=build, frames=60, description="16 x 16 under 10 % strain, border pinned, struck softly"
    )


def carried(resolution: int = 16) -> Problem:
    """A hung sheet whose lower corner a gripper carries 0.2 m out along a smooth path."""
    frames = 60

    def build() -> tuple[Plan, State]:
        sheet = RawSheet(resolution=resolution, drag=1.0)
        grips = Grips(1)
        corner = sheet.index[-1, -2:].ravel()
        positions = sheet.flat(hung=True)
        grasp_position, travel, duration = positions[corner[-1]], np.array([0.03, 0.2, -0.02]), frames * PERIOD
        row = np.zeros(PATH_NUMBERS)
        row[1:4], row[16] = grasp_position, 1.0
        row[7:10], row[10:13] = 3.0 * travel / duration**2, -2.0 * travel / duration**3
        k = np.full(corner.size, 300.0)
        damping = np.asarray(damping_coefficient(0.5, k, sheet.mass))
        grips.set_grips(
            row[None],
            np.array([0, corner.size]),
            corner.astype(np.int64),
            positions[corner] - grasp_position,
            k,
            damping,
        )
        return sheet.plan(sheet.index[0], [grips]), State(positions)

    return Problem(
        name=f"carried{resolution}",
        build=build,
        frames=frames,
        description=f"{resolution} x {resolution} hung, a corner gripped and carried along a smooth path",
    )


def mesh() -> Problem:
    """An irregular triangle mesh hung by its upper edge and pushed out of plane."""

    def build() -> tuple[Plan, State]:
        sheet = irregular_sheet()
        positions = sheet.positions()
        masses = sheet.masses(0.2)
        springs = sheet.springs(stretch_modulus=1000.0, k_d0=0.2, density=0.2)
        forces = [springs, Gravity(), Drag(1.0)]
        velocities = np.zeros_like(positions)
        velocities[:, 1] = -0.5 * positions[:, 2]
        top = np.flatnonzero(positions[:, 2] > -1e-9)
        return compile(Model(masses, forces, anchors=top)), State(positions, velocities)

    return Problem(
        name="mesh", build=build, frames=30, description="irregular mesh of 150 particles, hung by an edge and pushed"
    )


def irregular_sheet() -> MeshSheet:
    """1 m x 1 m in x-z, hung: 150 particles at random places at least 6 cm apart, Delaunay triangles."""
    from scipy.spatial import Delaunay

    random = np.random.default_rng(7)
    inside = random.uniform(0.0, 1.0, (400, 2))
    border = np.linspace(0.0, 1.0, 11)
    vertices = [[x, z] for x in border for z in (0.0, 1.0)] + [[x, z] for z in border[1:-1] for x in (0.0, 1.0)]
    for point in inside:
        if min(point.min(), 1.0 - point.max()) > 0.05 and all(np.hypot(*(point - p)) > 0.06 for p in vertices):
            vertices.append(list(point))
    points = np.array(vertices)
    triangles = Delaunay(points).simplices.astype(np.int64)
    rest_positions = np.zeros((len(points), 3))
    rest_positions[:, 0], rest_positions[:, 2] = points[:, 0], -points[:, 1]
    return MeshSheet(
        rest_positions=rest_positions, surface=Surface.from_triangles(_counterclockwise(points, triangles))
    )


def _counterclockwise(points: Array, triangles: np.ndarray) -> np.ndarray:
    a, b, c = (points[triangles[:, i]] for i in range(3))
    turned = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0]) < 0.0
    return np.where(turned[:, None], triangles[:, [0, 2, 1]], triangles)


#: Every well-conditioned scene of the suite, by name.
PROBLEMS: dict[str, Callable[[], Problem]] = {
    "chain": chain,
    "drumhead": drumhead,
    "curtain16": partial(curtain, 16),
    "curtain32": partial(curtain, 32),
    "carried16": carried,
    "hung16x100": partial(hung, 16, 100.0),
    "hung32x100": partial(hung, 32, 100.0),
    "mesh": mesh,
}
#: Scenes that are too large, too stiff or chaotic past their horizon; by name too.
MORE_PROBLEMS: dict[str, Callable[[], Problem]] = {
    "curtain64": partial(curtain, 64),
    "curtain128": partial(curtain, 128),
    "corners16": partial(corner_drop, 16),
    "corners32": partial(corner_drop, 32),
    "hung32": partial(hung, 32),
    "hung32x1000": partial(hung, 32, 1000.0),
}


def problem(name: str) -> Problem:
    """Return a scene by its name.

    Raises:
        ValueError: if there is none of that name.
    """
    everything = {**PROBLEMS, **MORE_PROBLEMS}
    if name not in everything:
        raise ValueError(f"no scene '{name}'; there are {', '.join(everything)}")
    return everything[name]()
