# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sessions with clouds in double precision."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mcap")
pytest.importorskip("rosbags")
from support.session_maker import NODE, SessionMaker, cloud_bytes

from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.session.cdr import decode_cloud
from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.export import export
from cloth_sim_ros.session.reader import SessionReader
from cloth_sim_ros.simulation.events import SetParameters
from cloth_sim_ros.simulation.simulation import Simulation
from cloth_sim_ros.studies.run_recording import RunRecording
from cloth_sim_ros.verify.run import verify

#: A cloth at map coordinates, where single precision resolves 1 mm.
DISTANT: dict[str, Any] = {
    "cloth.resolution": [6, 5],
    "cloth.size": [0.3, 0.3],
    "cloth.position": [1e4, -1e4, 1.0],
    "tolerance": 1e-5,
    "points.double": True,
}
FRAMES = 6


def session(folder: Path, *, frames: int = FRAMES, **further: Any) -> SessionMaker:
    maker = SessionMaker(folder, Scene.from_parameters({**DISTANT, **further}))
    for _ in range(frames):
        maker.add()
    return maker


@pytest.mark.parametrize("velocity", [False, True])
def test_double_clouds_are_verified_to_the_last_bit(tmp_path: Path, velocity: bool) -> None:
    maker = session(tmp_path, **{"points.velocity": velocity})
    verdict = verify([maker.finish()])
    assert verdict.same, verdict.first_reason
    assert verdict.clouds == FRAMES


@pytest.mark.parametrize("byte", [24 * 30, 8])
def test_one_flipped_bit_of_a_double_is_found(tmp_path: Path, byte: int) -> None:
    maker = session(tmp_path, **{"points.velocity": True})

    def spoil(topic: str, data: bytes) -> bytes:
        if topic != f"{NODE}/points":
            return data
        flipped = bytearray(data)
        flipped[-byte] ^= 1
        return bytes(flipped)

    maker.add(change=spoil)
    verdict = verify([maker.finish()])
    assert (verdict.first_frame, verdict.different) == (FRAMES + 1, 1)


def test_precision_may_change_while_the_cloth_runs(tmp_path: Path) -> None:
    maker = session(tmp_path)
    maker.add([SetParameters({"points.double": False})])
    path = maker.finish()
    assert verify([path]).same
    with SessionReader([path]) as reader, pytest.raises(SessionError, match="float32, those before float64"):
        export(reader, tmp_path / "out.npz")


def test_precision_of_clouds_does_not_affect_motion(tmp_path: Path) -> None:
    digests = []
    for double in (False, True):
        simulation = Simulation(Scene.from_parameters({**DISTANT, "points.double": double}))
        for _ in range(FRAMES):
            simulation.advance()
        digests.append(simulation.state.digest())
    assert digests[0] == digests[1]


def test_export_keeps_double_precision(tmp_path: Path) -> None:
    pq = pytest.importorskip("pyarrow.parquet")
    maker = session(tmp_path)
    positions = maker.simulation.positions
    with SessionReader([maker.finish()]) as reader:
        assert export(reader, tmp_path / "out.npz") == FRAMES
        assert export(reader, tmp_path / "out.parquet") == FRAMES
    assert np.array_equal(np.load(tmp_path / "out.npz")["positions"][-1], positions)
    table = pq.read_table(tmp_path / "out.parquet")
    assert np.array_equal(np.array(table["x"])[-len(positions) :], positions[:, 0])


def test_run_of_a_study_records_double_clouds(tmp_path: Path) -> None:
    simulation = Simulation(Scene.from_parameters(DISTANT))
    recording = RunRecording(tmp_path, simulation, name="run", clouds=True)
    recording.add((), simulation.advance())
    path = recording.finish(reason="done")
    with SessionReader([path]) as reader:
        (recorded,) = reader.clouds()
    assert np.array_equal(recorded.cloud.xyz, simulation.positions)


def test_fields_of_two_types_are_no_position(tmp_path: Path) -> None:
    data = cloud_bytes(np.zeros((2, 3)), 0, (1, 2), double=True)
    assert decode_cloud(data).xyz.dtype == np.float64
    mixed = data.replace(b"y\0", b"w\0", 1)
    with pytest.raises(SessionError, match="no evenly spaced fields x, y, z of one type, float32 or float64"):
        decode_cloud(mixed)


def test_replay_measures_strain_in_double_precision(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    from cloth_sim_ros.replay.main import main
    from cloth_sim_ros.replay.pre_scan import scan_session

    maker = session(tmp_path)
    path = maker.finish()
    with SessionReader([path]) as reader:
        assert scan_session(reader).strain_limit <= 0.02
    assert main([str(path), "--save", str(tmp_path / "out.rrd")]) == 0
