# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Studies of a scene with uncertain parameters: outcomes, sessions, failures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("distributed")
pytest.importorskip("pyarrow")
pytest.importorskip("mcap")
pytest.importorskip("rosbags")

from cloth_sim_ros.session.reader import SessionReader
from cloth_sim_ros.simulation.ensemble import Ensemble
from cloth_sim_ros.studies import study_file
from cloth_sim_ros.studies.errors import StudyError
from cloth_sim_ros.studies.folder import StudyFolder
from cloth_sim_ros.studies.main import main
from cloth_sim_ros.studies.study import Study
from cloth_sim_ros.studies.study_estimate import sample_and_estimate
from cloth_sim_ros.studies.study_run import perform
from cloth_sim_ros.verify.run import verify

FRAMES = 12


def study_of(folder: Path, deviation: float = 0.3, **entries: Any) -> Study:
    (folder / "distribution.yaml").write_text(f"parameters: [{{name: wind.normal_drag, deviation: {deviation}}}]")
    content = {
        "scene": "flag.yaml",
        "parameters": {"ensemble.file": "distribution.yaml", "cloth.resolution": [5, 6]},
        "duration": FRAMES / 60.0,
        "runs": 2,
        "vary": {"material.density": {"uniform": [0.1, 0.3]}},
        **entries,
    }
    return study_file.from_dict(content, folder=folder)


def messages_of(path: Path) -> list[tuple[str, bytes]]:
    with SessionReader([path]) as reader:
        return [(message.topic, message.data) for message in reader.messages()]


def test_runs_have_outcomes_of_the_ensemble(tmp_path: Path) -> None:
    study, folder = study_of(tmp_path), StudyFolder(tmp_path / "out")
    samples, _ = sample_and_estimate(study, 1)
    folder.create(study, samples, "")
    row = perform(folder, study, 1, samples[1])
    assert row["status"] == "ok", row["error"]
    scene = study.scene({"material.density": samples[1][0]})
    with Ensemble(scene, scene.distribution(), threads=1) as ensemble:
        for _ in range(FRAMES):
            frame = ensemble.advance()
    assert row["outcomes"]["deviation"] == frame.largest > 1e-4
    assert row["outcomes"]["deviation_rms"] == frame.root_mean_square
    verdict = verify([folder.path / row["session"]])
    assert verdict.same, verdict.first_reason
    assert verdict.compared["ensemble cloud"] == FRAMES


def test_mcap_export_has_clouds_of_the_ensemble(tmp_path: Path) -> None:
    study, folder = study_of(tmp_path, clouds=False), StudyFolder(tmp_path / "out")
    samples, _ = sample_and_estimate(study, 1)
    folder.create(study, samples, "")
    perform(folder, study, 1, samples[1])
    (tmp_path / "distribution.yaml").unlink()
    assert main(["export", str(folder.path), "--mcap", str(tmp_path / "sessions")]) == 0
    (copy,) = (tmp_path / "sessions").glob("*.mcap")
    verdict = verify([copy])
    assert verdict.same, verdict.first_reason
    assert verdict.compared["ensemble cloud"] == FRAMES
    # As if the run had recorded its clouds.
    recorded = tmp_path / "recorded"
    recorded.mkdir()
    with_clouds = StudyFolder(recorded / "out")
    (tmp_path / "distribution.yaml").write_text("parameters: [{name: wind.normal_drag, deviation: 0.3}]")
    with_clouds.create(study_of(tmp_path, clouds=True), samples, "")
    row = perform(with_clouds, study_of(tmp_path, clouds=True), 1, samples[1])
    assert messages_of(copy) == messages_of(with_clouds.path / row["session"])


def test_failing_member_fails_its_run(tmp_path: Path) -> None:
    (tmp_path / "policy.py").write_text(
        "from cloth_sim_ros import SetParameters\n"
        "def policy(seen):\n"
        "    return SetParameters({'wind.normal_drag': 900.0 if seen.frame == 3 else 1.0})\n"
    )
    study, folder = study_of(tmp_path, policy="policy.py:policy"), StudyFolder(tmp_path / "out")
    samples, _ = sample_and_estimate(study, 1)
    folder.create(study, samples, "")
    row = perform(folder, study, 0, samples[0])
    assert row["status"] == "failed"
    assert row["error"].startswith("frame 4: member 0 of the ensemble (wind.normal_drag = 1.34986)")


def test_unfit_distribution_is_refused(tmp_path: Path) -> None:
    with pytest.raises((StudyError, ValueError), match=r"the deviation of wind\.normal_drag is 7"):
        study_of(tmp_path, deviation=7.0)
