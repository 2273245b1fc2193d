# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Studies with a killed worker or an interrupt; `soak_studies.py` has more cases.

The cluster uses the documented commands over TCP.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

pytest.importorskip("distributed")
pytest.importorskip("pyarrow")
pytest.importorskip("mcap")
pytest.importorskip("rosbags")

from cloth_sim_ros.studies import study_file
from cloth_sim_ros.studies.folder import StudyFolder
from cloth_sim_ros.studies.study_estimate import sample_and_estimate
from cloth_sim_ros.studies.study_run import perform
from cloth_sim_ros.studies.study_runner import StudyRunner

STUDY = {
    "scene": "cloth_sim.yaml",
    "parameters": {"cloth.resolution": [5, 5], "tolerance": 1e-3, "gripper.radius": 0.3},
    "scripts": "grasp.yaml",
    "duration": 2.0,
    "runs": 4,
    "vary": {"material.density": {"uniform": [0.1, 0.3]}},
}
PROGRAM = "import sys; from cloth_sim_ros.studies.command import main; sys.exit(main())"


def test_runs_of_killed_worker_repeat_with_same_digests(tmp_path: Path) -> None:
    sys.path.insert(0, str(Path(__file__).parents[1]))
    try:
        from soak_studies import cluster
    finally:
        sys.path.pop(0)
    study = study_file.from_dict(STUDY, folder=tmp_path)
    samples, _ = sample_and_estimate(study, 1)
    undisturbed, killed_study = StudyFolder(tmp_path / "calm"), StudyFolder(tmp_path / "shot")
    for study_folder in (undisturbed, killed_study):
        study_folder.create(study, samples, "")
    expected = [perform(undisturbed, study, run, values)["digest"] for run, values in enumerate(samples)]
    finished: dict[int, dict] = {}
    runner = StudyRunner(killed_study, study, samples, 10.0, finished.__setitem__, on_message=lambda _text: None)
    with cluster(1, tmp_path) as dask:
        arguments = {"address": dask.address, "runs": range(4), "wait": 200.0}
        thread = threading.Thread(target=runner.run, kwargs=arguments, daemon=True)
        thread.start()
        killed = False
        while thread.is_alive():
            thread.join(0.1)
            if finished and not killed:
                dask.kill_worker(0)
                killed = True
            dask.tend()
    assert killed
    assert [finished[run]["digest"] for run in range(4)] == expected
    assert [row["run"] for row in killed_study.rows()] == [0, 1, 2, 3]


@pytest.mark.parametrize("signal_number", [signal.SIGINT, signal.SIGTERM], ids=["ctrl_c", "sigterm"])
def test_signal_stops_study_with_one_line(tmp_path: Path, signal_number: signal.Signals) -> None:
    (tmp_path / "slow.py").write_text("import time\n\ndef wait(seen):\n    time.sleep(0.02)\n")
    study = {**STUDY, "scripts": [], "policy": "slow.py:wait", "duration": 0.5, "runs": 100, "clouds": False}
    (tmp_path / "study.yaml").write_text(json.dumps(study))
    command = [sys.executable, "-c", PROGRAM, "study.yaml", "--out", "out", "--workers", "2"]
    command_process = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True, start_new_session=True)
    try:
        end = time.monotonic() + 60.0
        while not list(tmp_path.glob("out/rows/*/*.json")) and time.monotonic() < end:
            time.sleep(0.1)
        # A terminal sends Ctrl-C to the group, a supervisor SIGTERM to the process.
        (os.killpg if signal_number is signal.SIGINT else os.kill)(command_process.pid, signal_number)
        error = command_process.communicate(timeout=60.0)[1]
    finally:
        command_process.kill()
    assert command_process.returncode == 130
    assert "Traceback" not in error
    assert error.splitlines()[-1] == "cloth_batch: interrupted; finished runs are kept; continue with --resume"
    assert not list(tmp_path.rglob(".unfinished*"))
    assert (tmp_path / "out" / "index.parquet").is_file()
