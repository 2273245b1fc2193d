# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`cloth_replay` overwrites no session, and a recording appears when it is complete."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from support.session_maker import make_grasp

from cloth_sim_ros.replay.main import main
from cloth_sim_ros.replay.stream import ReplayStream

pytest.importorskip("rerun", reason="the viewer is not installed: pip install 'cloth_sim_ros[replay]'")


@pytest.fixture
def session(tmp_path: Path) -> Path:
    return make_grasp(tmp_path, seconds=0.1, cloth__resolution=[5, 5])


@pytest.mark.parametrize("option", ["--save", "--screenshot"])
def test_session_is_refused_as_output(
    session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], option: str
) -> None:
    was = session.read_bytes()
    link = tmp_path / "link.png"
    link.symlink_to(session)
    second_session = tmp_path / "other.mcap"
    second_session.write_bytes(was)
    for out in (session, link, second_session):
        assert main([str(session), option, str(out)]) == 2
        assert capsys.readouterr().err.startswith(f"cloth_replay: {option} is '{out}', ")
        assert out.read_bytes() == was


def test_a_picture_is_a_png(session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(session), "--screenshot", str(tmp_path / "a.jpg")]) == 2
    assert "end the name in .png" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == [session]


def test_interrupted_recording_keeps_existing_output(
    session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out, old = tmp_path / "out.rrd", tmp_path / "old.rrd"
    assert main([str(session), "--save", str(old)]) == 0
    was = old.read_bytes()
    shown = ReplayStream.add_all

    def interrupted(*arguments: object) -> None:
        shown(*arguments)
        raise KeyboardInterrupt

    monkeypatch.setattr(ReplayStream, "add_all", interrupted)
    for path in (out, old):
        assert main([str(session), "--save", str(path)]) == 130
        assert capsys.readouterr().err.endswith("cloth_replay: interrupted\n")
    assert old.read_bytes() == was
    assert sorted(os.listdir(tmp_path)) == sorted([session.name, "old.rrd"])
