# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fit of the quantity that six fabrics have in common to their drapes."""

from __future__ import annotations

import statistics

import pytest

from validation.reality.drapes import Common, with_friction, with_scaled_moduli

VALUES = [10.0, 20.0, 40.0]
#: Slope and intercept of each fabric's drape coefficient over the common quantity.
LINES = {"a": (0.01, 0.1), "b": (0.004, 0.3), "c": (0.02, 0.0), "d": (0.007, 0.2)}


def line(fabric: str, value: float) -> float:
    slope, intercept = LINES[fabric]
    return slope * value + intercept


def test_common_quantity_is_found_by_every_split() -> None:
    common = Common("ratio", VALUES, with_friction)
    curves = {fabric: [line(fabric, value) for value in VALUES] for fabric in LINES}
    splits = common.split_errors(curves, {fabric: line(fabric, 25.0) for fabric in LINES})
    assert len(splits) == 6
    for known, value, errors in splits:
        assert len(known) == len(errors) == 2
        assert value == pytest.approx(25.0, abs=0.01)
        assert errors == pytest.approx([0.0, 0.0], abs=1e-3)


def test_factors_are_interpolated_in_their_logarithm() -> None:
    common = Common("factor", [1.0, 4.0], with_scaled_moduli, is_logarithmic=True)
    assert common.fitted({"a": [0.2, 0.4]}, {"a": 0.3}) == pytest.approx(2.0, rel=1e-3)


def test_friction_moment_is_in_proportion_to_mean_modulus() -> None:
    sample = with_friction("denim", 50.0)
    mean = statistics.fmean(sample.warp_and_weft("material.bending_modulus"))
    assert sample.parameters["bending.friction_moment"] == pytest.approx(50.0 * mean)
    assert with_friction("denim", 0.0).parameters["bending.friction_moment"] == 0.0
