# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bending tensor of a periodic pattern of hinges, by linear theory.

Small deflections z fold hinge i by θ_i = M/(e h0 h1) Σ w_k z_k, with S8's weights w. The deflection is a quadratic
surface with curvatures κ = (κ_xx, κ_yy, 2 κ_xy) plus any periodic deflection. The minimum of the energy ½ Σ k_θ θ² per
area is ½ κ'Cκ. C is the sheet's bending tensor on lengths far above its triangles.
"""

from __future__ import annotations

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.sheets.bending import grid_hinge_constants, mesh_hinge_constants
from cloth_sim_ros.physics.model.sheets.surface import Layout, Surface, grid_hinges, grid_triangles


@attrs.frozen(eq=False, kw_only=True)
class Patch:
    """One period of a flat pattern."""

    #: Particles of the period and enough copies around it [m], (n, 2).
    positions: Array
    #: Hinges of the period, (m, 4).
    hinges: NDArray[np.int64]
    #: k_θ [N m] for the modulus 1 N m, (m,).
    constants: Array
    #: Index of the particle within the period that each is a copy of, (n,).
    periodic_index: NDArray[np.int64]
    #: Area of the period [m²].
    area: float


@attrs.frozen(kw_only=True)
class Plate:
    """Moduli of a plate, in units of the nominal modulus."""

    #: Moment over curvature of a strip along x with free edges.
    along_x: float
    #: Moment over curvature of a strip along y with free edges.
    along_y: float
    #: Moment over curvature along x with no curvature across.
    cylindrical: float
    #: Poisson's ratio of bending, C12/C11.
    poisson: float
    #: Rate of twist over curvature of the free strip along x, κ_xy/κ_xx; 0 if a bent strip does not twist.
    twist: float
    #: 2 C33/(C11 - C12): 1 for an isotropic plate.
    isotropy: float


def plate_moduli(patch: Patch) -> Plate:
    """Return the moduli of a pattern."""
    p = patch.positions[patch.hinges]
    a, b, r = p[:, 1] - p[:, 0], p[:, 3] - p[:, 2], p[:, 2] - p[:, 0]
    area = _cross(a, b)
    s, t = _cross(r, b) / area, _cross(r, a) / area
    edge = np.linalg.norm(a, axis=1)
    heights = np.abs(_cross(a, r)), np.abs(_cross(a, p[:, 3] - p[:, 0]))
    fold = np.stack((s - 1.0, -s, 1.0 - t, t), axis=1) * (np.abs(area) * edge / (heights[0] * heights[1]))[:, None]
    n_particles = int(patch.periodic_index.max()) + 1
    deflection_folds = np.zeros((len(p), n_particles))
    np.add.at(deflection_folds, (np.arange(len(p))[:, None], patch.periodic_index[patch.hinges]), fold)
    x, y = patch.positions.T
    patterns = (0.5 * x * x, 0.5 * y * y, 0.5 * x * y)
    curvature_folds = np.stack([(fold * z[patch.hinges]).sum(axis=1) for z in patterns], axis=1)
    root_stiffness = np.sqrt(patch.constants)[:, None]
    relaxed_folds = root_stiffness * (
        curvature_folds
        - deflection_folds
        @ np.linalg.lstsq(root_stiffness * deflection_folds, root_stiffness * curvature_folds, rcond=None)[0]
    )
    tensor = relaxed_folds.T @ relaxed_folds / patch.area
    compliance = np.linalg.inv(tensor)
    return Plate(
        along_x=float(1.0 / compliance[0, 0]),
        along_y=float(1.0 / compliance[1, 1]),
        cylindrical=float(tensor[0, 0]),
        poisson=float(tensor[0, 1] / tensor[0, 0]),
        twist=float(0.5 * compliance[0, 2] / compliance[0, 0]),
        isotropy=float(2.0 * tensor[2, 2] / (tensor[0, 0] - tensor[0, 1])),
    )


def grid_patch(layout: Layout | None = None, *, spacing: tuple[float, float] = (1.0, 1.0)) -> Patch:
    """Return two by two cells of a grid: of one layout's surface, or for None with the hinges of `grid_hinges`."""
    size = 7
    row, column = np.divmod(np.arange(size * size), size)
    positions = np.stack((column * spacing[0], row * spacing[1]), axis=1)
    if layout is None:
        hinges = grid_hinges(size, size)
    else:
        hinges = Surface.from_triangles(grid_triangles(size, size, layout)).hinges
    constants = grid_hinge_constants(hinges, columns=size, spacing=spacing, bending_modulus=1.0)
    midpoints = 0.5 * np.stack((column[hinges[:, :2]].sum(axis=1), row[hinges[:, :2]].sum(axis=1)), axis=1)
    inside = ((midpoints >= 1.75) & (midpoints < 3.75)).all(axis=1)
    return Patch(
        positions=positions,
        hinges=hinges[inside],
        constants=constants[inside],
        periodic_index=row % 2 * 2 + column % 2,
        area=4.0 * spacing[0] * spacing[1],
    )


@attrs.frozen(eq=False, kw_only=True)
class Triangulation:
    """One period of a flat random triangle mesh, with the eight copies around it."""

    #: Particles [m], (n, 2); those of the period itself come first.
    positions: Array
    #: Triangles, anticlockwise, (m, 3).
    triangles: NDArray[np.int64]
    #: Index of the particle within the period that each is a copy of, (n,).
    periodic_index: NDArray[np.int64]
    #: Width and height of the period [m], (2,).
    period: Array

    def in_period(self, edges: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return (m,) true for edges, given by their particles (m, 2), in the period; each edge counts exactly once."""
        midpoints = self.positions[edges].mean(axis=1) + 1e-6
        return np.asarray(((midpoints >= 0.0) & (midpoints < self.period)).all(axis=1))


def periodic_triangulation(jitter: float, *, size: int = 12, seed: int = 0, square: bool = False) -> Triangulation:
    """Return the Delaunay triangulation of `size` x `size` particles, each moved by up to `jitter` [m].

    The particles start at the corners of regular triangles of side 1 m, or of squares with `square`. A jitter of 1 or
    more leaves no trace of the regular lattice.
    """
    rng = np.random.default_rng(seed)
    row, column = np.divmod(np.arange(size * size), size)
    offset, height = (0.0, 1.0) if square else (0.5, np.sqrt(0.75))
    points = np.stack((column + offset * (row % 2), height * row), axis=1)
    points += jitter * rng.uniform(-1.0, 1.0, points.shape)
    period = np.array((size, height * size))
    shifts = np.array([(i, j) for i in (0, -1, 1) for j in (0, -1, 1)]) * period
    positions = (points[None] + shifts[:, None]).reshape(-1, 2)
    return Triangulation(
        positions=positions,
        triangles=delaunay_triangles(positions),
        periodic_index=np.tile(np.arange(size * size), len(shifts)),
        period=period,
    )


def delaunay_triangles(positions: Array) -> NDArray[np.int64]:
    """Return the triangles (m, 3) of the Delaunay triangulation of points (n, 2) [m], anticlockwise."""
    from scipy.spatial import Delaunay

    triangles = Delaunay(positions).simplices.astype(np.int64)
    corners = positions[triangles]
    signed_area = _cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    triangles[signed_area < 0] = triangles[signed_area < 0, ::-1]
    return np.asarray(triangles[np.abs(signed_area) > 1e-9])


def triangle_patch(jitter: float, *, size: int = 12, seed: int = 0) -> Patch:
    """Return the hinges of a `triangulation`."""
    mesh = periodic_triangulation(jitter, size=size, seed=seed)
    hinges = Surface.from_triangles(mesh.triangles, particle_count=len(mesh.positions)).hinges
    hinges = hinges[mesh.in_period(hinges[:, :2])]
    flat = np.concatenate((mesh.positions, np.zeros((len(mesh.positions), 1))), axis=1)
    return Patch(
        positions=mesh.positions,
        hinges=hinges,
        constants=mesh_hinge_constants(hinges, flat, bending_modulus=1.0),
        periodic_index=mesh.periodic_index,
        area=float(mesh.period.prod()),
    )


def _cross(a: Array, b: Array) -> Array:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
