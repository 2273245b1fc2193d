# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Strips cut at angles to the warp against laminate theory, and affine patches.

A strip has a uniform traction at its ends and is free to shear. Its modulus at the angle θ to the warp is this one
(Jones, Mechanics of Composite Materials, 1999, equation 2.97).

    1/E(θ) = cos⁴θ / E1 + (1/G - 2 ν/E1) cos²θ sin²θ + sin⁴θ / E2.

In a patch with affine motion of its border, every particle moves affinely.
"""

from __future__ import annotations

import argparse
import math

import attrs
import numpy as np
from numpy.typing import NDArray
from support.garment import as_obj

from cloth_sim_ros import MembraneTriangles, Model, Plan, Scene, compile
from cloth_sim_ros.physics.model.forces.force import Array
from validation.bending.patterns import delaunay_triangles
from validation.command import at_least
from validation.equilibrium import find_equilibrium
from validation.report import Report

ANGLES = tuple(range(0, 91, 15))
MESHES = ("grid", "equilateral", "irregular")
#: Length and width of a strip [m].
LENGTH, WIDTH = 1.0, 0.1
#: A woven fabric: moduli along warp and weft, shear [N/m], Poisson's ratio.
WARP, WEFT, SHEAR, POISSON = 4.0e3, 1.5e3, 120.0, 0.25
#: Largest error of a strip's modulus, and of a particle of a patch over the size of the patch.
MAX_STRIP_ERROR, MAX_PATCH_ERROR = 0.01, 1e-10
_STRAIN = 1e-4
#: Largest remaining force [N].
_ACCURACY = 1e-9


@attrs.frozen(eq=False, kw_only=True)
class FlatSheet:
    """Membrane of a flat sheet alone, and its border."""

    plan: Plan
    force: MembraneTriangles
    #: Rest positions [m], (n, 2).
    positions: Array

    def solve(self, x: Array, load: Array, fixed: NDArray[np.bool_]) -> Array:
        """Return the positions of equilibrium (n, 2) under a load [N], (n, 2).

        Args:
            x: start.
            load: force on each particle.
            fixed: coordinates that keep their start, (n, 2).
        """
        plane = ((0, 0), (0, 1))
        free, lifted = np.pad(~fixed, plane), np.pad(x, plane)
        return find_equilibrium(self.plan, lifted, free, accuracy=_ACCURACY, load=np.pad(load, plane))[:, :2]


def flat_sheet(mesh: str, angle: float, *, cells: int = 6, length: float = LENGTH, seed: int = 0) -> FlatSheet:
    """Return a strip along y of a width of `cells` cells, whose warp is `angle` [degrees] from its length.

    Args:
        mesh: grid, equilateral or irregular.
        angle: angle between length and warp.
        cells: number of cells across.
        length: length [m].
        seed: seed of an irregular mesh.
    """
    values = {
        "membrane.model": "triangles",
        "bending.model": "none",
        "material.stretch_modulus": WARP,
        "material.stretch_modulus_weft": WEFT,
        "material.shear_modulus": SHEAR,
        "material.poisson_ratio": POISSON,
        "material.warp_direction": [-math.sin(math.radians(angle)), math.cos(math.radians(angle)), 0.0],
        "cloth.anchors": [""],
    }
    files = {}
    if mesh == "grid":
        rows = round(length / WIDTH * cells) + 1
        values |= {"cloth.size": [length, WIDTH], "cloth.resolution": [rows, cells + 1]}
    else:
        values["cloth.mesh"] = "strip.obj"
        files["strip.obj"] = _mesh_file(mesh, cells, length, seed)
    scene = Scene.from_parameters(values, files=files)
    force = scene.model().force("membrane")
    assert isinstance(force, MembraneTriangles)
    positions = scene.sheet.positions()[:, :2]
    return FlatSheet(plan=compile(Model(scene.sheet.masses(1.0), [force])), force=force, positions=positions)


def strip_modulus(sheet: FlatSheet) -> float:
    """Return Young's modulus of a strip along y [N/m]: traction at its ends over the strain between them."""
    x, y = sheet.positions.T
    top, bottom = np.isclose(y, y.max()), np.isclose(y, y.min())
    load = np.zeros_like(sheet.positions)
    traction = _STRAIN * WARP
    for end, sign in ((top, 1.0), (bottom, -1.0)):
        nodes = np.flatnonzero(end)
        nodes = nodes[np.argsort(x[nodes])]
        half = 0.5 * np.diff(x[nodes])
        load[nodes[:-1], 1] += sign * traction * half
        load[nodes[1:], 1] += sign * traction * half
    fixed = np.zeros(load.shape, dtype=bool)
    corners = np.flatnonzero(bottom)
    left, right = corners[np.argmin(x[corners])], corners[np.argmax(x[corners])]
    fixed[left], fixed[right, 1] = True, True
    moved = sheet.solve(sheet.positions, load, fixed)
    # The load is in equilibrium, so that the fixed coordinates bear nothing, and the motion is affine.
    ones = np.ones(len(x))
    gradient = np.linalg.lstsq(np.stack((x, y, ones), axis=1), moved - sheet.positions, rcond=None)[0]
    return float(traction / gradient[1, 1])


def laminate_modulus(angle: float) -> float:
    """Return E(θ) [N/m] at an angle [degrees]."""
    c, s = math.cos(math.radians(angle)) ** 2, math.sin(math.radians(angle)) ** 2
    return 1.0 / (c * c / WARP + (1.0 / SHEAR - 2.0 * POISSON / WARP) * c * s + s * s / WEFT)


def patch_error(sheet: FlatSheet) -> float:
    """Return the largest distance of a particle from an affine motion of the border, over the size of the patch."""
    x, y = sheet.positions.T
    affine = sheet.positions @ np.array([[1.05, 0.08], [0.03, 1.1]])
    border = np.isclose(x, x.min()) | np.isclose(x, x.max()) | np.isclose(y, y.min()) | np.isclose(y, y.max())
    spacing = math.sqrt(2.0 * float(sheet.force.areas.mean()))
    start = affine + 0.1 * spacing * np.random.default_rng(3).uniform(-1.0, 1.0, affine.shape) * ~border[:, None]
    solved = sheet.solve(start, np.zeros_like(start), np.repeat(border[:, None], 2, axis=1))
    return float(np.abs(solved - affine).max() / np.ptp(affine, axis=0).max())


def _mesh_file(mesh: str, cells: int, length: float, seed: int) -> bytes:
    """Return an OBJ file of a strip in the x-y plane."""
    points = _equilateral_points(cells, length) if mesh == "equilateral" else _irregular_points(cells, length, seed)
    return as_obj(np.column_stack([points, np.zeros(len(points))]), delaunay_triangles(points))


def _equilateral_points(cells: int, length: float) -> Array:
    """Rows of points half a side apart, of triangles that are equilateral but for the rounding to the length."""
    spacing = WIDTH / cells
    rows = round(length / (spacing * math.sqrt(0.75)))
    points = []
    for row in range(rows + 1):
        inner = np.arange(cells + 1) * spacing if row % 2 == 0 else (np.arange(cells) + 0.5) * spacing
        across = inner if row % 2 == 0 else np.concatenate(([0.0], inner, [WIDTH]))
        points += [(float(x), row * length / rows) for x in across]
    return np.array(points)


def _irregular_points(cells: int, length: float, seed: int) -> Array:
    """Points of a grid of cells that are moved by up to a third of a side, those of the border along it."""
    spacing = WIDTH / cells
    rows = round(length / spacing)
    x, y = (
        axis.ravel() for axis in np.meshgrid(np.linspace(0.0, WIDTH, cells + 1), np.linspace(0.0, length, rows + 1))
    )
    moves = spacing / 3.0 * np.random.default_rng(seed).uniform(-1.0, 1.0, (2, len(x)))
    on_side = (x == 0.0) | (x == WIDTH)
    on_end = (y == 0.0) | (y == length)
    return np.stack((x + moves[0] * ~on_side, y + moves[1] * ~on_end), axis=1)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--cells", type=at_least(2), default=6, help="cells across a strip")


def run(options: argparse.Namespace) -> Report:
    """Measure strips and patches."""
    report = Report("Moduli of woven strips")
    title = "Relative error of the modulus of strips of 10:1 by laminate theory"
    strips = report.add_table(title, ["angle [degrees]", *MESHES])
    for angle in ANGLES:
        ratios = [
            strip_modulus(flat_sheet(mesh, angle, cells=options.cells)) / laminate_modulus(angle) for mesh in MESHES
        ]
        strips.rows.append([angle, *(ratio - 1.0 for ratio in ratios)])
        for mesh, ratio in zip(MESHES, ratios, strict=True):
            failure = f"strip at {angle} degrees of the {mesh} mesh: {ratio:.4f} of laminate theory"
            report.require(abs(ratio - 1.0) <= MAX_STRIP_ERROR, failure)
    patches = report.add_table(
        "Largest deviation from an affine motion over the size of the patch", ["mesh", "deviation"]
    )
    for mesh in MESHES:
        error = patch_error(flat_sheet(mesh, 30.0, cells=options.cells, length=2.0 * WIDTH))
        patches.rows.append([mesh, error])
        report.require(error <= MAX_PATCH_ERROR, f"patch of the {mesh} mesh deviates by {error:.2g}")
    report.note(f"warp {WARP:g}, weft {WEFT:g}, shear {SHEAR:g} N/m, Poisson's ratio {POISSON:g}; strain {_STRAIN:g}")
    return report
