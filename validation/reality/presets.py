# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The package's fabrics: drape coefficients over meshes against published ones, and cantilevers on coarse grids."""

from __future__ import annotations

import argparse
import math
import statistics

from cloth_sim_ros.laboratory.cantilever import cantilever
from cloth_sim_ros.laboratory.drape import DrapeTest
from cloth_sim_ros.laboratory.drape_series import drape_series
from cloth_sim_ros.laboratory.samples import read_sample
from cloth_sim_ros.laboratory.specimens import PATTERNS
from cloth_sim_ros.scene.fabrics import fabrics
from validation.report import Report, Table, print_progress

#: Lengths of the edges of drapes [m].
SIDES = (0.0075, 0.006, 0.005)
#: Cells in a bending length of cantilevers, and the largest relative error of the bending length.
CELLS, MAX_CANTILEVER_ERROR = 2, 0.03
_GRAVITY = 9.81


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--specimens", type=int, default=1, help="specimens of each drape (default: %(default)s)")
    parser.add_argument("--sides", type=float, nargs="+", default=SIDES, help="lengths of the meshes' edges [m]")
    names = "fabrics (default: all)"
    parser.add_argument("--fabrics", nargs="+", choices=list(fabrics()), default=list(fabrics()), help=names)


def run(options: argparse.Namespace) -> Report:
    """Drape the fabrics and bend strips of them."""
    if options.specimens < 1:
        raise ValueError("--specimens must be at least 1")
    meshes = [(pattern, side) for pattern in PATTERNS for side in options.sides]
    columns = [f"{pattern} {1e3 * side:g} mm" for pattern, side in meshes]
    drapes = Table("Drape coefficient [%] by mesh", ["fabric", *columns, "nodes", "published"])
    strips = Table("Bending length over that of the modulus", ["fabric", "warp", "weft"])
    failures = []
    for name in options.fabrics:
        sample = read_sample(name)
        lengths = []
        for angle, modulus in zip((0.0, 0.5 * math.pi), sample.pair("material.bending_modulus"), strict=True):
            exact = (modulus / (sample.density * _GRAVITY)) ** (1.0 / 3.0)
            lengths.append(cantilever(sample, angle, cells=CELLS).bending_length / exact)
        strips.rows.append([name, *lengths])
        if max(abs(length - 1.0) for length in lengths) > MAX_CANTILEVER_ERROR:
            failures.append(f"{name}: bending lengths are {lengths[0]:.3f} and {lengths[1]:.3f} of the modulus's")
        series = [
            drape_series(
                sample,
                DrapeTest(side=side, pattern=pattern),
                seeds=range(options.specimens),
                with_mesh_error=False,
            )
            for pattern, side in meshes
        ]
        found, stated = [draped.coefficient for draped in series], sample.fabric.drape_coefficient
        nodes = statistics.fmean(draped.nodes for draped in series)
        published = "" if stated is None else f"{100.0 * stated[0]:g} to {100.0 * stated[1]:g}"
        drapes.rows.append([name, *(100.0 * value for value in found), nodes, published])
        print_progress(f"{name}: {', '.join(f'{100.0 * value:.1f}' for value in found)} %, {published}")
        if stated is not None and not (stated[0] <= min(found) and max(found) <= stated[1]):
            failures.append(
                f"{name}: drape coefficients are {100.0 * min(found):.1f} to {100.0 * max(found):.1f} %, published "
                f"{published} %"
            )
    return Report("Fabrics of the package", "python -m validation presets", tables=[drapes, strips], failures=failures)
