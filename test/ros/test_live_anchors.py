# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Anchors that change while the cloth runs: events, refusals with reasons, and bit-exact replay."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from rclpy.parameter import Parameter
from support.bounded_loops import rounds_until
from support.clocked_cloth import ClockedCloth
from support.ros_client import Client

from cloth_sim_ros import Grasp, Reset, Scene, SetParameters, Simulation, State, Target
from cloth_sim_ros.simulation.event_checks import EventError

GRID = {"cloth.resolution": [6, 7]}
TOP, BOTTOM = range(7), range(35, 42)


@pytest.fixture
def client(ros_domain: int) -> Iterator[Client]:
    with Client() as client:
        yield client


def swinging(frames: int = 20) -> Simulation:
    simulation = Simulation(Scene.from_parameters(GRID | {"wind.velocity": [0.0, 5.0, 0.0]}))
    for _ in range(frames):
        simulation.advance()
    return simulation


def anchored(*names: str) -> SetParameters:
    return SetParameters({"cloth.anchors": list(names) or [""]})


def test_new_anchor_holds_its_current_position() -> None:
    simulation = swinging()
    anchors = simulation.positions[BOTTOM]
    assert np.abs(simulation.velocities[BOTTOM]).max() > 0.1
    for _ in range(5):
        simulation.advance([anchored("top", "bottom")] if simulation.frame == 20 else [])
        np.testing.assert_allclose(simulation.positions[BOTTOM], anchors, rtol=0.0, atol=1e-12)
    assert not simulation.velocities[BOTTOM].any()


def test_released_anchor_falls() -> None:
    simulation = swinging()
    simulation.advance([anchored("top_left")])
    for _ in range(10):
        simulation.advance()
    # private: the start is not public
    moved = np.linalg.norm(simulation.positions - simulation._initial.positions, axis=1)
    assert moved[0] < 1e-12
    assert (moved[1:7] > 1e-3).all()


def test_a_sheet_that_sleeps_wakes() -> None:
    simulation = Simulation(Scene.from_parameters(GRID | {"gravity": [0.0, 0.0, 0.0]}))
    for _ in rounds_until(lambda: simulation.asleep):
        simulation.advance()
    simulation.advance([SetParameters({"gravity": [0.0, 0.0, -9.81], "cloth.anchors": [""]})])
    assert not simulation.asleep
    assert simulation.velocities[:, 2].max() < -0.1


def test_grasped_particle_may_be_anchored_and_released() -> None:
    simulation = swinging()
    corner = 41
    simulation.advance([Target("gripper", tuple(simulation.positions[corner])), Grasp("gripper", True)])
    assert simulation.grippers.grasped_particles(0).tolist() == [corner]
    simulation.advance([anchored("top", "41")])
    position = simulation.positions[corner]
    for k in range(10):
        simulation.advance([Target("gripper", tuple(position + np.array([0.0, 0.0, 0.01 * k])))])
    np.testing.assert_allclose(simulation.positions[corner], position, rtol=0.0, atol=1e-12)
    simulation.advance([anchored("top")])
    for _ in range(10):
        simulation.advance()
    assert simulation.positions[corner][2] > position[2] + 0.05


def test_reset_restores_positions_and_keeps_anchors() -> None:
    simulation = swinging()
    simulation.advance([anchored("bottom")])
    simulation.advance([Reset()])
    simulation.advance()
    # private: the start is not public
    start = simulation._initial.positions
    np.testing.assert_allclose(simulation.positions[BOTTOM], start[BOTTOM], rtol=0.0, atol=1e-12)
    assert np.abs(simulation.positions[TOP] - start[TOP]).max() > 1e-4


@pytest.mark.parametrize("integrator", ["auto", "implicit"])
def test_anchor_changes_replay_bit_for_bit_from_any_frame(integrator: str) -> None:
    def events(frame: int) -> list[object]:
        if frame == 25:
            return [anchored("top_left", "41")]
        if frame == 28:
            return [anchored()]
        return [anchored("top"), Reset()] if frame == 32 else []

    simulation = Simulation(Scene.from_parameters(GRID | {"integrator": integrator}))
    saved = {}
    for frame in range(40):
        saved[frame] = (simulation.scene, simulation.state.to_bytes())
        simulation.advance(events(frame))  # type: ignore[arg-type]
    for begin in (0, 24, 26, 30, 33):
        scene, state = saved[begin]
        again = Simulation(scene, State.from_bytes(state))
        for frame in range(begin, 40):
            again.advance(events(frame))  # type: ignore[arg-type]
        assert again.state.digest() == simulation.state.digest(), begin


def test_a_state_begins_with_other_anchors_at_rest(tmp_path: Path) -> None:
    path = tmp_path / "state.npz"
    path.write_bytes(swinging().state.to_bytes())
    simulation = Simulation(Scene.from_parameters(GRID | {"cloth.anchors": ["bottom"], "initial_state": str(path)}))
    anchors = simulation.positions[BOTTOM]
    for _ in range(3):
        simulation.advance()
    np.testing.assert_allclose(simulation.positions[BOTTOM], anchors, rtol=0.0, atol=1e-12)
    simulation.advance([Reset()])
    simulation.advance()
    np.testing.assert_allclose(simulation.positions[BOTTOM], anchors, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (["42"], "cloth.anchors names particle 42; there are 42, counted from 0"),
        (["middle"], "'middle' is no edge or corner of a grid; there are top, bottom"),
        (["-1"], "'-1' is no edge or corner"),
    ],
)
def test_invalid_anchor_is_refused_with_the_reason(names: list[str], words: str) -> None:
    simulation = swinging(1)
    before = simulation.state.digest()
    with pytest.raises(EventError, match=words):
        simulation.advance([anchored(*names)])
    assert simulation.state.digest() == before
    with pytest.raises(EventError, match="must be an array of string"):
        simulation.advance([SetParameters({"cloth.anchors": "top"})])


def test_anchor_parameter_is_refused_alike_and_recorded(client: Client, tmp_path: Path) -> None:
    pytest.importorskip("mcap")
    from cloth_sim_ros.verify.run import verify

    with ClockedCloth(client, {"record.enabled": True, "record.folder": str(tmp_path)}) as cloth:
        cloth.tick(3)
        (result,) = cloth.node.node.set_parameters([Parameter("cloth.anchors", value=["top_left", "99"])])
        assert not result.successful
        assert "cloth.anchors names particle 99; there are 42" in result.reason
        (result,) = cloth.node.node.set_parameters([Parameter("cloth.anchors", value=["top_left"])])
        assert result.successful, result.reason
        cloth.tick(20)
        assert cloth.simulation.scene.anchored_particles() == [0]
    (path,) = tmp_path.glob("*.mcap")
    assert verify([path]).same
