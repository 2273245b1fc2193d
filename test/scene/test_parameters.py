# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Conversion of Python and numpy values of parameters."""

from __future__ import annotations

import numpy as np
import pytest

from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.scene import Scene


def test_numpy_scalars_become_python_numbers() -> None:
    values = {
        "rate": np.float64(50.0),
        "tolerance": np.float32(0.5),
        "points.velocity": np.bool_(True),
        "frame_id": np.str_("table"),
        "work_limit": np.array(2.0),
        "cloth.resolution": np.array([3, 4]),
    }
    checked = Scene.from_parameters(values).parameters()
    assert {name: checked[name] for name in values} == {
        "rate": 50.0,
        "tolerance": 0.5,
        "points.velocity": True,
        "frame_id": "table",
        "work_limit": 2.0,
        "cloth.resolution": (3, 4),
    }
    assert all(type(checked[name]) in (float, bool, str, tuple) for name in values)
    with pytest.raises(ParameterError, match="rate is the whole number 60; it is a double"):
        Scene.from_parameters({"rate": np.int64(60)})


def test_numpy_integer_is_accepted_as_integer() -> None:
    entry = next(entry for entry in Scene.declared() if entry.kind == "int")
    assert type(entry.check(np.int64(entry.default))) is int
