# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Outputs of `cloth_verify --accuracy`: refused before the measurement, never over a session."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.session_maker import make_grasp

from cloth_sim_ros.verify import main as verify_main


@pytest.fixture
def session(tmp_path: Path) -> Path:
    return make_grasp(tmp_path, seconds=0.05, cloth__resolution=[5, 5])


def _refusal(arguments: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setattr(verify_main, "by_session", lambda _: pytest.fail("a session was read"))
    with pytest.raises(SystemExit) as stopped:
        verify_main.main(["--accuracy", *arguments])
    assert stopped.value.code == 2
    return capsys.readouterr().err


@pytest.mark.parametrize("option", ["--json", "--plot", "--particles"])
def test_session_is_refused_as_output(
    session: Path,
    tmp_path: Path,
    option: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    was = session.read_bytes()
    second_session = tmp_path / "other.mcap"
    second_session.write_bytes(was)
    # The arguments of `--json sessions/*.mcap`, without an output name.
    for out in (session, second_session):
        said = _refusal([option, str(out), str(session)], capsys, monkeypatch)
        assert f"the output's own name right after {option}" in said
        assert out.read_bytes() == was


@pytest.mark.parametrize(
    ("option", "name", "reason"),
    [
        ("--json", "absent/x.json", "there is no folder"),
        ("--particles", "absent/x.f32", "there is no folder"),
        ("--plot", "absent/x.png", "there is no folder"),
        ("--plot", "x.xyz", "end the name in .png"),
    ],
)
def test_unwritable_output_is_reported_before_measurement(
    session: Path,
    tmp_path: Path,
    option: str,
    name: str,
    reason: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if option == "--plot":
        pytest.importorskip("matplotlib")
    assert reason in _refusal([option, str(tmp_path / name), str(session)], capsys, monkeypatch)


def test_interrupted_measurement_keeps_existing_outputs(
    session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from cloth_sim_ros.verify import accuracy

    particles = tmp_path / "particles.f32"
    particles.write_bytes(b"old")

    def interrupted(*_: object, particles: object, **__: object) -> None:
        particles.write(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(accuracy, "certify", interrupted)
    assert verify_main.main(["--accuracy", "--particles", str(particles), str(session)]) == 130
    assert particles.read_bytes() == b"old"
    assert len(list(tmp_path.iterdir())) == 2
