# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Limits of files, disk and memory: recordings and saved states are complete or absent; the node goes on."""

from __future__ import annotations

import os
import resource
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from std_srvs.srv import SetBool, Trigger
from support.ros_client import Client, start_cloth

from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.ros.recording.recording import RecordingUnavailableError, SessionRecording
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.simulation import Simulation

#: Program that saves a state with a file size limit of 1000 bytes, and is killed when it exceeds the limit.
SAVE_AND_DIE = """
import resource, signal, sys
from cloth_sim_ros.ros.recording.recording import SessionRecording
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.simulation import Simulation
simulation = Simulation(Scene.from_parameters({"record.folder": sys.argv[1]}))
resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
signal.signal(signal.SIGXFSZ, signal.SIG_DFL)
SessionRecording(node_name="/cloth_sim", simulation=simulation).save_state()
"""


def recording_into(folder: Path) -> SessionRecording:
    """Return the recording of a node that is not started."""
    simulation = Simulation(Scene.from_parameters({"record.folder": str(folder)}))
    return SessionRecording(node_name="/cloth_sim", simulation=simulation)


def test_node_without_descriptors_tells_and_goes_on(
    ros_domain: int, start_process: Callable[..., Any], tmp_path: Path
) -> None:
    process = start_cloth(start_process, "cloth.resolution:=[9, 9]", f"record.folder:={tmp_path}")
    with Client() as client:
        client.watch()

        def record(begin: bool) -> Any:
            return client.call(SetBool, "/cloth_sim/record", SetBool.Request(data=begin))

        # The client of each service is matched while descriptors are available.
        assert client.call(Trigger, "/cloth_sim/save_state").success
        assert record(True).success
        assert record(False).success
        before = sorted(tmp_path.iterdir())
        limits = resource.prlimit(process.pid, resource.RLIMIT_NOFILE)
        resource.prlimit(process.pid, resource.RLIMIT_NOFILE, (3, limits[1]))
        answers = [record(True), client.call(Trigger, "/cloth_sim/save_state")]
        client.wait_for_clouds(10)
        resource.prlimit(process.pid, resource.RLIMIT_NOFILE, limits)
        for answer in answers:
            assert not answer.success
            assert "Too many open files" in answer.message
        assert sorted(tmp_path.iterdir()) == before
        assert record(True).success
        assert record(False).success
        assert client.call(Trigger, "/cloth_sim/save_state").success
    assert process.interrupt() == 0
    assert "Traceback" not in process.output


def test_saved_state_is_whole_or_not_there_when_killed(start_process: Callable[..., Any], tmp_path: Path) -> None:
    process = start_process([sys.executable, "-c", SAVE_AND_DIE, tmp_path / "states"])
    assert process.wait() == -signal.SIGXFSZ
    assert list((tmp_path / "states").glob("[!.]*")) == []
    path = recording_into(tmp_path / "states").save_state()
    assert State.from_bytes(path.read_bytes()).frame == 0


@pytest.mark.parametrize("limit", [0, 1, 1000])
def test_saved_state_leaves_nothing_on_a_full_disk(tmp_path: Path, limit: int) -> None:
    recording = recording_into(tmp_path)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        with pytest.raises(RecordingUnavailableError, match=f"cannot write {tmp_path}.*; set record.folder"):
            recording.save_state()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert list(tmp_path.iterdir()) == []
    assert recording.save_state().exists()


def test_saved_states_never_overwrite_each_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import datetime

    class Stopped(datetime.datetime):
        @classmethod
        def now(cls, tz: datetime.tzinfo | None = None) -> Stopped:
            return cls(2026, 11, 26, tzinfo=tz)

    monkeypatch.setattr("cloth_sim_ros.ros.recording.recording.datetime.datetime", Stopped)
    recording = recording_into(tmp_path)
    paths = {recording.save_state() for _ in range(3)}
    assert len(paths) == 3
    assert sorted(paths) == sorted(tmp_path.iterdir())


def test_saved_state_without_memory_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def exhausted(_: State) -> bytes:
        raise MemoryError

    recording = recording_into(tmp_path)
    monkeypatch.setattr(State, "to_bytes", exhausted)
    for attempt in (recording.save_state, lambda: recording.begin(1)):
        with pytest.raises(RecordingUnavailableError, match="no memory is left"):
            attempt()
    assert not recording.running
    assert os.listdir(tmp_path) == []
