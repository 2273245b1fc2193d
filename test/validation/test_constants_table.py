# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Variation of tuned constants: half and double stay within the limits of each constant."""

from __future__ import annotations

import attrs
import pytest

from cloth_sim_ros.physics.control.constants import CONSTANTS, Constants
from validation.tolerance.constants import MAX_VALUES, scaled_constant


def test_limits_name_constants() -> None:
    assert MAX_VALUES.keys() < {field.name for field in attrs.fields(Constants)}


def test_double_constant_stays_within_its_limit() -> None:
    assert {name: scaled_constant(name, 2.0) for name in MAX_VALUES} == {
        name: min(2.0 * getattr(CONSTANTS, name), limit) for name, limit in MAX_VALUES.items()
    }
    assert scaled_constant("stability_safety", 2.0) == 1.0
    assert scaled_constant("max_interval", 2.0) == 2.0 * CONSTANTS.max_interval


def test_double_stiffening_doubles_its_excess() -> None:
    assert scaled_constant("energy_check_stiffening", 2.0) - 1.0 == pytest.approx(
        2.0 * (CONSTANTS.energy_check_stiffening - 1.0)
    )
