# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Refused outputs of `cloth_fit`: input files, wrong endings and pipes."""

from __future__ import annotations

import json
import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from cloth_sim_ros import Scene
from cloth_sim_ros.fit import bag as fit_bag
from cloth_sim_ros.fit import files as fit_files
from cloth_sim_ros.fit import main as fit_main
from cloth_sim_ros.fit import motions_text
from cloth_sim_ros.fit.files import write_parameters
from cloth_sim_ros.fit.parameters import FitError

pytest.importorskip("mcap")

SESSION = b"\x89MCAP0\r\n and the rest"


@pytest.mark.parametrize("option", ["--json", "--write", "--plot"])
def test_input_file_as_output_is_refused(
    tmp_path: Path, option: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    if option == "--plot":
        pytest.importorskip("matplotlib")
    monkeypatch.setattr(fit_main, "_fit", lambda _: pytest.fail("a session was read"))
    session, link, scene, second_session = (tmp_path / name for name in ("s.mcap", "link.png", "scene.png", "o.mcap"))
    session.write_bytes(SESSION)
    second_session.write_bytes(SESSION)
    link.symlink_to(session)
    scene.write_text("/**: {ros__parameters: {}}")
    for out in (session, link, scene, second_session):
        was = out.read_bytes()
        arguments = [str(session), "--scene", str(scene), "--parameters", "stretch", option, str(out)]
        assert fit_main.main(arguments) == fit_main.REFUSED
        assert capsys.readouterr().err.startswith(f"cloth_fit: {option} is '{out}', ")
        assert out.read_bytes() == was


@pytest.mark.parametrize("out", ["left.csv", "bag_left.csv", "bag/bag_0.db3", "bag/metadata.yaml"])
def test_poses_and_files_of_a_bag_are_no_outputs(
    tmp_path: Path, out: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fit_main, "_fit", lambda _: pytest.fail("the fit began"))
    (tmp_path / "bag").mkdir()
    for name in ("left.csv", "bag_left.csv", "bag/bag_0.db3", "bag/metadata.yaml"):
        (tmp_path / name).write_text("x")
    poses = ["--pose", f"left={tmp_path}/left.csv", "--pose", "right={}_left.csv"]
    arguments = [str(tmp_path / "bag"), "--parameters", "stretch", *poses, "--write", str(tmp_path / out)]
    assert fit_main.main(arguments) == fit_main.REFUSED
    assert capsys.readouterr().err.startswith(f"cloth_fit: --write is '{tmp_path / out}', ")


def test_plot_without_png_ending_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib")
    arguments = [str(tmp_path / "s.mcap"), "--parameters", "stretch", "--plot", str(tmp_path / "x.xyz")]
    assert fit_main.main(arguments) == fit_main.REFUSED
    assert "end the name in .png" in capsys.readouterr().err


def test_pipe_among_recordings_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    first, pipe, scene = tmp_path / "a.mcap", tmp_path / "b.mcap", tmp_path / "scene.yaml"
    scene.write_text("/**: {ros__parameters: {}}")
    os.mkfifo(pipe)
    monkeypatch.setattr(fit_bag, "is_session", lambda _: False)
    monkeypatch.setattr(fit_bag, "read_bag", lambda *_, **__: pytest.fail("a pipe was opened"))
    arguments = [str(first), str(pipe), "--scene", str(scene), "--parameters", "stretch"]
    assert fit_main.main(arguments) == fit_main.REFUSED
    assert "b.mcap is a device or a pipe" in capsys.readouterr().err


def test_files_absent_beside_the_written_scene_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "there.obj").write_text("x")
    scene = SimpleNamespace(files={"hung.npz": b"", "there.obj": b""})
    monkeypatch.setattr(fit_files, "write_parameters", lambda *_: ["material.damping"])
    monkeypatch.setattr(motions_text, "describe_motions", lambda _: "")
    monkeypatch.setattr(fit_main, "_fit", lambda _: SimpleNamespace(scene=scene, all_identified=True))
    out = tmp_path / "fitted.yaml"
    assert fit_main.main([str(tmp_path / "s.mcap"), "--parameters", "damping", "--write", str(out)]) == 0
    text = capsys.readouterr().out
    assert "It names hung.npz, absent from its folder: copy each there (the session has it as attachment" in text


def test_name_that_is_not_utf_8_is_escaped_in_scene(tmp_path: Path) -> None:
    scene = Scene.from_parameters({})
    fit: Any = SimpleNamespace(scene=scene, name=os.fsdecode(b"d\xe9.csv"), estimates=[], doubt="")
    assert write_parameters(fit, tmp_path / "out.yaml") == []
    assert "# The scene of d\\udce9.csv with" in (tmp_path / "out.yaml").read_text(encoding="utf-8")


@pytest.mark.parametrize("out", ["towel.obj", "cloth.yaml", "ball.obj", "arm.urdf", "meshes/hand.stl"])
def test_files_that_the_scene_names_are_no_outputs(
    tmp_path: Path, out: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fit_main, "_fit", lambda _: pytest.fail("the fit began"))
    (tmp_path / "meshes").mkdir()
    for name in ("towel.obj", "cloth.yaml", "ball.obj", "meshes/hand.stl"):
        (tmp_path / name).write_text("x")
    mesh = '<collision><geometry><mesh filename="{}"/></geometry></collision>'
    shapes = mesh.format("meshes/hand.stl") + mesh.format("package://absent/arm.stl")
    (tmp_path / "arm.urdf").write_text(f'<robot name="r"><link name="hand">{shapes}</link></robot>')
    names = {"cloth": {"mesh": "towel.obj"}, "material": {"fabric": "./cloth.yaml"}, "ball": {"mesh": "ball.obj"}}
    robot = {"robot": {"enabled": True, "description_file": "arm.urdf"}}
    (tmp_path / "scene.yaml").write_text(json.dumps({"/**": {"ros__parameters": {**names, **robot}}}))
    arguments = ["s.mcap", "--scene", str(tmp_path / "scene.yaml"), "--parameters", "stretch"]
    assert fit_main.main([*arguments, "--write", str(tmp_path / out)]) == fit_main.REFUSED
    assert capsys.readouterr().err.startswith(f"cloth_fit: --write is '{tmp_path / out}', which is read")


@pytest.mark.parametrize(
    ("recording", "option", "reason"),
    [
        (
            "swing.csv",
            ["--topic", "/points"],
            "--topic is for bags, and swing.csv is a table; name its columns by --columns",
        ),
        (
            "swing.npz",
            ["--index", "id"],
            "--index is for bags, and swing.npz is a table; name its columns by --columns",
        ),
        (
            "swing.db3",
            ["--columns", "x=X"],
            "--columns is for tables, and swing.db3 is a bag; name its fields by --topic",
        ),
    ],
)
def test_option_of_another_kind_of_recording_is_refused(
    recording: str,
    option: list[str],
    reason: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(fit_bag, "read_recording", lambda *_, **__: pytest.fail("a recording was read"))
    monkeypatch.chdir(tmp_path)
    Path(recording).write_text("x")
    Path("scene.yaml").write_text("/**: {ros__parameters: {}}")
    arguments = [recording, "--scene", "scene.yaml", "--parameters", "stretch", *option]
    assert fit_main.main(arguments) == fit_main.REFUSED
    assert capsys.readouterr().err.startswith(f"cloth_fit: {reason}")


def test_recording_given_twice_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fit_bag, "read_recording", lambda *_, **__: pytest.fail("a recording was read"))
    monkeypatch.chdir(tmp_path)
    Path("swing.csv").write_text("x")
    Path("link.csv").symlink_to("swing.csv")
    Path("scene.yaml").write_text("/**: {ros__parameters: {}}")
    arguments = ["--scene", "scene.yaml", "--parameters", "stretch"]
    assert fit_main.main(["swing.csv", "link.csv", *arguments]) == fit_main.REFUSED
    reason = "'link.csv' is the recording 'swing.csv'; give each recording once"
    assert capsys.readouterr().err == f"cloth_fit: {reason}\n"


def test_several_folders_of_bags_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = list[str]()

    def read(paths: list[Path], *_: Any, **__: Any) -> None:
        names.extend(path.name for path in paths)
        if len(names) == 2:
            raise FitError("both were read")

    part = SimpleNamespace(since=lambda _: part, part=lambda **_: part)
    monkeypatch.setattr(fit_bag, "read_recording", lambda *values, **options: read(*values, **options) or part)
    folders = [tmp_path / name for name in ("first", "second")]
    for folder in folders:
        folder.mkdir()
        (folder / "bag_0.mcap").write_bytes(b"")
    (tmp_path / "scene.yaml").write_text("/**: {ros__parameters: {}}")
    arguments = [*map(str, folders), "--scene", str(tmp_path / "scene.yaml"), "--parameters", "stretch"]
    assert fit_main.main(arguments) == fit_main.REFUSED
    assert names == ["first", "second"]


@pytest.mark.parametrize("option", ["--pose", "--held", "--offset", "--start"])
def test_name_given_twice_is_refused(
    option: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fit_bag, "read_recording", lambda *_, **__: pytest.fail("a recording was read"))
    monkeypatch.chdir(tmp_path)
    Path("swing.csv").write_text("x")
    Path("scene.yaml").write_text("/**: {ros__parameters: {}}")
    pairs = [option, "left=1.0", option, "left=2.0"]
    arguments = ["swing.csv", "--scene", "scene.yaml", "--parameters", "stretch", *pairs]
    assert fit_main.main(arguments) == fit_main.REFUSED
    reason = f"{option} names 'left' twice, as '1.0' and as '2.0'; give it once"
    assert capsys.readouterr().err.startswith(f"cloth_fit: {reason}")
