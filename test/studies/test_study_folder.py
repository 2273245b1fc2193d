# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Damaged folders of studies: lost rows are repeated, other damage is reported."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import attrs
import pytest

pytest.importorskip("distributed")
pytest.importorskip("pyarrow")
pytest.importorskip("mcap")
pytest.importorskip("rosbags")

from cloth_sim_ros.scene import input_file
from cloth_sim_ros.studies import index
from cloth_sim_ros.studies.errors import StudyError
from cloth_sim_ros.studies.factors import Factor
from cloth_sim_ros.studies.folder import StudyFolder, read_row
from cloth_sim_ros.studies.main import main
from cloth_sim_ros.studies.sampling import sample
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


def test_interrupted_creation_starts_anew(study_folder: StudyFolder, capsys: pytest.CaptureFixture[str]) -> None:
    whole = index.read(study_folder).to_pydict()
    study_folder.study_file.unlink()
    assert resume(study_folder) == 2
    assert "study.json is missing; choose a new folder" in capsys.readouterr().err
    for name in ("runs", "rows"):
        shutil.rmtree(study_folder.path / name)
    study_folder.index_file.unlink()
    (study_folder.path / ".unfinished-samples.json-abc").write_text("[")
    assert resume(study_folder) == 0
    assert index.read(study_folder).to_pydict()["digest"] == whole["digest"]


def test_other_code_does_not_resume(study_folder: StudyFolder, capsys: pytest.CaptureFixture[str]) -> None:
    package = study_folder.path / "package.json"
    package.write_text(package.read_text().replace('"numerics": "', '"numerics": "9'))
    assert resume(study_folder) == 0
    study_folder.row_file(1).unlink()
    assert resume(study_folder) == 2
    assert "continue with the former version" in capsys.readouterr().err
    package.unlink()
    assert resume(study_folder) == 0


def test_killed_client_leaves_no_old_index(study_folder: StudyFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    study_folder.row_file(1).unlink()
    seen: list[bool] = []

    def stop(*_: object, **__: object) -> None:
        seen.append(study_folder.index_file.exists())
        # A worker finishes a run that the client does not notice.
        perform(study_folder, study_folder.read(), 1, study_folder.samples(study_folder.read())[1])
        raise KeyboardInterrupt

    monkeypatch.setattr("cloth_sim_ros.studies.study_session.StudyRunner.run", stop)
    assert resume(study_folder) == 130
    assert seen == [False]
    assert index.read(study_folder).to_pydict()["run"] == [0, 1]


def test_locked_study_keeps_its_failed_rows(study_folder: StudyFolder, capsys: pytest.CaptureFixture[str]) -> None:
    row = read_row(study_folder.row_file(1))
    assert row is not None
    study_folder.write_row({**row, "status": "failed", "error": "broken"})
    command = [str(study_folder.path.parent / "study.yaml"), "--out", str(study_folder.path), "--resume"]
    with study_folder.lock():
        assert main([*command, "--retry-failed"]) == 2
    assert "another cloth_batch works on" in capsys.readouterr().err
    assert study_folder.row_file(1).is_file()


def test_many_samples_are_read_back(study_folder: StudyFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cloth_sim_ros.session.plain_json.MAX_VALUES", 100)
    monkeypatch.setattr("cloth_sim_ros.session.plain_json._MAX_CONTAINERS", 50)
    monkeypatch.setattr("cloth_sim_ros.studies.folder._MAX_JSON", 1000)
    names, texts = Factor(name="cloth.anchors", kind="choices", values=(("a", "b,"), ("long " * 9,))), ["x" * 30, "[y,"]
    drag, mesh = Factor(name="air.drag", kind="uniform", values=(0.0, 1.0)), tuple(texts)
    factors = (names, drag, Factor(name="cloth.mesh", kind="choices", values=mesh))
    study = attrs.evolve(study_folder.read(), factors=factors, runs=400)
    samples = sample(factors, runs=400, seed=0, sampling="random")
    (study_folder.path / "samples.json").write_text(json.dumps([list(values) for values in samples]))
    assert study_folder.samples(study) == samples


def test_too_long_study_is_refused_before_its_runs(study_folder: StudyFolder, tmp_path: Path) -> None:
    factor = Factor(name="cloth.mesh", kind="choices", values=("x" * input_file.MAX_TEXT,))
    study = attrs.evolve(study_folder.read(), factors=(factor,))
    with pytest.raises(StudyError, match="at most 16777216 are possible: shorten them"):
        StudyFolder(tmp_path / "long").create(study, [(0.1,)] * 2, "")
    assert not (tmp_path / "long").exists()
