# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Strips between clamps against closed forms of the moduli."""

from __future__ import annotations

import math

import pytest

from cloth_sim_ros.laboratory.cantilever import cantilever, measure_cantilever
from cloth_sim_ros.laboratory.equilibrium import LaboratoryError
from cloth_sim_ros.laboratory.plane_tests import measure_bias_extension, measure_shear, measure_tension
from cloth_sim_ros.laboratory.pure_bending import bending_moment, measure_bending
from cloth_sim_ros.laboratory.samples import FabricSample, read_sample
from cloth_sim_ros.laboratory.strips import Measurement, describe


@pytest.fixture(scope="module")
def sample() -> FabricSample:
    """Return a fabric whose warp and weft differ."""
    return read_sample("cotton_twill")


def test_cantilever_has_the_bending_length_of_the_modulus(sample: FabricSample) -> None:
    # Peirce's rule for 41.5 degrees is itself within 0.5 % of the heavy elastica.
    for measurement in measure_cantilever(sample, cells=3):
        limit = 0.015 if measurement.quantity == "bending length" else 0.04
        assert measurement.ratio == pytest.approx(1.0, abs=limit), measurement


def test_cantilever_of_a_shape_operator_has_the_bending_length() -> None:
    sample = read_sample("cotton_twill", {"bending.model": "shape_operator"})
    lengths = [entry.ratio for entry in measure_cantilever(sample, cells=3) if entry.quantity == "bending length"]
    assert lengths == pytest.approx([1.0, 1.0], abs=0.01)


def test_cantilever_error_falls_with_the_cells(sample: FabricSample) -> None:
    exact = (sample.warp_and_weft("material.bending_modulus")[0] / (sample.density * 9.81)) ** (1.0 / 3.0)
    coarse, fine = (cantilever(sample, 0.0, cells=cells).bending_length / exact - 1.0 for cells in (2, 4))
    assert 0.0 < fine < 0.5 * coarse < 0.015


def test_cantilever_of_a_limp_fabric_is_refused() -> None:
    with pytest.raises(LaboratoryError, match="bending_modulus"):
        cantilever(read_sample("denim", {"material.bending_modulus": 1e-14, "material.bending_modulus_weft": 0.0}), 0.0)


def test_bending_moment_is_modulus_times_curvature(sample: FabricSample) -> None:
    warp, weft = sample.warp_and_weft("material.bending_modulus")
    assert bending_moment(sample, 0.0, 100.0, cells=6) == pytest.approx(100.0 * warp, rel=0.01)
    assert bending_moment(sample, 0.5 * math.pi, 100.0, cells=6) == pytest.approx(100.0 * weft, rel=0.01)
    assert [measurement.ratio for measurement in measure_bending(sample) if measurement.ratio] == pytest.approx(
        [1.0, 1.0], abs=0.01
    )


def test_tension_has_the_moduli_of_warp_and_weft(sample: FabricSample) -> None:
    ratios = [measurement.ratio for measurement in measure_tension(sample) if measurement.ratio]
    assert ratios == pytest.approx([1.0, 1.0], abs=0.005)


def test_shear_modulus_is_lowered_by_free_sides(sample: FabricSample) -> None:
    (ratio,) = [measurement.ratio for measurement in measure_shear(sample) if measurement.ratio]
    assert ratio is not None
    assert 0.85 < ratio < 1.0


def test_bias_extension_shears() -> None:
    # Clamps stiffen the strip. The second value assumes threads far stiffer than shear; here they are ten times.
    laminate, kinematic, *_ = measure_bias_extension(read_sample("cotton_twill"))
    assert laminate.ratio is not None
    assert kinematic.ratio is not None
    assert 1.0 < laminate.ratio < 1.05
    assert kinematic.ratio < 0.6


def test_bias_extension_of_stiff_threads_is_shear() -> None:
    _, kinematic, *_ = measure_bias_extension(read_sample("polyester_tablecloth"))
    assert kinematic.ratio == pytest.approx(1.0, abs=0.06)


def test_bias_modulus_of_springs_has_their_poisson_ratio() -> None:
    values = {"membrane.model": "springs", "material.stretch_modulus": 200.0, "material.stretch_modulus_weft": 200.0}
    fabric = read_sample("denim", {**values, "material.shear_modulus": 40.0, "material.poisson_ratio": 0.9})
    laminate = measure_bias_extension(fabric, cells=4)[0].stated
    assert laminate == pytest.approx(4.0 / (2.0 / 200.0 - 2.0 * 0.1926 / 200.0 + 1.0 / 40.0), rel=1e-3)


def test_table_has_measured_and_stated_value() -> None:
    text = describe("Title", [Measurement(quantity="length", direction="warp", unit="m", measured=2.0, stated=4.0)])
    assert text.splitlines()[0] == "Title"
    assert "0.500" in text


def test_loop_of_bending_is_twice_the_friction_moment_wide() -> None:
    fabric = read_sample("cotton_twill", {"bending.friction_moment": 1e-4, "bending.yield_curvature": 20.0})
    widths = [measurement for measurement in measure_bending(fabric) if measurement.quantity.startswith("width 2HB")]
    assert [measurement.direction for measurement in widths] == ["warp", "weft"]
    assert [measurement.stated for measurement in widths] == [2e-4, 2e-4]
    assert [measurement.ratio for measurement in widths] == pytest.approx([1.0, 1.0], abs=0.01)
