# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Drapes of six woven fabrics against their real drape coefficients.

The bending moduli of all fabrics are multiplied by one factor, because their conversion from raw measurements is
uncertain. The factor is fitted to three fabrics by least squares and applied to the other three, in each of the 20
splits.
"""

from __future__ import annotations

import argparse
import itertools
import math
import statistics
import time

import numpy as np

from cloth_sim_ros.laboratory.drape import EDGE_LENGTH, DrapeTest
from cloth_sim_ros.laboratory.drape_series import DrapeSeries, drape_series
from cloth_sim_ros.laboratory.samples import read_sample
from validation.command import above, at_least
from validation.report import Report, print_progress

#: The package's fabrics with measured moduli and a measured drape coefficient.
FABRICS = ("polyester_twill", "polyester_plain", "wool_twill", "viscose_twill", "stretch_plain", "cotton_twill")
#: Factors on the bending moduli at which fabrics are draped; coefficients between them are interpolated.
FACTORS = (0.5, 1.0, 1.5, 2.25, 3.4)
#: Requirements: mean and largest error of the other fabrics, error of the mesh, and processor time of a drape [s].
MAX_MEAN_ERROR, MAX_ERROR, MAX_MESH_ERROR, MAX_TIME = 0.03, 0.06, 0.01, 10.0
_MODULUS = "material.bending_modulus"


def scaled_drapes(fabric: str, factor: float, test: DrapeTest, specimens: int, *, with_mesh_error: bool) -> DrapeSeries:
    """Return drapes of a fabric whose bending moduli are multiplied by a factor."""
    warp, weft = read_sample(fabric).warp_and_weft(_MODULUS)
    sample = read_sample(fabric, {_MODULUS: factor * warp, f"{_MODULUS}_weft": factor * weft})
    return drape_series(sample, test, seeds=range(specimens), with_mesh_error=with_mesh_error)


def fitted_factor(factors: list[float], curves: dict[str, list[float]], real: dict[str, float]) -> float:
    """Return the factor with the smallest sum of squared errors.

    Args:
        factors: factors of the curves, ascending.
        curves: coefficients at these factors by fabric.
        real: coefficients of the real fabrics that count.
    """
    fine = np.linspace(math.log(factors[0]), math.log(factors[-1]), 2001)
    errors = [np.interp(fine, np.log(factors), curves[fabric]) - coefficient for fabric, coefficient in real.items()]
    return math.exp(float(fine[np.argmin(np.sum(np.square(errors), axis=0))]))


def split_errors(
    factors: list[float], curves: dict[str, list[float]], real: dict[str, float]
) -> list[tuple[tuple[str, ...], float, list[float]]]:
    """Return fabrics of the fit, factor and errors of the other fabrics, of every split in halves."""
    splits = []
    for known in itertools.combinations(real, len(real) // 2):
        factor = fitted_factor(factors, curves, {fabric: real[fabric] for fabric in known})
        blind = [fabric for fabric in real if fabric not in known]
        coefficients = [float(np.interp(math.log(factor), np.log(factors), curves[fabric])) for fabric in blind]
        splits.append(
            (known, factor, [value - real[fabric] for value, fabric in zip(coefficients, blind, strict=True)])
        )
    return splits


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--specimens", type=at_least(1), default=2, help="specimens of each drape")
    parser.add_argument("--edge-length", type=float, default=EDGE_LENGTH, help="length of the mesh's edges [m]")
    parser.add_argument("--factors", type=above(0.0), nargs="+", default=FACTORS, help="factors on the bending moduli")


def run(options: argparse.Namespace) -> Report:
    """Drape all fabrics at all factors."""
    if len(options.factors) < 2:
        raise ValueError("--factors takes at least two")
    report = Report("Six woven fabrics")
    test, factors = DrapeTest(edge_length=options.edge_length), sorted(options.factors)
    real, curves, nodes, times = {}, {}, {}, []
    for fabric in FABRICS:
        stated = read_sample(fabric).fabric.drape_coefficient
        assert stated is not None
        real[fabric] = statistics.fmean(stated)
        series = []
        for factor in factors:
            begin = time.process_time()
            series.append(scaled_drapes(fabric, factor, test, options.specimens, with_mesh_error=False))
            times.append((time.process_time() - begin) / options.specimens)
            last = series[-1]
            print_progress(
                f"{fabric} x {factor:g}: {100 * last.coefficient:.1f} % {last.nodes:g} nodes {times[-1]:.1f} s"
            )
        curves[fabric], nodes[fabric] = [s.coefficient for s in series], [s.nodes for s in series]
    best = fitted_factor(factors, curves, real)
    columns = [*(f"x {factor:g}" for factor in factors), f"x {best:.2f}", "real", "nodes", "error of the mesh"]
    table = report.add_table("Drape coefficient [%] by factor on bending", ["fabric", *columns])
    for fabric in FABRICS:
        series_at_best = scaled_drapes(fabric, best, test, options.specimens, with_mesh_error=True)
        error, coefficient = series_at_best.mesh_error or 0.0, series_at_best.coefficient
        row = [*curves[fabric], coefficient, real[fabric]]
        table.rows.append([fabric, *(100.0 * value for value in row), series_at_best.nodes, 100.0 * error])
        print_progress(f"{fabric} x {best:.2f}: {100 * coefficient:.1f} %, error of the mesh {100 * error:+.1f}")
        failure = f"{fabric}: the mesh is in error by {100.0 * error:+.1f} points"
        report.require(abs(error) <= MAX_MESH_ERROR, failure)
    columns = ["fitted on", "factor", "mean", "largest"]
    splits = report.add_table("Errors of three fabrics [points], the factor from the others", columns)
    for known, factor, errors in split_errors(factors, curves, real):
        sizes = [100.0 * abs(error) for error in errors]
        splits.rows.append([" ".join(known), factor, statistics.fmean(sizes), max(sizes)])
    means, largest = [row[2] for row in splits.rows], [row[3] for row in splits.rows]
    if max(means) > 100.0 * MAX_MEAN_ERROR or max(largest) > 100.0 * MAX_ERROR:
        report.fail(
            f"blind drapes are off by {statistics.fmean(means):.1f} points in the mean of all splits, {max(means):.1f} "
            f"in that of the worst, and {max(largest):.1f} at most"
        )
    report.require(max(times) <= MAX_TIME, f"the slowest drape took {max(times):.1f} s of processor time")
    note = f"edges of {1e3 * options.edge_length:g} mm, {options.specimens} specimens; slowest drape {max(times):.1f} s"
    report.note(note)
    return report
