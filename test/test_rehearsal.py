# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""After a rehearsal nothing is left to compile, whatever a gripper does then."""

from __future__ import annotations

import numpy as np
import pytest

from cloth_sim_ros.events import Event, Grasp, Target
from cloth_sim_ros.physics.integrators.base import StepLimitError
from cloth_sim_ros.physics.kernels import grid_leapfrog
from cloth_sim_ros.physics.kernels.prepared import Prepared
from cloth_sim_ros.rehearsal import rehearse
from cloth_sim_ros.scene import Scene
from cloth_sim_ros.simulation import Simulation


def live(scene: Scene) -> None:
    """A corner is gripped, carried far, turned from amid that on, and let go."""
    simulation = Simulation(scene)
    corner = simulation.positions[-1].astype(float)
    for k in range(170):
        events: list[Event] = []
        if k == 20:
            events = [Target("gripper", tuple(corner)), Grasp("gripper", True)]
        elif 20 < k < 140:
            angle = 0.01 * (k - 20)
            turned = (0.0, 0.0, float(np.sin(angle)), float(np.cos(angle))) if k > 80 else None
            place = corner + np.array([0.0, 0.004, 0.002]) * (k - 20)
            events = [Target("gripper", tuple(place), turned)]
        elif k == 140:
            events = [Grasp("gripper", False)]
        simulation.advance(events)


@pytest.mark.parametrize("tolerance", [1e-3, 1e-4])
def test_live_frames_use_what_was_rehearsed(monkeypatch: pytest.MonkeyPatch, tolerance: float) -> None:
    prepared = Prepared(grid_leapfrog.advance_sheet)
    monkeypatch.setattr(grid_leapfrog, "_ADVANCE", prepared)
    scene = Scene.from_parameters({"tolerance": tolerance})
    rehearse(scene)
    rehearsed = len(prepared.entries)
    assert rehearsed >= 3
    live(scene)
    assert len(prepared.entries) == rehearsed


def test_a_fixed_step_above_the_limit_is_told() -> None:
    with pytest.raises(StepLimitError, match="above the stability limit"):
        rehearse(Scene.from_parameters({"integrator": "leapfrog", "step": 0.01}))
