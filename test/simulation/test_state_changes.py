# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Written states can be read and continue to the same bits, after any history."""

from __future__ import annotations

from itertools import product

import pytest

from cloth_sim_ros import Scene, Simulation, State
from cloth_sim_ros.physics.control.automatic import INTEGRATORS

SETTINGS = [
    {"integrator": name, "tolerance": tolerance, "step": step}
    for name, (tolerance, step) in product(INTEGRATORS, [(0.0, 0.0), (1e-3, 0.0), (1e-5, 0.0), (0.0, 5e-4)])
]


@pytest.mark.parametrize("first", SETTINGS, ids=lambda values: "-".join(map(str, values.values())))
def test_a_state_written_after_any_change_is_read_and_goes_on(first):
    base = {"cloth.resolution": [5, 6], "cloth.anchors": ["top_left"]}
    for second in SETTINGS[::3]:
        simulation = Simulation(Scene.from_parameters({**base, **first}))
        for _ in range(2):
            simulation.advance()
        scene = Scene.from_parameters({**base, **second})
        changed = Simulation(scene, simulation.state)
        for _ in range(3):
            changed.advance()
        again = Simulation(scene, State.from_bytes(changed.state.to_bytes()))
        for _ in range(2):
            changed.advance()
            again.advance()
        assert again.state.digest() == changed.state.digest()
