# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Internal friction of bending in motion: residual curvature, sleep, snapshots, changes of parameters."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.bounded_loops import rounds_until

from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.state.controller_state import PLASTIC_LENGTHS_KEY
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Grasp, SetParameters, Target
from cloth_sim_ros.simulation.simulation import Simulation

CELL = 2e-3
#: Bending modulus [N m], friction moment [N] and yield curvature [1/m].
MODULUS, MOMENT, YIELD = 1e-5, 1e-4, 5.0
#: A strip of 4 by 20 mm along x, whose first two columns are held, in viscous air without gravity.
STRIP = {
    "cloth.resolution": [3, 11],
    "cloth.size": [2 * CELL, 10 * CELL],
    "cloth.orientation": [0.0, 0.0, 0.0, 1.0],
    "cloth.position": [0.0, 0.0, 0.0],
    "cloth.anchors": ["0", "1", "11", "12", "22", "23"],
    "gravity": [0.0, 0.0, 0.0],
    "grippers": [""],
    "air.drag": 1000.0,
    "wind.normal_drag": 0.0,
    "tolerance": 1e-3,
    "bending.model": "quadratic",
    "material.bending_modulus": MODULUS,
    "bending.friction_moment": MOMENT,
    "bending.yield_curvature": YIELD,
}
#: A small sheet that a gripper swings.
SWUNG = {
    "cloth.resolution": [6, 7],
    "cloth.orientation": [0.61, 0.07, -0.13, 0.77],
    "tolerance": 1e-3,
    "rate": 30.0,
    "air.drag": 3.0,
    "material.stretch_modulus": 200.0,
    "bending.model": "crossed",
    "material.bending_modulus": 1e-4,
    "bending.friction_moment": 1e-3,
    "bending.yield_curvature": 0.05,
}
MESH = b"v 0 0 0\nv 0.1 0 0\nv 0.2 0 0\nv 0 0.1 0\nv 0.1 0.1 0\nv 0.2 0.1 0\nf 1 2 5\nf 1 5 4\nf 2 3 6\nf 2 6 5\n"


def moved(simulation: Simulation, frames: int, first: int = 0) -> list[str]:
    """Digests of frames in which the gripper swings the last corner."""
    digests = []
    for k in range(first, first + frames):
        x, y, z = (-0.5 + 0.1 * (k % 3), 0.02 * k, 1.0)
        events = [Grasp("gripper", True)] if k == 1 else []
        simulation.advance([Target("gripper", (x, y, z)), *events])
        digests.append(simulation.state.digest())
    return digests


def curvature_of(strip: Scene, positions: Array) -> float:
    """Return the mean curvature of the strip's free part [1/m]."""
    middle = positions.reshape(3, 11, 3)[1]
    sides = np.diff(middle, axis=0)
    angles = np.arctan2(sides[:, 2], sides[:, 0])
    return float((angles[-1] - angles[0]) / (9 * CELL))


def bent(strip: Scene, curvature: float) -> Array:
    """Return particles on a polygon whose sides turn by curvature times cell, (n, 3)."""
    points = strip.initial_positions()
    column = np.rint((points[:, 0] - points[:, 0].min()) / CELL).astype(int)
    turns = curvature * CELL * np.arange(10)
    points[:, 0] = points[0, 0] + np.concatenate([[0.0], np.cumsum(CELL * np.cos(turns))])[column]
    points[:, 2] = np.concatenate([[0.0], np.cumsum(CELL * np.sin(turns))])[column]
    return points


def released(strip: Scene, *curvatures: float) -> Simulation:
    """Return a strip that was bent to one curvature after the other, and released at the last one."""
    plan, memory = strip.plan(), dict[str, Array]()
    for curvature in curvatures:
        if plan.plastic is not None:
            x = np.ascontiguousarray(bent(strip, curvature).T)
            memory = {PLASTIC_LENGTHS_KEY: plan.plastic.return_mapping(x, memory)[0]}
    state = State(bent(strip, curvatures[-1]), memory=memory, cloth=strip.starting_state().cloth)
    return Simulation(strip, state)


@pytest.mark.parametrize("curvatures", [(12.0, 5.0), (40.0,)], ids=["elastic return", "yielding return"])
def test_released_strip_keeps_residual_curvature(curvatures: tuple[float, ...]) -> None:
    strip = Scene.from_parameters(STRIP)
    simulation = released(strip, *curvatures)
    for _ in range(150):
        simulation.advance([])
    # Elastic return to zero moment, which stops where the modulus pulls no more than friction.
    friction_modulus = MOMENT / YIELD
    elastic = friction_modulus * (curvatures[0] - YIELD) / (MODULUS + friction_modulus)
    residual = min(elastic, MOMENT / MODULUS)
    assert curvature_of(strip, simulation.positions) == pytest.approx(residual, rel=0.01)


def test_released_strip_without_friction_becomes_flat() -> None:
    strip = Scene.from_parameters({**STRIP, "bending.friction_moment": 0.0})
    simulation = released(strip, 40.0)
    for _ in range(150):
        simulation.advance([])
    assert abs(curvature_of(strip, simulation.positions)) < 0.01


def test_curled_strip_sleeps_until_an_event() -> None:
    strip = Scene.from_parameters(STRIP)
    simulation = released(strip, 40.0)
    for _ in range(200):
        simulation.advance([])
    for _ in rounds_until(lambda: simulation.asleep, 200):
        simulation.advance([])
    lengths, positions = simulation.state.memory[PLASTIC_LENGTHS_KEY].copy(), simulation.positions
    for _ in range(100):
        frame = simulation.advance([])
        assert frame.advance is not None
        assert frame.advance.steps == 0
    assert np.array_equal(simulation.state.memory[PLASTIC_LENGTHS_KEY], lengths)
    simulation.advance([SetParameters({"bending.friction_moment": 0.0})])
    assert not simulation.asleep
    for _ in range(30):
        simulation.advance([])
    assert np.abs(simulation.positions - positions).max() > 0.5 * CELL


def test_snapshot_and_state_file_continue_with_the_same_bits() -> None:
    scene = Scene.from_parameters(SWUNG)
    simulation = Simulation(scene)
    moved(simulation, 12)
    snapshot, data = simulation.snapshot(), simulation.state.to_bytes()
    assert simulation.state.memory[PLASTIC_LENGTHS_KEY].any()
    digests = moved(simulation, 8, first=12)
    simulation.restore(snapshot)
    assert moved(simulation, 8, first=12) == digests
    read = Simulation(scene, State.from_bytes(data))
    assert np.array_equal(read.state.memory[PLASTIC_LENGTHS_KEY], State.from_bytes(data).memory[PLASTIC_LENGTHS_KEY])
    moved(read, 8, first=12)
    assert np.abs(read.positions - simulation.positions).max() < 1e-3


def test_frames_are_the_same_on_one_and_two_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    from cloth_sim_ros.physics.plan import plan

    digests = []
    for threads in (1, 2):
        monkeypatch.setattr(plan, "available_threads", lambda threads=threads: threads)
        digests.append(moved(Simulation(Scene.from_parameters({**SWUNG, "cloth.resolution": [24, 24]})), 6))
    assert digests[0] == digests[1]


def test_friction_can_be_switched_while_the_cloth_runs() -> None:
    simulation = Simulation(Scene.from_parameters({**SWUNG, "bending.friction_moment": 0.0}))
    simulation.advance([])
    assert PLASTIC_LENGTHS_KEY not in simulation.state.memory
    simulation.advance([SetParameters({"bending.friction_moment": 1e-3})])
    assert PLASTIC_LENGTHS_KEY in simulation.state.memory
    simulation.advance([SetParameters({"bending.friction_moment": 0.0})])
    assert PLASTIC_LENGTHS_KEY not in simulation.state.memory


@pytest.mark.parametrize("model", ["none", "axial", "opposite"])
def test_friction_needs_hinges_with_a_modulus(model: str) -> None:
    with pytest.raises(ParameterError, match=r"bending\.friction_moment is 0\.001 N, and bending\.model"):
        Scene.from_parameters({"bending.model": model, "bending.friction_moment": 1e-3})


def test_friction_of_nearly_shut_hinges_is_refused() -> None:
    values = {**SWUNG, "bending.rest_angle": 3.1}
    with pytest.raises(ParameterError, match=r"bending\.friction_moment is 0\.001 N: hinge 0 rests at a fold"):
        Scene.from_parameters(values)


@pytest.mark.parametrize("model", ["crossed", "altitude", "quadratic"])
def test_mesh_yields_at_the_friction_moment_per_edge(model: str) -> None:
    values: dict[str, Any] = {**SWUNG, "cloth.mesh": "strip.obj", "bending.model": model, "grippers": [""]}
    plan = Scene.from_parameters({**values, "cloth.anchors": [""]}, files={"strip.obj": MESH}).plan()
    (force,) = [force for force in plan.model.forces if force.name == "bending_friction"]
    (across,) = [k for k, hinge in enumerate(force.hinges.tolist()) if sorted(hinge[:2]) == [1, 4]]
    # A wing folded by a small angle beyond the yield angle.
    angle = 0.02
    x = np.array([[float(c) for c in line.split()[1:]] for line in MESH.decode().splitlines() if line[0] == "v"]).T
    x[2, [2, 5]], x[0, [2, 5]] = 0.1 * np.sin(angle), 0.1 + 0.1 * np.cos(angle)
    slope = (force.stiffness[across] * force.reach[across]) * _length_slope(force.hinges[across], x)
    assert slope == pytest.approx(1e-3 * 0.1, rel=0.01)


def _length_slope(hinge: Array, x: Array) -> float:
    """Return dh/dθ [m] of a hinge as its second side folds about the edge, by differences."""
    from cloth_sim_ros.physics.model.forces.hinge_springs import signed_lengths

    lengths = []
    fold = np.arctan2(x[2, 2], x[0, 2] - 0.1)
    for change in (1e-5, -1e-5):
        y = np.ascontiguousarray(x)
        y[2, [2, 5]], y[0, [2, 5]] = 0.1 * np.sin(fold + change), 0.1 + 0.1 * np.cos(fold + change)
        lengths.append(signed_lengths(hinge[None], y, kind="crossed")[0])
    return abs(float(lengths[0] - lengths[1]) / 2e-5)
