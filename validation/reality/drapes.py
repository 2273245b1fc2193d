# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Drapes of six woven fabrics against their real drape coefficients.

The bending moduli of all fabrics are multiplied by one factor, because their conversion from raw measurements is
uncertain. The factor is fitted to three fabrics by least squares and applied to the other three, in each of the 20
splits. With `--friction-ratios` the moduli are those of the publication. Friction moments of bending then have one
ratio to the mean modulus of warp and weft. The splits fit this ratio.
"""

from __future__ import annotations

import argparse
import itertools
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import attrs
import numpy as np

from cloth_sim_ros.laboratory.drape import EDGE_LENGTH, DrapeTest
from cloth_sim_ros.laboratory.drape_series import drape_series
from cloth_sim_ros.laboratory.samples import FabricSample, read_sample
from cloth_sim_ros.physics.model.forces.force import Array
from validation.command import above, at_least
from validation.report import Report, Table, print_progress

#: The package's fabrics with measured moduli and a measured drape coefficient.
FABRICS = ("polyester_twill", "polyester_plain", "wool_twill", "viscose_twill", "stretch_plain", "cotton_twill")
#: Factors on the bending moduli at which fabrics are draped; coefficients between them are interpolated.
FACTORS = (0.5, 1.0, 1.5, 2.25, 3.4)
#: Requirements: mean and largest error of the other fabrics, error of the mesh, and processor time of a drape [s].
MAX_MEAN_ERROR, MAX_ERROR, MAX_MESH_ERROR, MAX_TIME = 0.03, 0.06, 0.01, 10.0
#: Change of curvature up to which friction of bending is elastic [1/m]: well below those of a drape.
_YIELD_CURVATURE = 20.0
_MODULUS = "material.bending_modulus"


@attrs.frozen
class Common:
    """Quantity that all fabrics have in common and that is fitted: its name, values and scale of interpolation."""

    name: str
    #: Values at which fabrics are draped, ascending.
    values: list[float]
    #: Builds a fabric with a value.
    sample: Callable[[str, float], FabricSample]
    #: True to interpolate in the logarithm of the value.
    is_logarithmic: bool = False

    def coefficient(self, curve: Sequence[float], value: float | Array) -> Array:
        """Return drape coefficients at values, from those at `values`."""
        return np.asarray(np.interp(self._scaled(value), self._scaled(self.values), curve))

    def fitted(self, curves: Mapping[str, Sequence[float]], real: Mapping[str, float]) -> float:
        """Return the value with the smallest sum of squared errors.

        Args:
            curves: coefficients at `values` by fabric.
            real: coefficients of the real fabrics that count.
        """
        space = np.geomspace if self.is_logarithmic else np.linspace
        fine = space(self.values[0], self.values[-1], 2001)
        errors = [self.coefficient(curves[fabric], fine) - coefficient for fabric, coefficient in real.items()]
        return float(fine[np.argmin(np.sum(np.square(errors), axis=0))])

    def split_errors(
        self, curves: Mapping[str, Sequence[float]], real: Mapping[str, float]
    ) -> list[tuple[tuple[str, ...], float, list[float]]]:
        """Return fabrics of the fit, fitted value and errors of the other fabrics, of every split in halves."""
        splits = []
        for known in itertools.combinations(real, len(real) // 2):
            value = self.fitted(curves, {fabric: real[fabric] for fabric in known})
            blind = [fabric for fabric in real if fabric not in known]
            errors = [float(self.coefficient(curves[fabric], value)) - real[fabric] for fabric in blind]
            splits.append((known, value, errors))
        return splits

    def _scaled(self, value: Any) -> Array:
        return np.log(value) if self.is_logarithmic else np.asarray(value, dtype=float)


def with_scaled_moduli(fabric: str, factor: float) -> FabricSample:
    """Return a fabric whose bending moduli are multiplied by a factor."""
    warp, weft = read_sample(fabric).warp_and_weft(_MODULUS)
    return read_sample(fabric, {_MODULUS: factor * warp, f"{_MODULUS}_weft": factor * weft})


def with_friction(fabric: str, ratio: float) -> FabricSample:
    """Return a fabric with a friction moment that is `ratio` [1/m] times the mean bending modulus."""
    moment = ratio * statistics.fmean(read_sample(fabric).warp_and_weft(_MODULUS))
    friction = {"bending.friction_moment": moment, "bending.yield_curvature": _YIELD_CURVATURE}
    return read_sample(fabric, friction if moment else {})


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--specimens", type=at_least(1), default=2, help="specimens of each drape")
    parser.add_argument("--edge-length", type=float, default=EDGE_LENGTH, help="length of the mesh's edges [m]")
    common = parser.add_mutually_exclusive_group()
    common.add_argument("--factors", type=above(0.0), nargs="+", default=FACTORS, help="factors on the bending moduli")
    ratios = "friction moments of bending over the mean bending modulus [1/m], beside 0, instead of factors"
    common.add_argument("--friction-ratios", type=above(0.0), nargs="+", metavar="RATIO", help=ratios)


def run(options: argparse.Namespace) -> Report:
    """Drape all fabrics at all values of the common quantity."""
    if options.friction_ratios is None:
        common = Common("factor", sorted(set(options.factors)), with_scaled_moduli, is_logarithmic=True)
    else:
        common = Common("ratio", sorted({0.0, *options.friction_ratios}), with_friction)
    if len(common.values) < 2:
        raise ValueError("--factors takes at least two different numbers")
    test, failures = DrapeTest(edge_length=options.edge_length), list[str]()
    real, curves, times = {}, {}, []
    for fabric in FABRICS:
        stated = read_sample(fabric).fabric.drape_coefficient
        assert stated is not None
        real[fabric] = statistics.fmean(stated)
        series = []
        for value in common.values:
            begin = time.process_time()
            sample, seeds = common.sample(fabric, value), range(options.specimens)
            series.append(drape_series(sample, test, seeds=seeds, with_mesh_error=False))
            times.append((time.process_time() - begin) / options.specimens)
            last = series[-1]
            print_progress(
                f"{fabric}, {common.name} {value:g}: {100 * last.coefficient:.1f} %, {last.nodes:g} nodes, "
                f"{times[-1]:.1f} s"
            )
        curves[fabric] = [s.coefficient for s in series]
    best = common.fitted(curves, real)
    subject = "factor on bending" if common.is_logarithmic else "ratio of friction moment and bending modulus [1/m]"
    table = Table(f"Drape coefficient [%] by {subject}", ["fabric", *(f"{value:g}" for value in common.values)])
    table.columns += [f"{best:.3g}", "real", f"{common.name} that fits", "nodes"]
    # A coarser mesh of a fabric with friction would begin without the plastic lengths of the finer one.
    has_mesh_error = options.friction_ratios is None
    if has_mesh_error:
        table.columns.append("error of the mesh")
    for fabric in FABRICS:
        sample, seeds = common.sample(fabric, best), range(options.specimens)
        at_best = drape_series(sample, test, seeds=seeds, with_mesh_error=has_mesh_error)
        row = [*curves[fabric], at_best.coefficient, real[fabric]]
        single_fit = common.fitted(curves, {fabric: real[fabric]})
        table.rows.append([fabric, *(100.0 * value for value in row), single_fit, at_best.nodes])
        text = f"{fabric}, {common.name} {best:.3g}: {100 * at_best.coefficient:.1f} %"
        if has_mesh_error:
            error = at_best.mesh_error or 0.0
            table.rows[-1].append(100.0 * error)
            text += f", error of the mesh {100 * error:+.1f}"
            if abs(error) > MAX_MESH_ERROR:
                failures.append(f"{fabric}: the mesh is in error by {100.0 * error:+.1f} points")
        print_progress(text)
    splits = Table(
        f"Errors of three fabrics [points], the {common.name} from the others",
        ["fitted on", common.name, "mean", "largest"],
    )
    for known, value, errors in common.split_errors(curves, real):
        sizes = [100.0 * abs(error) for error in errors]
        splits.rows.append([" ".join(known), value, statistics.fmean(sizes), max(sizes)])
    means, largest = [row[2] for row in splits.rows], [row[3] for row in splits.rows]
    if max(means) > 100.0 * MAX_MEAN_ERROR or max(largest) > 100.0 * MAX_ERROR:
        failures.append(
            f"blind drapes are off by {statistics.fmean(means):.1f} points in the mean of all splits, {max(means):.1f} "
            f"in that of the worst, and {max(largest):.1f} at most"
        )
    if max(times) > MAX_TIME:
        failures.append(f"the slowest drape took {max(times):.1f} s of processor time")
    note = f"edges of {1e3 * options.edge_length:g} mm, {options.specimens} specimens; slowest drape {max(times):.1f} s"
    return Report("Six woven fabrics", tables=[table, splits], notes=[note], failures=failures)
