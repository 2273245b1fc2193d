# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`simulate`: arguments, refusals, and motions without a force that bounds the step."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cloth_sim_ros import Drag, Force, Gravity, Model, PairSprings, Scene, Simulation, State, simulate
from cloth_sim_ros.physics.integrators.base import UnstableError
from cloth_sim_ros.scene.scene import Scene as NodeScene


def pair(k_s: float = 10.0) -> Model:
    return Model([1.0, 1.0], [PairSprings([[0, 1]], 1.0, k_s, 0.0)])


def apart() -> State:
    return State([[0.0, 0.0, 0.0], [1.1, 0.0, 0.0]])


@pytest.mark.parametrize(
    ("until", "options", "words"),
    [
        (0.5, {"save_at": []}, "save_at is []"),
        (0.5, {"save_at": "abc"}, "save_at is 'abc'"),
        (0.5, {"save_at": [0.2, 0.1]}, "ascend"),
        (0.5, {"save_at": [0.6]}, "from 0 to until, 0.5 s"),
        (0.5, {"save_at": [np.nan]}, "finite"),
        (0.5, {"integrator": "auto"}, "integrator is 'auto'"),
        (None, {}, "until is nan"),
        (-1.0, {}, "until is -1.0 s; it must be above 0"),
        (10**400, {}, "until is 1000"),
    ],
)
def test_invalid_arguments_are_refused(until: Any, options: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words.replace("[", r"\[").replace("]", r"\]")):
        simulate(pair(), apart(), until, **options)


def test_state_refuses_a_negative_frame() -> None:
    with pytest.raises(ValueError, match="frame is -5"):
        State([[0.0, 0.0, 0.0]], frame=-5)


def test_unstable_motion_reports_its_bounds() -> None:
    with pytest.raises(UnstableError, match="no step is short enough: the highest frequency"):
        simulate(pair(1e160), apart(), 0.1)
    with pytest.raises(UnstableError, match="reduce stiffness, damping or drag"):
        simulate(Model([1.0], [Drag(1e300)]), State([[0.0, 0.0, 0.0]]), 0.1)


@pytest.mark.parametrize(("forces", "drop_height"), [([], 0.0), ([Gravity()], 0.5 * 9.81 * 0.05**2)])
def test_single_particle_moves_without_a_step_limit(forces: list[Force], drop_height: float) -> None:
    # Within the default tolerance in this number of frames, and far below it.
    motion = simulate(Model([1.0], forces), State([[0.0, 0.0, 0.0]]), 0.05)
    np.testing.assert_allclose(motion.positions[-1], [[0.0, 0.0, -drop_height]], rtol=0, atol=1e-6)


def test_fully_anchored_cloth_stays() -> None:
    held = ["top", "bottom", *map(str, range(4, 12))]
    values = {"cloth.size": [0.3, 0.3], "cloth.resolution": [4, 4], "cloth.anchors": held}
    simulation = Simulation(Scene.from_parameters(values))
    before = simulation.positions
    for _ in range(3):
        simulation.advance()
    assert np.array_equal(simulation.positions, before)


def test_library_and_node_have_the_same_tolerance() -> None:
    motions = []
    for options in ({}, {"tolerance": NodeScene().tolerance}):
        motion = simulate(pair(), apart(), 0.5, **options)
        motions.append(motion.positions)
    assert np.array_equal(*motions)
