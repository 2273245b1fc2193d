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
from cloth_sim_ros.scene.parameters.declare import ParameterError
from validation.command import at_least
from validation.report import Report, print_progress

#: Lengths of the edges of drapes [m].
EDGE_LENGTHS = (0.0075, 0.006, 0.005)
#: Cells in a bending length of cantilevers, and the largest relative error of the bending length.
CELLS, MAX_CANTILEVER_ERROR = 2, 0.03
_GRAVITY = 9.81


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--specimens", type=at_least(1), default=1, help="specimens of each drape")
    parser.add_argument("--fabrics", nargs="+", choices=list(fabrics()), default=list(fabrics()), help="fabrics")


def run(options: argparse.Namespace) -> Report:
    """Drape the fabrics and bend strips of them."""
    meshes = [(pattern, edge_length) for pattern in PATTERNS for edge_length in EDGE_LENGTHS]
    columns = [f"{pattern} {1e3 * edge_length:g} mm" for pattern, edge_length in meshes]
    report = Report("Fabrics of the package")
    drapes = report.add_table("Drape coefficient [%] by mesh", ["fabric", *columns, "nodes", "published"])
    strips = report.add_table("Bending length over that of the modulus", ["fabric", "warp", "weft"])
    for name in options.fabrics:
        sample = read_sample(name)
        lengths = []
        for angle, modulus in zip((0.0, 0.5 * math.pi), sample.warp_and_weft("material.bending_modulus"), strict=True):
            exact = (modulus / (sample.density * _GRAVITY)) ** (1.0 / 3.0)
            lengths.append(cantilever(sample, angle, cells=CELLS).bending_length / exact)
        strips.rows.append([name, *lengths])
        if max(abs(length - 1.0) for length in lengths) > MAX_CANTILEVER_ERROR:
            report.fail(f"{name}: bending lengths are {lengths[0]:.3f} and {lengths[1]:.3f} of the modulus's")
        coefficients, nodes, stated = [], [], sample.fabric.drape_coefficient
        for pattern, edge_length in meshes:
            test = DrapeTest(edge_length=edge_length, pattern=pattern)
            try:
                series = drape_series(sample, test, seeds=range(options.specimens), with_mesh_error=False)
            except ParameterError as error:
                report.fail(f"{name} on {pattern} triangles of {1e3 * edge_length:g} mm: {error}")
                coefficients.append(math.nan)
                continue
            coefficients.append(series.coefficient)
            nodes.append(series.nodes)
        published = "" if stated is None else f"{100.0 * stated[0]:g} to {100.0 * stated[1]:g}"
        mean_nodes = statistics.fmean(nodes) if nodes else math.nan
        drapes.rows.append([name, *(100.0 * value for value in coefficients), mean_nodes, published])
        print_progress(f"{name}: {', '.join(f'{100.0 * value:.1f}' for value in coefficients)} %, {published}")
        drapable = [value for value in coefficients if not math.isnan(value)]
        if stated is not None and drapable and not (stated[0] <= min(drapable) and max(drapable) <= stated[1]):
            reached = f"{100.0 * min(drapable):.1f} to {100.0 * max(drapable):.1f} %"
            report.fail(f"{name}: drape coefficients are {reached}, published {published} %")
    return report
