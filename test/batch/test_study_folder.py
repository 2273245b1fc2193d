# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Damaged folders of studies: lost rows are repeated, other damage is reported."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

pytest.importorskip("distributed")
pytest.importorskip("pyarrow")
pytest.importorskip("mcap")
pytest.importorskip("rosbags")

from cloth_sim_ros.batch import index
from cloth_sim_ros.batch.folder import StudyFolder, read_row
from cloth_sim_ros.batch.main import main
from cloth_sim_ros.batch.study_run import perform

STUDY = {
    "scene": "cloth_sim.yaml",
    "parameters": {"cloth.resolution": [4, 4], "tolerance": 1e-3},
    "scripts": "grasp.yaml",
    "duration": 0.1,
    "runs": 2,
    "vary": {"material.density": {"uniform": [0.1, 0.3]}},
}


@pytest.fixture
def place(tmp_path: Path) -> StudyFolder:
    """A finished study of two runs."""
    from cloth_sim_ros.batch import study_file
    from cloth_sim_ros.batch.forecast import draw

    (tmp_path / "study.yaml").write_text(json.dumps(STUDY))
    study = study_file.read(tmp_path / "study.yaml")
    place, samples = StudyFolder(tmp_path / "out"), draw(study, 1)[0]
    place.create(study, samples, "")
    index.write(place, [perform(place, study, run, values) for run, values in enumerate(samples)])
    return place


def resume(place: StudyFolder) -> int:
    return main([str(place.path.parent / "study.yaml"), "--out", str(place.path), "--resume", "--workers", "1"])


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("study.json", "{", "study.json can't be read: Expecting property name"),
        ("study.json", "[]", "study.json holds '[]'"),
        ("samples.json", "[[", "samples.json can't be read"),
        ("samples.json", "[[0.1]]", "samples.json does not hold the values of 2 runs"),
        ("samples.json", "[[0.1], [0.1, 0.2]]", "samples.json does not hold the values of 2 runs"),
        ("samples.json", None, "samples.json can't be read: [Errno 2]"),
    ],
)
def test_unreadable_study_is_refused(
    place: StudyFolder, capsys: pytest.CaptureFixture[str], name: str, text: str | None, words: str
) -> None:
    if text is None:
        (place.path / name).unlink()
    else:
        (place.path / name).write_text(text)
    assert resume(place) == 2
    told = capsys.readouterr().err
    assert words in told
    assert "start in another folder" in told


@pytest.mark.parametrize("text", ['{"run": 1}', '{"run": "x"}', "[]", "", None])
def test_incomplete_row_is_ignored(place: StudyFolder, text: str | None) -> None:
    row, path = read_row(place.row_file(0)), place.row_file(1)
    assert row is not None
    # None stands for another run's row under this run's name.
    path.write_text(json.dumps(row) if text is None else text)
    assert read_row(path) is None
    assert [row["run"] for row in place.rows()] == [0]


def test_run_with_damaged_row_is_repeated(place: StudyFolder, capsys: pytest.CaptureFixture[str]) -> None:
    whole = index.read(place).to_pydict()
    place.row_file(1).write_text('{"run": 1}')
    assert resume(place) == 0
    assert "2 of 2 runs were successful; 1 took" in capsys.readouterr().out
    assert index.read(place).to_pydict()["digest"] == whole["digest"]


def test_damaged_index_is_refused_and_rebuilt_from_rows(place: StudyFolder, capsys: pytest.CaptureFixture[str]) -> None:
    whole = index.read(place).to_pydict()
    place.index.write_bytes(place.index.read_bytes()[:100])
    assert main(["view", str(place.path)]) == 2
    assert "Remove it: it is rebuilt from the rows" in capsys.readouterr().err
    place.index.unlink()
    assert index.read(place).to_pydict() == whole
