# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Comparison of clouds with further fields."""

from __future__ import annotations

import pytest

from cloth_sim_ros.physics.model.sheets.normals import vertex_normals
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.session.messages import CLOUD, CloudEncoder
from cloth_sim_ros.session.part import Message
from cloth_sim_ros.simulation.simulation import Simulation
from cloth_sim_ros.verify.outputs import CloudCheck
from cloth_sim_ros.verify.verdict import Findings, Verdict


@pytest.mark.parametrize(
    ("offset", "kind", "is_rounding"), [(12, "normals", True), (24, "layout of its points", False)]
)
def test_rounding_explains_normals_and_no_ids(offset: int, kind: str, is_rounding: bool) -> None:
    fields = {"points.normal": True, "points.id": True}
    simulation = Simulation(Scene.from_parameters({"cloth.resolution": [4, 5], **fields}))
    scene, x = simulation.scene, simulation.state.x
    encoder = CloudEncoder(frame_id=scene.frame_id, height=4, width=5, **scene.points.fields)
    data = bytearray(encoder.encode(x, 7, None, vertex_normals(x, scene.sheet.triangles())))
    data[encoder.points_offset + offset] ^= 1
    verdict = Verdict(name="session", other_arithmetic="1.0.0")
    message = Message("/cloth_sim/points", CLOUD, bytes(data), 7, 7, 0)
    assert CloudCheck(scene, Findings(verdict)).compare(message, simulation, 7)
    assert verdict.first_reason == f"its cloud, by the {kind}"
    assert bool(verdict.unexplained) == (not is_rounding)
