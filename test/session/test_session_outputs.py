# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Output files of commands: refused before the work, written atomically."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from support import session_samples as samples

from cloth_sim_ros.session import export
from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.main import main
from cloth_sim_ros.session.output_files import OutputError, atomic_write, check_outputs
from cloth_sim_ros.session.reader import SessionReader
from cloth_sim_ros.session.recorder import Recorder

CONTENT = list(samples.samples(30))


@pytest.fixture
def session(tmp_path: Path) -> Path:
    return samples.write_session(tmp_path, CONTENT)


def _refusal(path: Path, *inputs: Path) -> str:
    with pytest.raises(OutputError) as refused:
        check_outputs({"--plot": path}, inputs, endings={"--plot": ".png"})
    assert "--plot" in str(refused.value)
    assert "\n" not in str(refused.value)
    return str(refused.value)


def test_inputs_and_sessions_are_refused_as_outputs(session: Path, tmp_path: Path) -> None:
    link, hard, plain = tmp_path / "link.png", tmp_path / "hard.png", tmp_path / "scene.yaml"
    link.symlink_to(session)
    hard.hardlink_to(session)
    plain.write_text("rate: 60.0")
    for path in (session, link, hard):
        assert "which is read" in _refusal(path, plain, session)
    assert "which is read" in _refusal(plain, session, plain)
    second_output = tmp_path / "other.png"
    second_output.write_bytes(session.read_bytes())
    assert "holds an MCAP recording" in _refusal(second_output, session)
    for name in ("new.mcap", "NEW.MCAP"):
        assert "ends in .mcap is a session" in _refusal(tmp_path / name, session)


def test_unwritable_output_is_reported_at_once(tmp_path: Path) -> None:
    assert "there is no folder" in _refusal(tmp_path / "absent" / "out.png")
    assert "a folder: name a file" in _refusal(tmp_path)
    if Path("/proc").is_dir():
        assert "nothing can be written into '/proc'" in _refusal(Path("/proc/out.png"))
    if os.geteuid():
        existing = tmp_path / "kept.png"
        existing.touch(0o400)
        assert "must not be written" in _refusal(existing)
    assert "end the name in .png" in _refusal(tmp_path / "out.jpg")


def test_other_files_may_be_replaced_and_check_leaves_no_file(tmp_path: Path) -> None:
    old = tmp_path / "old.png"
    old.write_text("old")
    check_outputs(
        {"--plot": old, "--json": tmp_path / "new.json", "--save": None, "--particles": Path(os.devnull)},
        [tmp_path / "absent.mcap"],
        endings={"--plot": ".png"},
    )
    assert [path.name for path in tmp_path.iterdir()] == ["old.png"]
    assert old.read_text() == "old"


def test_two_outputs_need_two_files(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "out")
    with pytest.raises(OutputError, match="--json and --plot both name"):
        check_outputs({"--json": tmp_path / "out", "--plot": tmp_path / "link"}, [])
    check_outputs({"--json": Path(os.devnull), "--plot": Path(os.devnull)}, [])


def _interrupted(target: Path) -> None:
    with atomic_write(target) as output:
        output.write_text("half")
        raise KeyboardInterrupt


def test_interrupted_write_keeps_existing_file(tmp_path: Path) -> None:
    target = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        _interrupted(target)
    assert list(tmp_path.iterdir()) == []
    target.write_text("old")
    target.chmod(0o640)
    with pytest.raises(KeyboardInterrupt):
        _interrupted(target)
    assert target.read_text() == "old"
    link = tmp_path / "link"
    link.symlink_to(target)
    with atomic_write(link) as output:
        output.write_text("new")
    assert link.is_symlink()
    assert target.read_text() == "new"
    assert target.stat().st_mode & 0o777 == 0o640
    with pytest.raises(FileExistsError), atomic_write(target, replace=False) as output:
        output.write_text("other")
    assert target.read_text() == "new"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["link", "out"]


def test_long_name_fits_while_it_is_written(tmp_path: Path) -> None:
    target = tmp_path / ("x" * 250)
    with atomic_write(target) as output:
        output.write_text("all")
    assert target.read_text() == "all"


def test_error_names_requested_output(tmp_path: Path) -> None:
    target = tmp_path / "absent" / "out"
    with pytest.raises(FileNotFoundError) as refused, atomic_write(target):
        pass
    assert refused.value.filename == str(target)


def test_failed_export_names_requested_output(
    session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "folder" / "out.npz"
    target.parent.mkdir()

    def goes(*_: object) -> int:
        target.parent.rename(tmp_path / "gone")
        return 1

    monkeypatch.setattr(export, "_write_npz", goes)
    assert main(["export", str(session), "-o", str(target)]) == 2
    assert capsys.readouterr().err == f"cloth_session: {target}: No such file or directory\n"


@pytest.mark.parametrize("ending", [".npz", ".parquet"])
def test_export_without_clouds_tells_of_damage(session: Path, tmp_path: Path, ending: str) -> None:
    data = bytearray(session.read_bytes())
    with SessionReader([session]) as reader:
        (chunk, *_) = reader.parts[0].chunks()
    data[chunk.location.end - 20] ^= 0xFF
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(data[: chunk.location.end])
    words = r"the session has no clouds in that span; damaged.mcap: .*the chunk at byte [0-9]+ fails its checksum"
    with SessionReader([damaged]) as reader, pytest.raises(SessionError, match=words):
        export.export(reader, tmp_path / f"out{ending}")


def test_session_being_recorded_is_not_reported_as_cut_off(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recorder = Recorder(tmp_path, snapshot=samples.SNAPSHOT, log_time=samples.START, stem="live")
    path = recorder.wait_until_open()
    assert main(["info", str(path)]) == 1
    said = capsys.readouterr().out
    assert "ends        not yet: it is still being recorded" in said
    assert "cut off" not in said
    recorder.close()


def test_pipe_does_not_block_search_for_parts(session: Path, tmp_path: Path) -> None:
    pipe = tmp_path / "pipe.mcap"
    os.mkfifo(pipe)
    for arguments, status in ([str(pipe)], 2), (["--all-parts", str(session)], 0):
        done = subprocess.run(
            [sys.executable, "-m", "cloth_sim_ros.session.main", "info", *arguments],
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        assert done.returncode == status, done.stderr
        assert ("is a device or a pipe" in done.stderr) == (status == 2)
