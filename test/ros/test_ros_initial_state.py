# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`initial_state: session.mcap@frame`: the exact state of the frame, for all kinds of recordings."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mcap")
pytest.importorskip("rosbags")
from support.session_maker import SessionMaker, carried_corner

import cloth_sim_ros
from cloth_sim_ros import Pause, Scene, SetParameters, Simulation, State
from cloth_sim_ros.ros.recording.initial_state import session_state
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.session.writer import WriterOptions
from cloth_sim_ros.simulation.events import Event

GRID = {"cloth.resolution": [5, 6], "gripper.radius": 0.3, "cloth.size": [0.5, 0.6]}
FRAMES = 40


def script() -> list[list[Event]]:
    """Events of a grasp that holds particles in frame 25, with a change of a parameter."""
    events = list(carried_corner(Scene.from_parameters(GRID), FRAMES / 60.0))
    events[12] = [*events[12], SetParameters({"air.drag": 0.5})]
    return events


def recorded(folder: Path, *, split: Sequence[int] = (), cut: bool = False, scene: Scene | None = None) -> Any:
    """A session, and its state before frame 1 and after each frame."""
    # Chunks of one or two frames, so that a truncated file holds nearly all of them.
    options = WriterOptions(chunk_bytes=1 << 10, sync_seconds=0.0)
    maker = SessionMaker(folder, scene or Scene.from_parameters(GRID), options=options)
    states = [maker.simulation.state.copy()]
    for frame, events in enumerate(script()):
        if frame in split:
            maker.split()
        maker.add(events)
        states.append(maker.simulation.state.copy())
    if cut:
        maker.cut()
    else:
        maker.finish()
    return maker.paths, states


def start_from(name: str, **values: Any) -> Simulation:
    parameters = {**GRID, **values, "initial_state": name}
    return Simulation(Scene.from_parameters(parameters, files=session_state(name)))


def assert_same_motion(simulation: Simulation, state: State) -> None:
    """Compare bit for bit, with grips and controller state; frame numbers start again."""
    expected = state.copy()
    expected.frame = 0
    assert simulation.state.digest() == expected.digest()
    assert simulation.frame == 0


@pytest.mark.parametrize("frame", [0, 1, 13, 25, FRAMES])
def test_the_cloth_starts_at_that_frame_bit_for_bit(tmp_path: Path, frame: int) -> None:
    (path,), states = recorded(tmp_path)
    assert states[25].memory["grip.particles"].size > 0
    simulation = start_from(f"{path}@{frame}")
    assert_same_motion(simulation, states[frame])
    # The same commands move it in the same way.
    original = Simulation(simulation.scene, states[frame])
    for events in script()[frame : frame + 3]:
        original.advance(events)
        simulation.advance(events)
        np.testing.assert_allclose(simulation.positions, original.positions, rtol=0.0, atol=1e-12)


def test_truncated_session_is_read_to_its_last_frame(tmp_path: Path) -> None:
    (path,), states = recorded(tmp_path, cut=True)
    assert_same_motion(start_from(f"{path}@25"), states[25])
    with pytest.raises(ParameterError, match=rf"the session ends at frame {FRAMES} \("):
        start_from(f"{path}@{FRAMES + 1}")


@pytest.mark.parametrize("named", [0, 1, 2])
def test_any_file_of_a_split_session_leads_to_any_frame(tmp_path: Path, named: int) -> None:
    paths, states = recorded(tmp_path, split=(10, 30))
    assert len(paths) == 3
    for frame in (0, 5, 10, 11, 30, 33):
        assert_same_motion(start_from(f"{paths[named]}@{frame}"), states[frame])


def test_missing_part_of_split_session_is_reported(tmp_path: Path) -> None:
    paths, states = recorded(tmp_path, split=(10, 30))
    paths[0].unlink()
    assert_same_motion(start_from(f"{paths[1]}@33"), states[33])
    with pytest.raises(ParameterError, match="the session begins at frame 10"):
        start_from(f"{paths[1]}@5")


def test_frames_beyond_the_end_are_refused(tmp_path: Path) -> None:
    (path,), _ = recorded(tmp_path)
    with pytest.raises(ParameterError, match=rf"the session ends at frame {FRAMES}$"):
        start_from(f"{path}@{FRAMES + 1}")


@pytest.mark.parametrize("frame", ["", "x", "-1", "1.5", "٣", "9" * 5000])
def test_invalid_frame_number_is_refused(frame: str) -> None:
    with pytest.raises(ParameterError, match=r"is no frame number; write session\.mcap@120"):
        session_state(f"session.mcap@{frame}")


def test_a_session_of_another_cloth_is_refused_with_the_reason(tmp_path: Path) -> None:
    (path,), _ = recorded(tmp_path)
    with pytest.raises(ParameterError, match="of a grid of 5 x 6 particles, the cloth has 6 x 5"):
        start_from(f"{path}@25", **{"cloth.resolution": [6, 5]})
    with pytest.raises(ParameterError, match="has 1 grippers, the cloth 2"):
        start_from(f"{path}@25", grippers=["left", "right"])


def test_a_session_that_runs_differently_here_is_refused(tmp_path: Path) -> None:
    maker = SessionMaker(tmp_path, Scene.from_parameters(GRID))
    events = script()
    for frame in range(FRAMES):
        maker.add(events[frame])
        if frame == 20:
            maker.simulation.state.v[0, 7] += 1e-9
    path = maker.finish()
    assert session_state(f"{path}@20")
    with pytest.raises(ParameterError, match="from frame 22 on the session does not run here as it was recorded"):
        session_state(f"{path}@30")


def test_a_session_with_a_gap_is_refused(tmp_path: Path) -> None:
    maker = SessionMaker(tmp_path, Scene.from_parameters(GRID))
    for frame, events in enumerate(script()):
        is_missing = frame in (8, 9)
        maker.add(
            events,
            change=lambda topic, data, is_missing=is_missing: None if is_missing and topic.endswith("/frame") else data,
        )
    path = maker.finish()
    assert session_state(f"{path}@8")
    with pytest.raises(ParameterError, match="frames 9 to 10 of the session are missing"):
        session_state(f"{path}@30")


def test_paused_frame_has_the_state_at_the_pause(tmp_path: Path) -> None:
    maker = SessionMaker(tmp_path, Scene.from_parameters(GRID))
    events = script()
    for frame in range(30):
        maker.add(events[frame])
    maker.add([Pause(True)])
    maker.add()
    path = maker.finish()
    simulation = start_from(f"{path}@30")
    assert not simulation.paused, "a state starts running, wherever it comes from"
    assert simulation.advance().moved


def test_session_started_from_another_is_self_contained(tmp_path: Path) -> None:
    (path,), states = recorded(tmp_path)
    first = start_from(f"{path}@25")
    (second,), later = recorded(tmp_path / "later", scene=first.scene)
    path.unlink()
    assert_same_motion(start_from(f"{second}@0"), states[25])
    assert_same_motion(start_from(f"{second}@7"), later[7])


def test_a_session_of_a_mesh_carries_the_mesh(tmp_path: Path) -> None:
    pytest.importorskip("trimesh")
    mesh = tmp_path / "quad.obj"
    mesh.write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3\nf 1 3 4\n")
    values = {"cloth.mesh": str(mesh), "bending.model": "none", "cloth.anchors": ["0"]}
    maker = SessionMaker(tmp_path, Scene.from_parameters(values), topology=False)
    for _ in range(10):
        maker.add()
    path = maker.finish()
    content = mesh.read_bytes()
    mesh.unlink()
    name = f"{path}@10"
    scene = Scene.from_parameters({**values, "initial_state": name}, files={**session_state(name), str(mesh): content})
    assert_same_motion(Simulation(scene), maker.simulation.state)


def test_missing_mcap_is_reported_with_the_reason(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (path,), _ = recorded(tmp_path)
    # The package keeps its subpackage as an attribute, beside sys.modules.
    monkeypatch.setattr(cloth_sim_ros, "session", cloth_sim_ros.session)
    for module in [name for name in sys.modules if name.startswith(("mcap", "cloth_sim_ros.session"))]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, "mcap", None)
    with pytest.raises(ParameterError, match="needs mcap, which is not installed: pip install mcap"):
        session_state(f"{path}@3")
