# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`cloth_replay` with sessions that an outsider changed, with full disks, and with closed viewers."""

from __future__ import annotations

import io
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.falsifier import FRAME, POINTS, Falsification, alter_messages, edit, falsify
from support.rrd import rows
from support.session_maker import make_grasp

from cloth_sim_ros.replay import show
from cloth_sim_ros.replay.colours import strain_colours
from cloth_sim_ros.replay.main import main
from cloth_sim_ros.replay.obstacle_view import ObstacleView
from cloth_sim_ros.replay.opening import read_opening
from cloth_sim_ros.replay.rows import Moment, Rows
from cloth_sim_ros.session.cdr import decode_string, encode, encode_string, message_class
from cloth_sim_ros.session.child_process import child_environment
from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.part import Message, SessionPart
from cloth_sim_ros.verify.markers import _marker  # private: a marker as the node writes it, to change fields of

pytest.importorskip("rerun", reason="the viewer is not installed: pip install 'cloth_sim_ros[replay]'")

#: Runs the command with a limit of the size of its files, and a space that it needs at the beginning [bytes].
_LIMITED = """
import resource, sys
from cloth_sim_ros.replay import show
from cloth_sim_ros.replay.main import main
limit, show._MIN_SPACE = map(int, sys.argv[1:3])
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
sys.exit(main(sys.argv[3:]))
"""


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_grasp(tmp_path_factory.mktemp("session"), seconds=0.5, cloth__resolution=[5, 6])


@pytest.mark.parametrize("missing_bytes", [None, 2000])
def test_full_disk_ends_a_recording_with_an_error(session: Path, tmp_path: Path, missing_bytes: int | None) -> None:
    out, limit, space = tmp_path / "out.rrd", 8192, 1 << 20
    if missing_bytes is not None:
        assert main([str(session), "--save", str(out)]) == 0
        # The space for the beginning is larger than this file.
        limit, space = out.stat().st_size - missing_bytes, 1
    options = [str(limit), str(space), str(session), "--save", str(out)]
    before = out.read_bytes() if out.exists() else None
    done = subprocess.run(
        [sys.executable, "-c", _LIMITED, *options],
        capture_output=True,
        text=True,
        check=False,
        timeout=100.0,
        env=child_environment(),
    )
    assert done.returncode == 1
    assert f"cloth_replay: {out}" in done.stderr
    assert (out.read_bytes() if out.exists() else None) == before
    assert [path.name for path in tmp_path.iterdir()] == ["out.rrd"] * out.exists()


def test_device_that_is_full_is_an_error(session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(session), "--save", "/dev/full"]) == 1
    assert "cloth_replay: /dev/full" in capsys.readouterr().err


@pytest.mark.parametrize(("status", "text"), [(0, "the viewer was closed"), (None, "the viewer does not answer")])
def test_closed_viewer_is_an_error(
    session: Path,
    status: int | None,
    text: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def connect(*_: object, **_options: object) -> None:
        raise RuntimeError("it is gone")

    viewer = SimpleNamespace(address="", process=SimpleNamespace(poll=lambda: status))
    monkeypatch.setattr(show, "check_screen", lambda _remedy: None)
    monkeypatch.setattr(show, "open_window", lambda: viewer)
    monkeypatch.setattr(show, "_recording", lambda _reader: SimpleNamespace(connect_grpc=connect))
    assert main([str(session)]) == 1
    assert text in capsys.readouterr().err


@pytest.mark.parametrize("clouds", [True, False])
def test_rows_in_memory_are_bounded_without_clouds(
    session: Path, tmp_path: Path, clouds: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    largest = 0
    add = Rows.add

    def watched(table: Rows, *arguments: Any, **components: Any) -> None:
        nonlocal largest
        add(table, *arguments, **components)
        largest = max(largest, len(table))

    monkeypatch.setattr(Rows, "add", watched)
    monkeypatch.setattr("cloth_sim_ros.replay.stream._MAX_ROWS", 8)
    if not clouds:
        session = falsify(session, tmp_path / "s.mcap", Falsification(alter_messages(POINTS, lambda _message: None)))
    assert main([str(session), "--save", str(tmp_path / "out.rrd"), "--every", "1000"]) == 0
    assert largest <= 9


def test_picture_before_the_first_cloud_shows_it(
    session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    times = []
    monkeypatch.setattr(show, "save_screenshot", lambda _rrd, _picture, at, size: times.append(at))
    for at in (0.0, 0.25):
        show.save_picture([session], tmp_path / "out.png", at=at)
    assert times == [pytest.approx(1.0 / 60.0), 0.25]


@pytest.mark.parametrize("value", [np.nan, 1e30])
def test_diverged_cloth_is_drawn(session: Path, tmp_path: Path, value: float, recwarn: pytest.WarningsRecorder) -> None:
    def diverge(content: Any) -> None:
        numbers = np.random.default_rng(1).normal(size=len(content.data) // 4) * value
        content.data = np.frombuffer(numbers.astype(np.float32).tobytes(), np.uint8)

    changed = falsify(session, tmp_path / "s.mcap", Falsification(alter_messages(POINTS, edit(diverge))))
    assert main([str(changed), "--save", str(tmp_path / "out.rrd")]) == 0
    assert len(rows(tmp_path / "out.rrd", "/world/cloth", "Mesh3D:vertex_positions")[0]) == 30
    assert not [warning for warning in recwarn if issubclass(warning.category, RuntimeWarning)]


def test_colour_of_nan_is_the_last_colour() -> None:
    colour = np.zeros(4, np.uint32)
    strain_colours(np.array([-1.0, 0.0, 5.0, np.nan], np.float32), 1.0, colour)
    assert colour[0] == colour[1] != colour[2] == colour[3]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('"events":[', '"events":[{"kind":"set_parameters","values":{"cloth.anchors":[5]}},'),
        ('"orientation":[0.0,0.0,0.0,1.0]', '"orientation":[0,0,0,0]'),
        ('"time":0.', '"time":1e300,"_":0.'),
    ],
)
def test_invalid_frame_record_is_refused(session: Path, tmp_path: Path, old: str, new: str) -> None:
    def alter(message: Message) -> Message:
        text = decode_string(message.data)
        assert old in text
        text = text.replace(old, new, 1)
        if '"_":0.' in text:
            start = text.index(',"_":0.')
            text = text[:start] + text[text.index(",", start + 1) :]
        return message._replace(data=encode_string(text))

    changed = falsify(session, tmp_path / "s.mcap", Falsification(alter_messages(FRAME, alter, only=[0])))
    assert main([str(changed), "--save", str(tmp_path / "out.rrd")]) == 2


@pytest.mark.parametrize(
    "arrays",
    [
        {"memory.grip.starts": np.array([0, 1]), "memory.grip.particles": np.array([10**6])},
        {"memory.grip.starts": np.array([0, 1]), "memory.grip.particles": np.array([-1])},
        {"memory.gripper.pose": np.zeros((1, 3)), "memory.gripper.placed": np.array([True])},
        {"memory.gripper.target": np.zeros(1)},
        {"position": np.zeros(90)},
        {"position": np.zeros((2, 30))},
    ],
)
def test_state_of_wrong_shape_is_refused(session: Path, arrays: dict[str, np.ndarray[Any, Any]]) -> None:
    part = SessionPart(session)
    with np.load(io.BytesIO(part.state)) as stored:
        content = dict(stored)
    buffer = io.BytesIO()
    np.savez(buffer, **(content | arrays))
    read_opening(part.scene_yaml, part.state)
    with pytest.raises(SessionError, match=r"not one that cloth_sim wrote"):
        read_opening(part.scene_yaml, buffer.getvalue())
    part.close()


@pytest.mark.parametrize("n_points", [0, 2, 4])
def test_incomplete_triangles_of_a_marker_are_left_out(n_points: int, recwarn: pytest.WarningsRecorder) -> None:
    import rerun as rr

    tables: dict[str, Rows] = {}

    def table(path: str, archetype: Any, *, ragged: tuple[str, ...] = ()) -> Rows:
        return tables.setdefault(f"{path} {archetype.__name__}", Rows(path, archetype, ragged=ragged))

    recording = rr.RecordingStream("test")
    recording.memory_recording()
    marker = _marker(
        ns="/cloth_sim/net", id=0, action=0, type=11, scale=(1.0, 1.0, 1.0), points=[(0.0, 0.0, 1.0)] * n_points
    )
    marker.color.r, marker.color.g = float("nan"), 300.0
    kind = "visualization_msgs/msg/MarkerArray"
    ObstacleView(recording, table).show(Moment(0.0, 0, 0), encode(message_class(kind)(markers=[marker]), kind))
    # private: rows that are not sent yet
    (corners,) = tables["/world/obstacles/net/0 Mesh3D"]._values["vertex_positions"]
    assert corners.shape == (n_points // 3 * 3, 3)
    assert not [warning for warning in recwarn if issubclass(warning.category, RuntimeWarning)]


@pytest.mark.parametrize("options", [["--size", "800x600"], ["--accuracy", "--strain-limit", "5"]])
def test_options_without_effect_are_refused(session: Path, tmp_path: Path, options: list[str]) -> None:
    with pytest.raises(SystemExit) as error:
        main([str(session), "--save", str(tmp_path / "out.rrd"), *options])
    assert error.value.code == 2
