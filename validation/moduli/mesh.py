# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Distribution of the moduli of sheets over random irregular meshes.

Linear theory of a periodic patch: a spring has stiffness k, length L and direction d. Under the strain ε it stretches
by e = L d'εd + d'(u_b - u_a), u being any periodic displacement. The minimum of the energy ½ Σ k e² per area is
½ ε'Cε. C is the sheet's modulus tensor on lengths far above its triangles. With u = 0 every particle moves with the
strain and the energy is larger. The report contains that upper bound as the affine mean.
"""

from __future__ import annotations

import argparse

import attrs
import numpy as np

from cloth_sim_ros.physics.model.sheets.mesh import POISSON_RATIO, SHEAR_OVER_STRETCH, MeshSheet
from cloth_sim_ros.physics.model.sheets.surface import Surface
from validation.bending.patterns import Triangulation, periodic_triangulation
from validation.command import at_least
from validation.report import Report, Table

#: Meshes: (square lattice, largest displacement of a vertex in sides); 1 leaves no trace of the lattice.
MESHES = (*((False, jitter) for jitter in (0.1, 0.2, 0.3, 0.4)), (True, 0.1), (True, 0.2), (True, 0.3), (False, 1.0))
#: Attributes of `Moduli` by the name of their row; a row pools its attributes.
_QUANTITIES = {"Young's": ("along_x", "along_y"), "shear": ("shear",), "Poisson's": ("poisson",)}


@attrs.frozen(kw_only=True)
class Moduli:
    """Moduli of a sheet, divided by the nominal ones."""

    #: Young's modulus along x.
    along_x: float
    #: Young's modulus along y.
    along_y: float
    #: Shear modulus, over 3/8 of the nominal Young's modulus.
    shear: float
    #: Poisson's ratio along x, over 1/3.
    poisson: float


def measure_moduli(mesh: Triangulation, *, relaxed: bool = True) -> Moduli:
    """Return the moduli of the package's edge springs on a mesh.

    Without `relaxed` every particle moves with the strain, which is stiffer than the sheet.
    """
    flat = np.concatenate((mesh.positions, np.zeros((len(mesh.positions), 1))), axis=1)
    sheet = MeshSheet(rest_positions=flat, surface=Surface.from_triangles(mesh.triangles, particle_count=len(flat)))
    springs = sheet.springs(stretch_modulus=1.0, k_d0=0.0, density=1.0)
    in_period = mesh.in_period(springs.pairs)
    pairs = springs.pairs[in_period]
    root_stiffness = np.sqrt(springs.stiffness[in_period] / springs.rest_length[in_period])[:, None]
    separations = mesh.positions[pairs[:, 1]] - mesh.positions[pairs[:, 0]]
    x, y = (separations / springs.rest_length[in_period, None]).T
    # Stretch of each spring under the unit strains xx, yy and (engineering) xy.
    strain_stretches = springs.rest_length[in_period, None] * np.stack((x * x, y * y, x * y), axis=1)
    relaxed_stretches = root_stiffness * strain_stretches
    if relaxed:
        n_particles = int(mesh.periodic_index.max()) + 1
        displacement_stretches = np.zeros((len(pairs), 2 * n_particles))
        periodic_ends, spring = mesh.periodic_index[pairs], np.arange(len(pairs))
        for end_index, sign in ((1, 1.0), (0, -1.0)):
            np.add.at(displacement_stretches, (spring, 2 * periodic_ends[:, end_index]), sign * x)
            np.add.at(displacement_stretches, (spring, 2 * periodic_ends[:, end_index] + 1), sign * y)
        # Particle 0 is fixed: a uniform displacement stretches no spring.
        weighted_stretches = (root_stiffness * displacement_stretches)[:, 2:]
        relaxed_stretches = relaxed_stretches - weighted_stretches @ np.linalg.solve(
            weighted_stretches.T @ weighted_stretches, weighted_stretches.T @ relaxed_stretches
        )
    compliance = np.linalg.inv(relaxed_stretches.T @ relaxed_stretches / float(mesh.period.prod()))
    return Moduli(
        along_x=float(1.0 / compliance[0, 0]),
        along_y=float(1.0 / compliance[1, 1]),
        shear=float(1.0 / compliance[2, 2] / SHEAR_OVER_STRETCH),
        poisson=float(-compliance[0, 1] / compliance[0, 0] / POISSON_RATIO),
    )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--patterns", type=at_least(2), default=100, help="random meshes a row")
    parser.add_argument("--size", type=int, default=12, help="vertices a side of the period")


def run(options: argparse.Namespace) -> Report:
    """Measure the moduli of each kind of mesh."""
    columns = ["vertices of", "moved by", "modulus", "mean", "standard deviation", "5 %", "95 %", "affine mean"]
    table = Table(f"Moduli over those asked for, {options.patterns} random Delaunay meshes a row", columns)
    for square, jitter in MESHES:
        seeds = range(options.patterns)
        meshes = [periodic_triangulation(jitter, size=options.size, seed=seed, square=square) for seed in seeds]
        relaxed_moduli = [measure_moduli(mesh, relaxed=True) for mesh in meshes]
        affine = [measure_moduli(mesh, relaxed=False) for mesh in meshes]
        for name, quantities in _QUANTITIES.items():
            values, affine_values = (
                np.array([getattr(mesh_moduli, quantity) for mesh_moduli in moduli for quantity in quantities])
                for moduli in (relaxed_moduli, affine)
            )
            percentiles = [float(q) for q in np.quantile(values, (0.05, 0.95))]
            row = ["squares" if square else "triangles", f"{jitter:g} side", name, float(values.mean())]
            table.rows.append([*row, float(values.std(ddof=1)), *percentiles, float(affine_values.mean())])
    note = f"{options.size**2} vertices a mesh, periodic; Young's modulus along x and along y both count"
    return Report("Moduli of irregular meshes", tables=[table], notes=[note])
