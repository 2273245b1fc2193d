# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fast path: it gives the bits, decisions and counts of the full advance."""

from __future__ import annotations

from typing import Any

import pytest

from cloth_sim_ros.physics.control import fast_path
from cloth_sim_ros.physics.integrators.base import Advance
from cloth_sim_ros.physics.integrators.extrapolation_tableau import PrecomputedRun
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Grasp, Pause, SetParameters, Step, Target
from cloth_sim_ros.simulation.simulation import Simulation

#: A cloth that lies on a table.
_TABLE: dict[str, Any] = {
    "cloth.size": [0.3, 0.3],
    "cloth.position": [0.0, 0.0, 0.003],
    "cloth.orientation": [0.0, 0.0, 0.0, 1.0],
    "cloth.anchors": [""],
    "contact.thickness": 0.003,
    "obstacles": ["it"],
    "it.shape": "plane",
}
_SCENES: dict[str, dict[str, Any]] = {
    "tolerance 1 mm": {},
    "tolerance 0.1 mm": {"tolerance": 1e-4},
    "leapfrog": {"integrator": "leapfrog"},
    "energy is watched": {"diagnostics.energy": True},
    "single precision": {"tolerance": 5e-3, "material.damping": 0.3},
    "little work": {"work_limit": 0.02},
    "fixed step": {"step": 5e-4},
    "hinges": {"bending.model": "altitude", "material.bending_modulus": 1e-5, "cloth.resolution": (14, 14)},
    "a ball out of reach": {
        "obstacles": ["it"],
        "it.shape": "sphere",
        "it.size": [0.1],
        "it.position": [3.0, 0.0, 0.0],
    },
    "on a table": _TABLE,
    "falls on a table": {**_TABLE, "cloth.position": [0.0, 0.0, 0.15]},
    "is thrown on a table": {**_TABLE, "cloth.position": [0.0, 0.0, 0.4], "gravity": [0.0, 0.0, -60.0]},
    "on a table with friction": {**_TABLE, "it.friction": [0.5, 0.4]},
    "layers that rub": {**_TABLE, "contact.self": True, "contact.friction": [0.4, 0.3]},
    "two pads": {"gripper.mode": "pinch", "gripper.opening": 0.03, "contact.thickness": 0.003},
}


def _summaries(values: dict[str, Any], frames: int) -> list[Any]:
    """Return digest, advance, wrenches and energy of each frame while a gripper carries a corner."""
    simulation = Simulation(Scene.from_parameters({"cloth.resolution": (12, 12), "gripper.radius": 0.1, **values}))
    x, y, z = simulation.positions[-1].tolist()
    summaries = []
    for k in range(frames):
        events: list[Any] = [Target("gripper", (x - 0.004 * k, y + 0.002 * k, z + 0.003 * k))] if k < 60 else []
        if k == 0:
            events.append(Grasp("gripper", True))
        if k == 70:
            events.append(SetParameters({"air.drag": 0.6}))
        if k in (80, 82):
            events.append(Pause(k == 80))
        if k == 81:
            events.append(Step())
        frame = simulation.advance(events)
        summaries.append((simulation.state.digest(), frame.advance, frame.wrenches.tolist(), simulation.energy_report))
    return summaries


@pytest.mark.parametrize("name", _SCENES)
def test_fast_path_equals_full_advance(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    fast = _summaries(_SCENES[name], 120)
    monkeypatch.setattr(fast_path, "try_advance", lambda *_: None)
    assert _summaries(_SCENES[name], 120) == fast


def test_fast_path_serves_most_frames_and_passes_on_its_run(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    attempt, results = fast_path.try_advance, []

    def watched(*arguments: Any) -> Any:
        results.append(attempt(*arguments))
        return results[-1]

    monkeypatch.setattr(fast_path, "try_advance", watched)
    _summaries({}, 120)
    assert sum(isinstance(result, Advance) for result in results) > 60
    assert any(isinstance(result, PrecomputedRun) for result in results)
