# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sessions and states of version 0.1.0, with other arithmetic.

test/data/session_0.1.0.mcap is 24 frames of a cloth of 6 x 5 whose corner a gripper carries, recorded by that version;
state_0.1.0.npz its state after frame 12, as ~/save_state wrote it.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mcap")
pytest.importorskip("rosbags")
from support.session_maker import NODE, SessionMaker, carried_corner

from cloth_sim_ros import Scene, Simulation, State
from cloth_sim_ros.engine import NUMERICS
from cloth_sim_ros.session.cdr import decode_string, encode_string
from cloth_sim_ros.session.main import main as session_command
from cloth_sim_ros.session.reader import SessionReader
from cloth_sim_ros.simulation.environment import differences, environment, recorder_with_other_arithmetic
from cloth_sim_ros.simulation.events import Target, to_dict
from cloth_sim_ros.verify.main import main as verify_command
from cloth_sim_ros.verify.run import verify

DATA = Path(__file__).parents[1] / "data"
SESSION, STATE = DATA / "session_0.1.0.mcap", DATA / "state_0.1.0.npz"
FRAMES, SAVED = 24, 12
#: Positions of one motion by two versions differ by their step errors, each within 0.6 of the scene's tolerance of
#: 1e-4 m per second. 1.1e-5 m was measured over the 0.4 s.
APART = 5e-5


def before_the_engine(**changes: str) -> dict[str, str]:
    """Metadata of version 0.1.0, merged into those of a new session."""
    return {"version": "0.1.0", "numba": "0.68.1", "numerics": "1", **changes}


def test_verify_names_other_arithmetic_and_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert verify_command([str(SESSION)]) == 3
    said = capsys.readouterr().out
    assert "session_0.1.0.mcap: it differs from frame 1 (0.017 s) on, in the digest of its state" in said
    assert (
        f"Of {FRAMES} frames and {FRAMES} clouds, {FRAMES} frames differ; the largest deviation of a particle is"
        in said
    )
    assert (
        "It was recorded by cloth_sim_ros 0.1.0 (numba 0.68.1), whose arithmetic this version's engine does not repeat "
        "to the last bit; that is no damage."
    ) in said
    # The code differs by definition.
    assert "its code" not in said


def test_motion_of_other_arithmetic_is_within_tolerance() -> None:
    verdict = verify([SESSION])
    assert (verdict.first_frame, verdict.frames, verdict.clouds) == (1, FRAMES, FRAMES)
    assert 0.0 < verdict.largest_deviation < APART
    assert not verdict.unexplained
    assert not verdict.damaged


@pytest.mark.parametrize("key", ["time", "tolerance", "paused", "events"])
def test_difference_beyond_rounding_is_unexplained(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], key: str
) -> None:
    changed = {"time": 0.7, "tolerance": 1.0, "paused": True, "events": [to_dict(Target("gripper", (1.0, 2.0, 3.0)))]}

    def spoil(topic: str, data: bytes) -> bytes:
        if topic != f"{NODE}/frame":
            return data
        record = {**json.loads(decode_string(data)), "digest": "0" * 32}
        return encode_string(json.dumps(record | ({key: changed[key]} if record["frame"] == 5 else {})))

    scene = Scene.from_parameters({"cloth.resolution": [4, 4]})
    maker = SessionMaker(tmp_path, scene, metadata=before_the_engine())
    for events in carried_corner(scene, 10 / 60.0):
        maker.add(events, change=spoil)
    assert verify_command([str(maker.finish())]) == 1
    assert "But arithmetic does not explain frame 5, " in capsys.readouterr().out


def test_equal_session_of_other_arithmetic_has_status_same(tmp_path: Path) -> None:
    maker = SessionMaker(tmp_path, Scene.from_parameters({"cloth.resolution": [4, 4]}), metadata=before_the_engine())
    maker.add()
    assert verify_command([str(maker.finish())]) == 0


def test_exit_status_is_most_severe(tmp_path: Path) -> None:
    scene = Scene.from_parameters({"cloth.resolution": [4, 4]})
    maker = SessionMaker(tmp_path, scene)
    maker.add()
    good = str(maker.finish())
    bad = SessionMaker(tmp_path, scene, stem="bad")
    bad.add(change=lambda topic, data: data[:-9] + b"\1" + data[-8:] if topic.endswith("/points") else data)
    different = str(bad.finish())
    assert verify_command([str(SESSION), good]) == 3
    assert verify_command([different, str(SESSION)]) == 1
    assert verify_command([str(SESSION), different]) == 1
    assert verify_command([different, str(tmp_path / "absent.mcap"), str(SESSION)]) == 2


def test_irrelevant_environment_is_no_cause() -> None:
    recorded = environment() | {"python": "3.1", "numpy": "1.0", "processor": "another", "instructions": "neon"}
    assert differences(recorded) == []
    assert recorder_with_other_arithmetic(recorded) == ""
    assert differences(recorded | {"source": "0"}) == [f"its code 0 -> {environment()['source']}"]


@pytest.mark.parametrize(
    ("recorded", "by"),
    [
        ({"version": "0.1.0", "numba": "0.68.1"}, "cloth_sim_ros 0.1.0 (numba 0.68.1)"),
        ({"version": "9.0.0", "numerics": str(NUMERICS + 1)}, "cloth_sim_ros 9.0.0"),
        ({}, "another version of cloth_sim_ros"),
    ],
)
def test_other_arithmetic_names_its_recorder(recorded: dict[str, str], by: str) -> None:
    assert recorder_with_other_arithmetic(recorded) == by


def test_environment_names_its_arithmetic() -> None:
    versions = environment()
    assert set(versions) == {"version", "numerics", "source", "instructions", "python", "numpy", "machine", "processor"}
    assert versions["instructions"] in {"baseline", "avx2", "avx512", "neon"}


def test_older_session_is_read_and_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert session_command(["info", str(SESSION)]) == 0
    said = capsys.readouterr().out
    assert "version 0.1.0" in said
    assert f"1 to {FRAMES} ({FRAMES} records)" in said


def test_older_session_is_shown(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    from cloth_sim_ros.replay.main import main as replay_command

    assert replay_command([str(SESSION), "--save", str(tmp_path / "out.rrd")]) == 0
    assert (tmp_path / "out.rrd").stat().st_size > 0


def test_older_state_continues() -> None:
    state = State.from_bytes(STATE.read_bytes())
    with SessionReader(SESSION) as reader:
        records = list(reader.frames())
        scene = scene_of(reader)
    # Its controller state follows older rules and is not used.
    assert state.dropped_memory == ("stepper", "automatic")
    assert records[SAVED - 1].frame == state.frame == SAVED
    simulation = Simulation(scene, state)
    for _ in range(5):
        simulation.advance()
    assert simulation.frame == SAVED + 5
    assert np.isfinite(simulation.positions).all()
    assert math.isclose(simulation.time, (SAVED + 5) * scene.period)


def test_frame_of_older_session_is_an_initial_state() -> None:
    pytest.importorskip("rclpy")
    from cloth_sim_ros.ros.recording.initial_state import session_state

    name = f"{SESSION}@{SAVED}"
    begun = State.from_bytes(session_state(name)[name])
    assert begun.frame == SAVED
    recorded = State.from_bytes(STATE.read_bytes())
    assert np.abs(begun.x - recorded.x).max() < APART


def scene_of(reader: SessionReader) -> Scene:
    from cloth_sim_ros.scene.parameters import parameter_file

    return Scene.from_parameters(parameter_file.parse(reader.scene_yaml, node=reader.node, source="scene.yaml"))
