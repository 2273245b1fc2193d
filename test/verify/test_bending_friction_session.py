# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sessions with friction of bending rerun to the same bits."""

from __future__ import annotations

from pathlib import Path

from support.session_maker import SessionMaker

from cloth_sim_ros.physics.state.controller_state import PLASTIC_LENGTHS_KEY
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.verify.run import verify


def test_session_with_bending_friction_reruns_to_same_bits(tmp_path: Path) -> None:
    values = {
        "cloth.resolution": [6, 7],
        "cloth.orientation": [0.61, 0.07, -0.13, 0.77],
        "cloth.anchors": ["top_left"],
        "grippers": [""],
        "tolerance": 1e-3,
        "bending.model": "quadratic",
        "material.bending_modulus": 1e-4,
        "bending.friction_moment": 1e-5,
        "bending.yield_curvature": 0.05,
    }
    maker = SessionMaker(tmp_path, Scene.from_parameters(values))
    for _ in range(20):
        maker.add([])
    maker.finish()
    assert maker.simulation.state.memory[PLASTIC_LENGTHS_KEY].any()
    verdict = verify(sorted(tmp_path.glob("*.mcap")))
    assert verdict.same, verdict.first_reason
    assert verdict.frames == 20
