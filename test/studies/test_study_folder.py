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

from cloth_sim_ros.studies import index
from cloth_sim_ros.studies.folder import StudyFolder, read_row
from cloth_sim_ros.studies.main import main
from cloth_sim_ros.studies.study_run import perform

STUDY = {
    "scene": "cloth_sim.yaml",
    "parameters": {"cloth.resolution": [4, 4], "tolerance": 1e-3},
    "scripts": "grasp.yaml",
    "duration": 0.1,
    "runs": 2,
    "vary": {"material.density": {"uniform": [0.1, 0.3]}},
}


@pytest.fixture
def study_folder(tmp_path: Path) -> StudyFolder:
    """A finished study of two runs."""
    from cloth_sim_ros.studies import study_file
    from cloth_sim_ros.studies.study_estimate import sample_and_estimate

    (tmp_path / "study.yaml").write_text(json.dumps(STUDY))
    study = study_file.read(tmp_path / "study.yaml")
    folder, samples = StudyFolder(tmp_path / "out"), sample_and_estimate(study, 1)[0]
    folder.create(study, samples, "")
    index.write(folder, [perform(folder, study, run, values) for run, values in enumerate(samples)])
    return folder


def resume(study_folder: StudyFolder) -> int:
    return main(
        [str(study_folder.path.parent / "study.yaml"), "--out", str(study_folder.path), "--resume", "--workers", "1"]
    )


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
    study_folder: StudyFolder, capsys: pytest.CaptureFixture[str], name: str, text: str | None, words: str
) -> None:
    if text is None:
        (study_folder.path / name).unlink()
    else:
        (study_folder.path / name).write_text(text)
    assert resume(study_folder) == 2
    error = capsys.readouterr().err
    assert words in error
    assert "start in another folder" in error


@pytest.mark.parametrize("text", ['{"run": 1}', '{"run": "x"}', "[]", "", None])
def test_incomplete_row_is_ignored(study_folder: StudyFolder, text: str | None) -> None:
    row, path = read_row(study_folder.row_file(0)), study_folder.row_file(1)
    assert row is not None
    # None stands for another run's row under this run's name.
    path.write_text(json.dumps(row) if text is None else text)
    assert read_row(path) is None
    assert [row["run"] for row in study_folder.rows()] == [0]


def test_run_with_damaged_row_is_repeated(study_folder: StudyFolder, capsys: pytest.CaptureFixture[str]) -> None:
    whole = index.read(study_folder).to_pydict()
    study_folder.row_file(1).write_text('{"run": 1}')
    assert resume(study_folder) == 0
    assert "2 of 2 runs were successful; 1 took" in capsys.readouterr().out
    assert index.read(study_folder).to_pydict()["digest"] == whole["digest"]


def test_damaged_index_is_refused_and_rebuilt_from_rows(
    study_folder: StudyFolder, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = index.read(study_folder).to_pydict()
    study_folder.index_file.write_bytes(study_folder.index_file.read_bytes()[:100])
    assert main(["view", str(study_folder.path)]) == 2
    assert "Remove it: it is rebuilt from the rows" in capsys.readouterr().err
    study_folder.index_file.unlink()
    assert index.read(study_folder).to_pydict() == whole
