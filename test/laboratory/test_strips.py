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
from cloth_sim_ros.laboratory.samples import Sample, read_sample
from cloth_sim_ros.laboratory.strips import Measurement, describe


@pytest.fixture(scope="module")
def sample() -> Sample:
    """Return a fabric whose warp and weft differ."""
    return read_sample("cotton_twill")


def test_cantilever_has_the_bending_length_of_the_modulus(sample: Sample) -> None:
    # Peirce's rule for 41.5 degrees is itself within 0.5 % of the heavy elastica.
    for found in measure_cantilever(sample, cells=3):
        limit = 0.015 if found.quantity == "bending length" else 0.04
        assert found.ratio == pytest.approx(1.0, abs=limit), found


def test_cantilever_error_falls_with_the_cells(sample: Sample) -> None:
    exact = (sample.pair("material.bending_modulus")[0] / (sample.density * 9.81)) ** (1.0 / 3.0)
    coarse, fine = (cantilever(sample, 0.0, cells=cells).bending_length / exact - 1.0 for cells in (2, 4))
    assert 0.0 < fine < 0.5 * coarse < 0.015


def test_cantilever_of_a_limp_fabric_is_refused() -> None:
    with pytest.raises(LaboratoryError, match="bending_modulus"):
        cantilever(read_sample("denim", {"material.bending_modulus": 1e-14, "material.bending_modulus_weft": 0.0}), 0.0)


def test_bending_moment_is_modulus_times_curvature(sample: Sample) -> None:
    warp, weft = sample.pair("material.bending_modulus")
    assert bending_moment(sample, 0.0, 100.0, cells=6) == pytest.approx(100.0 * warp, rel=0.01)
    assert bending_moment(sample, 0.5 * math.pi, 100.0, cells=6) == pytest.approx(100.0 * weft, rel=0.01)
    assert [found.ratio for found in measure_bending(sample) if found.ratio] == pytest.approx([1.0, 1.0], abs=0.01)


def test_tension_has_the_moduli_of_warp_and_weft(sample: Sample) -> None:
    ratios = [found.ratio for found in measure_tension(sample) if found.ratio]
    assert ratios == pytest.approx([1.0, 1.0], abs=0.005)


def test_shear_modulus_is_lowered_by_free_sides(sample: Sample) -> None:
    (ratio,) = [found.ratio for found in measure_shear(sample) if found.ratio]
    assert ratio is not None
    assert 0.85 < ratio < 1.0


def test_bias_extension_shears() -> None:
    # Threads that hardly stretch leave the kinematics of shear.
    stiff = {"material.stretch_modulus": 1e6, "material.stretch_modulus_weft": 0.0}
    laminate, kinematic, *_ = measure_bias_extension(read_sample("cotton_twill", stiff), cells=8)
    assert kinematic.ratio == pytest.approx(1.0, abs=0.35)
    assert laminate.ratio is not None
    assert laminate.ratio > 1.0


def test_table_has_measured_and_stated_value() -> None:
    text = describe("Title", [Measurement(quantity="length", direction="warp", unit="m", measured=2.0, stated=4.0)])
    assert text.splitlines()[0] == "Title"
    assert "0.500" in text
