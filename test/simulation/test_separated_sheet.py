# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A sheet that stays away from itself moves and costs as it does without `contact.self`."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from cloth_sim_ros import Grasp, Scene, Simulation, State, Target
from cloth_sim_ros.simulation.events import Event

FRAMES = 40


def carried_sheet(self_contact: bool) -> tuple[Simulation, Iterator[list[Event]]]:
    """A sheet carried by a corner, and the events of its frames."""
    scene = Scene.from_parameters({"contact.self": self_contact, "cloth.resolution": [16, 16]})
    x = scene.initial_positions()
    corner = x[np.argmax(x[:, 0] - x[:, 2])]
    positions = [corner + 0.08 * np.array([np.sin(0.1 * k), 1.0 - np.cos(0.1 * k), 0.03 * k]) for k in range(FRAMES)]
    targets: list[list[Event]] = [[Target("gripper", tuple(position))] for position in positions]
    targets[0].append(Grasp("gripper", True))
    return Simulation(scene), iter(targets)


def spinning_sheet(self_contact: bool) -> tuple[Simulation, Iterator[list[Event]]]:
    """A free sheet that spins at 3.2 rad/s, and no events."""
    scene = Scene.from_parameters({"contact.self": self_contact, "cloth.resolution": [16, 16], "cloth.anchors": []})
    x = scene.initial_positions()
    v = np.cross([0.5, 3.0, 1.0], x - x.mean(axis=0))
    return Simulation(scene, State(x, v)), iter([[] for _ in range(FRAMES)])


@pytest.mark.parametrize("sheet", [carried_sheet, spinning_sheet])
def test_separated_sheet_moves_as_without_self_contact(sheet) -> None:
    results = []
    for self_contact in (False, True):
        simulation, events = sheet(self_contact)
        advances = [simulation.advance(frame_events).advance for frame_events in events]
        evaluations = sum(advance.evaluations for advance in advances if advance is not None)
        results.append((simulation.state.x.tobytes(), simulation.state.v.tobytes(), evaluations))
    assert results[0] == results[1]
    assert results[0][2] > FRAMES


def test_contact_of_the_last_query_is_looked_at_anew() -> None:
    scene = Scene.from_parameters({"contact.self": True, "cloth.resolution": [16, 16], "cloth.anchors": []})
    simulation = Simulation(scene)
    contact, flat, v = simulation.plan.contact, simulation.state.x, np.zeros_like(simulation.state.v)
    assert contact is not None
    # The upper half lies on the lower one, at 0.6 thicknesses along the normal, which is y.
    height = flat[2] - flat[2].mean()
    folded = np.array([flat[0], flat[1] + np.where(height > 0.0, 0.6 * scene.contact.thickness, 0.0), -np.abs(height)])
    for _ in range(2):
        assert contact.predict_surface_contact(0.0, 0.0, folded, v, {})[0] > 0.0
        assert not contact.is_clear_of_itself(1.0 / 60.0, folded, v)
        assert contact.is_clear_of_itself(1.0 / 60.0, flat, v)
