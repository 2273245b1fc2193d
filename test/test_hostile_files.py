# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Malicious and randomly damaged files: commands refuse them in one sentence."""

from __future__ import annotations

import functools
import json
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest

pytest.importorskip("mcap")
pytest.importorskip("zstandard")
pytest.importorskip("lz4")

from soak_files import soak
from support import bombs
from support.session_maker import make_grasp

from cloth_sim_ros.scene.parameters import parameter_file
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.frame_record import FrameRecord
from cloth_sim_ros.session.reader import SessionReader
from cloth_sim_ros.simulation.events import from_dict
from cloth_sim_ros.simulation.gripper_script import GripperScript, ScriptError

#: Memory that a command may use in addition to its use without the file [MB]; and time [s], on a busy machine.
MEMORY, SECONDS = 300.0, 60.0
Find = Callable[[str], str]


@pytest.fixture(scope="module")
def opening(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A session before its first chunk."""
    return bombs.opening(make_grasp(tmp_path_factory.mktemp("session"), seconds=0.1, cloth__resolution=[4, 4]))


@functools.cache
def at_rest(command: str) -> float:
    """Memory that a command uses without a file [MB]."""
    with tempfile.TemporaryDirectory() as folder:
        return bombs.measure([command, "--help"], Path(folder), limit=SECONDS).memory


def refused(command: list[str], folder: Path) -> str:
    """Run a command that must refuse a file with little memory and time; return its output."""
    done = bombs.measure(command, folder, limit=SECONDS)
    assert "Traceback" not in done.said, done.said[-2000:]
    assert done.status in (0, 1, 2), done.said[-2000:]
    assert done.memory < at_rest(command[0]) + MEMORY, done
    assert max(map(len, done.said.splitlines()), default=0) < 4000
    return done.said


@pytest.mark.parametrize(
    ("content", "compression", "announced", "words"),
    [
        (lambda: bombs.zstd_zeros(2 << 30), "zstd", 2 << 30, "announces 2147483648 bytes, the limit is 268435456"),
        (lambda: bombs.zstd_zeros(512 << 20), "zstd", 1000, "announces 1000 bytes and holds more"),
        (lambda: bombs.zstd_zeros(255 << 20), "zstd", 255 << 20, "a record of opcode 0"),
        (lambda: bombs.lz4_zeros(512 << 20), "lz4", 1000, "announces 1000 bytes and holds more"),
        (lambda: bombs.lz4_zeros(512 << 20), "lz4", 200 << 20, "announces 209715200 bytes and holds more"),
    ],
)
def test_chunk_unpacks_to_its_announced_size_at_most(
    content: Callable[[], bytes],
    compression: str,
    announced: int,
    words: str,
    opening: bytes,
    tmp_path: Path,
    find_executable: Find,
) -> None:
    (tmp_path / "bomb.mcap").write_bytes(opening + bombs.chunk(content(), compression, announced))
    assert words in refused([find_executable("cloth_session"), "info", "bomb.mcap"], tmp_path)


def test_chunk_of_one_large_message_is_refused(opening: bytes, tmp_path: Path, find_executable: Find) -> None:
    message = bombs.record(5, bytes(22 + (200 << 20)))
    packed = bombs.zstd(message)
    (tmp_path / "bomb.mcap").write_bytes(opening + bombs.chunk(packed, "zstd", len(message)))
    said = refused([find_executable("cloth_session"), "info", "bomb.mcap"], tmp_path)
    assert "a record of 209715222; together the limit is 268435456" in said


def test_chunk_that_compresses_a_thousandfold_is_read(opening: bytes, tmp_path: Path) -> None:
    message = bombs.record(5, bytes(22 + (8 << 20)))
    packed = bombs.zstd(message)
    assert len(packed) < len(message) / 1000
    (tmp_path / "rest.mcap").write_bytes(opening + bombs.chunk(packed, "zstd", len(message), crc=0))
    with SessionReader(tmp_path / "rest.mcap") as reader:
        assert list(reader.messages()) == []
        # Its channel is not declared; everything else is valid.
        assert "never declared" in (reader.missing or "")


def test_fake_chunk_headers_are_not_read_repeatedly(opening: bytes, tmp_path: Path, find_executable: Find) -> None:
    (tmp_path / "heads.mcap").write_bytes(opening + bombs.false_heads(2 << 20))
    assert "cannot be read" in refused([find_executable("cloth_session"), "info", "heads.mcap"], tmp_path)


def test_sparse_attachment_is_not_read(opening: bytes, tmp_path: Path, find_executable: Find) -> None:
    size = 4 << 30
    head = bombs.record(9, b"")[:1] + (size - len(opening) - 9).to_bytes(8, "little")
    bombs.sparse(tmp_path / "sparse.mcap", size, opening + head)
    said = refused([find_executable("cloth_session"), "info", "sparse.mcap"], tmp_path)
    assert "the limit is" in said


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (lambda: bombs.npz_zeros(512 << 20), "the limit is 134217728"),
        (lambda: bombs.npz_zeros(120 << 20), "particles, the cloth"),
        (lambda: bombs.npy_of_shape((3, 10**12)), "it is no .npz file"),
        (lambda: bombs.npy_of_shape((3, 10), "|O"), "it is no .npz file"),
    ],
)
def test_state_of_much_memory_is_refused(
    content: Callable[[], bytes], words: str, tmp_path: Path, find_executable: Find
) -> None:
    (tmp_path / "state.npz").write_bytes(content())
    (tmp_path / "scene.yaml").write_text("/**: {ros__parameters: {initial_state: state.npz}}")
    assert words in refused([find_executable("cloth_sim"), "--check", "scene.yaml"], tmp_path)


def test_face_of_many_corners_is_refused(tmp_path: Path, find_executable: Find) -> None:
    (tmp_path / "comb.obj").write_bytes(bombs.many_cornered_face(8000))
    (tmp_path / "scene.yaml").write_text("/**: {ros__parameters: {cloth.mesh: comb.obj}}")
    said = refused([find_executable("cloth_sim"), "--check", "scene.yaml"], tmp_path)
    assert "face 0 has 8000 corners" in said


TEXTS = {
    "aliases": (bombs.laughs(), "more than 250000 values"),
    "nested lists": ("[" * 1_000_000, "nested too deeply"),
    "nested maps": ("{a: " * 200_000, "nested too deeply"),
    "long list": ("scene: [" + "1," * 500_000 + "1]", "more than 250000 values"),
    "digits": ("scene: " + "9" * 10**6, "1000000 characters"),
    "alias in itself": ("scene: &a [*a]", "stands for nothing"),
}


@pytest.mark.parametrize("kind", TEXTS)
def test_text_of_much_work_is_refused(kind: str, tmp_path: Path, find_executable: Find) -> None:
    text, words = TEXTS[kind]
    (tmp_path / "study.yaml").write_text(text)
    assert words in refused([find_executable("cloth_batch"), "check", "study.yaml"], tmp_path)
    with pytest.raises(ScriptError):
        GripperScript.from_file(tmp_path / "study.yaml")
    with pytest.raises(ParameterError):
        parameter_file.read(tmp_path / "study.yaml")


#: Commands that read a file; the two functions that refuse devices are those of the first and of the second.
READERS = [
    ["cloth_sim", "--check", "FILE"],
    ["cloth_session", "info", "FILE"],
    ["cloth_gripper", "FILE"],
    ["cloth_batch", "check", "FILE"],
    ["cloth_batch", "check", "study.yaml"],
    ["cloth_verify", "FILE"],
    ["cloth_replay", "FILE", "--save", "out.rrd"],
    ["cloth_fit", "FILE", "--parameters", "stretch"],
]


@pytest.mark.parametrize(("file", "readers"), [("pipe", READERS), ("/dev/zero", READERS[:2])])
def test_pipes_and_devices_are_refused(
    file: str, readers: list[list[str]], tmp_path: Path, find_executable: Find
) -> None:
    os.mkfifo(tmp_path / "pipe")
    os.mkfifo(tmp_path / "policy.py")
    study = {"scene": "cloth_sim.yaml", "policy": "policy.py:f", "duration": 1.0, "runs": 1}
    (tmp_path / "study.yaml").write_text(json.dumps(study))
    for name, *arguments in readers:
        command = [find_executable(name), *(file if word == "FILE" else word for word in arguments)]
        assert "is a device or a pipe" in refused(command, tmp_path), name


RECORD = {
    "frame": 1,
    "time": 0.1,
    "events": [],
    "integrator": "x",
    "tolerance": None,
    "steps": 1,
    "digest": "0",
    "paused": False,
}


@pytest.mark.parametrize(
    ("member", "words"),
    [
        ("[" * 100_000 + "]" * 100_000, "nested more than 64 deep"),
        ("[" * 100 + "]" * 100, "nested more than 64 deep"),
        ('[{"kind": "\\ud800"}]', "half a surrogate pair"),
        ("[" + "[]," * 3_000_000 + "[]]", "the limit is"),
        ("9" * 5000, "not readable"),
    ],
)
def test_frame_record_of_odd_json_is_refused(member: str, words: str) -> None:
    text = json.dumps(RECORD).replace('"events": []', f'"events": {member}')
    with pytest.raises(SessionError, match=words):
        FrameRecord.from_json(text)


@pytest.mark.parametrize(
    "event",
    [
        {"kind": "set_parameters", "values": 5},
        {"kind": {}},
        {"kind": "target", "gripper": [], "position": [0, 0, 0]},
        {"kind": "target", "gripper": "a", "position": [10**400, 0, 0]},
        {"kind": "pause", "paused": "no"},
    ],
)
def test_event_of_wrong_types_is_refused(event: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=r"event .*(unknown kind|does not fit)"):
        from_dict(event)


def test_damaged_files_end_no_command_with_a_traceback() -> None:
    assert soak(24, 4, print) == []
