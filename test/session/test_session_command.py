# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`cloth_session`: output, files, and one-line errors."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from support import session_samples as samples

from cloth_sim_ros.session.main import main
from cloth_sim_ros.session.writer import SessionWriter

CONTENT = list(samples.samples(60))


@pytest.fixture
def session(tmp_path: Path) -> Path:
    return samples.write_session(tmp_path, CONTENT)


def test_info_summarizes_session(session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(session)]) == 0
    text = capsys.readouterr().out
    assert len(text.splitlines()) <= 40
    for said in (
        "state       complete",
        "40 particles, 38 triangles",
        "0 to 59 (60 records), 0.000 to 0.983 s simulated, 1.00 x real time",
        "target 20, grasp 3",
        "    0.167 s  grasp gripper=gripper closed=True",
        "6.0 a frame, 5 to 7",
        "leapfrog (fixed step) x 30",
        "/cloth_sim/gripper/wrench",
    ):
        assert said in text


def test_info_summarizes_several_sessions_in_turn(
    session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # The order of `sessions/*.mcap` after a second recording.
    second_session = samples.write_session(tmp_path, CONTENT[:90], stem="other")
    assert main(["info", str(session), str(second_session)]) == 0
    text = capsys.readouterr().out
    assert [line for line in text.splitlines() if line.endswith(".mcap")] == [session.name, second_session.name]
    assert text.count("state       complete") == 2
    assert main(["info", "--json", str(session), str(second_session)]) == 0
    assert [content["complete"] for content in json.loads(capsys.readouterr().out)] == [True, True]
    second_session.write_bytes(second_session.read_bytes()[:-1000])
    assert main(["info", str(session), str(second_session)]) == 1
    assert main(["export", str(session), str(second_session)]) == 2
    assert "give the files of one session at a time" in capsys.readouterr().err


def test_info_prints_json(session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", "--json", str(session)]) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["complete"] is True
    assert content["frames"] == [0, 59]
    assert content["events"] == {"target": 20, "grasp": 3}
    assert content["topics"][samples.POINTS]["count"] == 60
    assert content["topics"][samples.POINTS]["lost"] == 0
    assert content["steps"]["min"] == content["steps"]["least"]
    assert content["steps"]["max"] == content["steps"]["most"]


def test_info_of_cut_file_reports_it_and_fails(session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    session.write_bytes(session.read_bytes()[:-9000])
    assert main(["info", str(session)]) == 1
    assert "cut off" in capsys.readouterr().out


def test_info_counts_what_was_dropped(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    writer = SessionWriter(tmp_path, snapshot=samples.SNAPSHOT, stem="s", log_time=0)
    writer.declare("/a", "std_msgs/msg/String")
    for sequence in (0, 1, 5, 6, 9):
        writer.add("/a", b"", log_time=sequence, publish_time=sequence, sequence=sequence)
    writer.finish(reason="stopped", notes={"dropped": "5"})
    assert main(["info", str(writer.path)]) == 1
    text = capsys.readouterr().out
    assert "5 clouds were dropped" in text
    assert text.splitlines()[-1].split() == ["/a", "std_msgs/String", "5", "0.00", "5"]


def test_recover_makes_a_complete_file(session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = session.read_bytes()
    session.write_bytes(data[:-9000])
    assert main(["recover", str(session)]) == 0
    assert "cut off" in capsys.readouterr().out
    mended = session.with_name("session_000_recovered.mcap")
    assert main(["info", str(mended)]) == 1
    assert "recovered, the recording was cut off" in capsys.readouterr().out
    assert session.read_bytes() == data[:-9000]


def test_export_npz(session: Path) -> None:
    target = session.with_suffix(".npz")
    assert main(["export", str(session)]) == 0
    with np.load(target) as content:
        assert content["positions"].shape == (60, 40, 3)
        assert content["positions"].dtype == np.float32
        for frame in (0, 17, 59):
            assert np.array_equal(content["positions"][frame], samples.positions(frame, 40))
        assert content["frame"].tolist() == list(range(60))
        assert content["time"].tolist() == [frame / 60 for frame in range(60)]
        assert content["log_time"][1] == samples.START + samples.PERIOD
        assert content["triangles"].shape == (38, 3)
        assert content["rest_positions"].shape == (40, 3)
    assert main(["export", str(session), "-o", str(target)]) == 2


def test_export_takes_every_nth_of_a_span(session: Path, tmp_path: Path) -> None:
    target = tmp_path / "some.npz"
    assert main(["export", str(session), "-o", str(target), "--every", "4", "--start", "0.25", "--end", "0.5"]) == 0
    with np.load(target) as content:
        assert content["frame"].tolist() == [15, 19, 23, 27]


@pytest.mark.parametrize(("every", "said"), [("60", ": 1 frame, "), ("30", ": 2 frames, ")])
def test_export_prints_counts_with_plurals(
    session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], every: str, said: str
) -> None:
    assert main(["export", str(session), "-o", str(tmp_path / "out.npz"), "--every", every]) == 0
    assert said in capsys.readouterr().out


def test_export_parquet(session: Path, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    target = tmp_path / "out.parquet"
    assert main(["export", str(session), "-o", str(target)]) == 0
    table = parquet.read_table(target).to_pydict()
    assert table["particle"] == list(range(40)) * 60
    assert table["frame"][40 * 7] == 7
    assert table["time"][40 * 7] == 7 / 60
    got = np.array([table[axis] for axis in "xyz"], np.float32).T[40 * 7 : 40 * 8]
    assert np.array_equal(got, samples.positions(7, 40))


def test_parts_of_a_session_are_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for index in range(3):
        writer = SessionWriter(tmp_path, snapshot=samples.SNAPSHOT, stem="s", part=index, log_time=0)
        for item in CONTENT:
            if item.topic == samples.FRAME:
                if not writer.is_declared(item.topic):
                    writer.declare(item.topic, item.type_name)
                writer.add(item.topic, item.data, log_time=item.log_time, publish_time=item.log_time, sequence=0)
        writer.finish(reason="split" if index < 2 else "stopped", notes={"dropped": "0"})
    samples.write_session(tmp_path, [], stem="other")
    assert main(["info", "--all-parts", str(tmp_path / "s_001.mcap")]) == 0
    assert "(180 records)" in capsys.readouterr().out


@pytest.mark.parametrize("command", ["info", "recover", "export"])
def test_foreign_file_gets_one_line(
    command: str, session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = tmp_path / "text.mcap"
    text.write_text("hello")
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(session.read_bytes()[:3000])
    for path, said in [
        (tmp_path / "absent.mcap", "does not exist"),
        (tmp_path, "is a folder"),
        (text, "is not an MCAP file"),
        (broken, "lacks its"),
    ]:
        assert main([command, str(path)]) == 2
        captured = capsys.readouterr()
        assert captured.out == ""
        assert captured.err.count("\n") == 1
        assert captured.err.startswith("cloth_session: ")
        assert said in captured.err


def test_wrong_arguments_get_one_line(session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, said in [
        (["export", str(session), "-o", str(tmp_path / "out.csv")], "must end in .npz or .parquet"),
        (["export", str(session), "--every", "0"], "every 0th"),
        (["export", str(session), "--start", "100"], "no clouds in that span"),
        (["export", str(session), "-o", str(tmp_path / "absent" / "out.npz")], "there is no folder"),
        (["recover", str(session)], "nothing to recover"),
    ]:
        assert main(arguments) == 2
        captured = capsys.readouterr()
        assert said in captured.err
        assert captured.err.count("\n") == 1
    assert not list(tmp_path.glob(".*"))
    with pytest.raises(SystemExit, match="2"):
        main([])
