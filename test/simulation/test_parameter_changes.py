# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parameters that change while a cloth runs: the plan is reused, with the motion of a new plan."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cloth_sim_ros import Grasp, Scene, SetParameters, Simulation, State, Target
from cloth_sim_ros.physics.plan import assembly
from cloth_sim_ros.physics.state.controller_state import STEP_CONTROL_STATES, ErrorState

GRID: dict[str, Any] = {"cloth.resolution": [9, 8], "wind.velocity": [0.1, 0.0, 0.0]}
SCENES: dict[str, dict[str, Any]] = {
    "grid": GRID,
    "hinges": GRID | {"bending.model": "crossed", "material.bending_modulus": 1e-5},
    "panels": GRID | {"wind.normal_drag": 0.5, "wind.tangential_drag": 0.1},
    "implicit": GRID | {"integrator": "implicit", "wind.normal_drag": 0.5, "tolerance": 1e-2},
    "fixed step": GRID | {"step": 1e-3},
    "energy": GRID | {"diagnostics.energy": True, "wind.normal_drag": 0.5},
}
#: Small changes such as gusts, one per frame.
CHANGES: list[dict[str, Any]] = [
    {"wind.velocity": [1.0, 0.5, 0.0]},
    {"gravity": [0.0, 0.2, -9.7]},
    {"air.drag": 0.3},
    {"air.drag": 0.25, "wind.velocity": [2.0, 0.0, 0.0]},
    {"material.damping": 0.105},
    {"wind.velocity": [0.0, 0.0, 0.0]},
    {"gravity": [0.0, 0.0, 0.0]},
    {"material.stretch_modulus": 900.0, "gravity": [0.0, 0.0, -9.81]},
]
#: Changes that keep springs, hinges, panels and their order.
LIGHT = CHANGES[:4]


def controller_memory(simulation: Simulation) -> dict[str, list[float]]:
    """Return the controller state of step control."""
    memory = simulation.state.memory
    return {rule.key: memory[rule.key].tolist() for rule in STEP_CONTROL_STATES if rule.key in memory}


def started(values: dict[str, Any]) -> Simulation:
    simulation = Simulation(Scene.from_parameters(values))
    simulation.advance([Target("gripper", (0.5, 0.0, 0.5)), Grasp("gripper", True)])
    for _ in range(3):
        simulation.advance([Target("gripper", (0.45, -0.02, 0.5))])
    return simulation


@pytest.mark.parametrize("values", SCENES.values(), ids=SCENES)
def test_reused_plan_gives_the_motion_of_a_new_plan(values: dict[str, Any]) -> None:
    reusing = started(values)
    for change in CHANGES:
        # From state and scene alone, as a session is run again.
        fresh = Simulation(reusing.scene, State.from_bytes(reusing.state.to_bytes()))
        for simulation in (reusing, fresh):
            simulation.advance([SetParameters(change)])
        for _ in range(2):
            assert reusing.state.digest() == fresh.state.digest(), change
            reusing.advance()
            fresh.advance()


@pytest.mark.parametrize("values", SCENES.values(), ids=SCENES)
def test_uniform_force_change_rebuilds_no_spring_list(monkeypatch: pytest.MonkeyPatch, values: dict[str, Any]) -> None:
    simulation = started(values)
    plan = simulation.plan
    if values.get("integrator") != "implicit":
        # The matrix of implicit steps has its own plans.
        monkeypatch.setattr(assembly.Assembly, "upload", lambda *_: pytest.fail("a plan was built"))
    for change in LIGHT:
        simulation.spectral_bounds(simulation.scene.changed(change))
        simulation.advance([SetParameters(change)])
        assert simulation.plan is plan


def test_queried_change_is_built_once(monkeypatch: pytest.MonkeyPatch) -> None:
    simulation, built = started(SCENES["hinges"]), []
    whole = assembly.Assembly.upload
    monkeypatch.setattr(assembly.Assembly, "upload", lambda self, handle: (built.append(1), whole(self, handle))[1])
    simulation.spectral_bounds(simulation.scene.changed({"material.density": 0.3}))
    simulation.advance([SetParameters({"material.density": 0.3})])
    assert len(built) == 1


def test_storm_but_not_gust_triggers_a_new_error_estimate() -> None:
    simulation = started({"cloth.resolution": [9, 8]})
    for _ in range(40):
        simulation.advance()
    for change, is_estimated in (
        ({"wind.velocity": [1.0, 0.0, 0.0]}, False),
        ({"gravity": [0.0, 0.0, -9.0]}, False),
        ({"air.drag": 0.3}, False),
        ({"material.damping": 0.105}, False),
        ({"gripper.radius": 0.1}, False),
        ({"gravity": [0.0, 0.0, 90.0]}, True),
        ({"air.drag": 100.0}, True),
        ({"material.damping": 0.3}, True),
        ({"material.stretch_modulus": 1100.0}, True),
        ({"tolerance": 2e-4}, True),
    ):
        assert ErrorState.load(simulation.state).time_until_estimate > 0.0
        restore = simulation.state.shallow_copy()
        # private: between two frames
        simulation._set_parameters(change)
        assert (ErrorState.load(simulation.state).time_until_estimate == 0.0) is is_estimated, change
        simulation.state.restore(restore)


def test_failed_change_keeps_the_plan(monkeypatch: pytest.MonkeyPatch) -> None:
    tried, reference = started(SCENES["panels"]), started(SCENES["panels"])

    def fails(*_: object, **__: object) -> None:
        raise MemoryError

    for change in ({"gravity": [0.0, 0.0, 5.0]}, {"air.drag": 3.0}, {"wind.velocity": [5.0, 0.0, 0.0]}):
        with monkeypatch.context() as patch:
            patch.setattr(type(tried.plan), "runs", fails)
            with pytest.raises(MemoryError):
                tried.advance([SetParameters(change)])
        tried.advance()
        reference.advance()
        assert tried.state.digest() == reference.state.digest(), change


@pytest.mark.parametrize("tolerance", [1e-3, 1e-4, 1e-5])
def test_gusts_leave_the_motion_within_its_tolerance(tolerance: float) -> None:
    values = {"cloth.resolution": [16, 16], "air.drag": 1.0, "wind.velocity": [0.1, 0.0, 0.0], "material.damping": 0.3}

    def flown(held: float) -> np.ndarray:
        simulation = Simulation(Scene.from_parameters(values | {"tolerance": held}))
        gusts = np.random.default_rng(3)
        places = []
        for frame in range(20):
            gust = [SetParameters({"wind.velocity": gusts.uniform(-2.0, 2.0, 3).tolist()})] if frame % 4 == 0 else []
            simulation.advance(gust)
            places.append(simulation.positions)
        return np.array(places)

    positions, exact = flown(tolerance), flown(1e-9)
    assert np.linalg.norm(positions - exact, axis=2).max() < tolerance
