# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Commands and the processes that they start import nothing from the working directory."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

pytest.importorskip("distributed")
pytest.importorskip("mcap")

from cloth_sim_ros.session.child_process import child_environment, module_command

#: Modules that Python or the package may import by name; each records its import.
NAMES = sorted(
    {name for name in sys.stdlib_module_names if not name.startswith("_")}
    | {"sitecustomize", "usercustomize", "cloth_sim_ros", "numpy", "scipy", "attr", "attrs", "yaml", "mcap", "xxhash"}
    | {"loky", "cloudpickle", "dask", "distributed", "msgpack", "tornado", "psutil", "cryptography", "bokeh", "rerun"}
    | {"rosbags", "lz4", "zstandard", "pyarrow", "tqdm", "rclpy", "trimesh", "matplotlib", "toolz", "click"}
)
STUDY = {
    "scene": "cloth_sim.yaml",
    "parameters": {"cloth.resolution": [4, 4], "tolerance": 1e-3},
    "scripts": "grasp.yaml",
    "duration": 0.5,
    "runs": 2,
    "vary": {"material.density": [0.1, 0.2]},
    "sampling": "grid",
}
ROLLOUTS = """\
import numpy as np
from cloth_sim_ros import Scene, Simulation
from cloth_sim_ros.batch import rollouts
simulation = Simulation(Scene.from_parameters({"cloth.resolution": [4, 4]}))
acts = np.zeros((4, 2, 1, 4))
rollouts(simulation.snapshot(), acts, processes=2)
"""


@pytest.fixture
def decoys(tmp_path: Path) -> Path:
    """A folder in which every imported module writes its name to `imported`."""
    folder = tmp_path / "downloads"
    folder.mkdir()
    marker = tmp_path / "imported"
    for name in NAMES:
        (folder / f"{name}.py").write_text(f"open({str(marker)!r}, 'a').write({name!r} + '\\n')\nraise ImportError\n")
    (folder / "study.yaml").write_text(json.dumps(STUDY))
    return folder


def run(command: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONSAFEPATH", "PYTHONPATH")}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


def imported(folder: Path) -> str:
    marker = folder.parent / "imported"
    return marker.read_text() if marker.exists() else ""


def test_commands_import_nothing_from_the_folder(decoys: Path, find_executable: Callable[[str], str]) -> None:
    batch = run([find_executable("cloth_batch"), "study.yaml", "--out", "out", "--workers", "1"], decoys)
    assert (imported(decoys), batch.returncode) == ("", 0), batch.stderr
    session = "out/runs/000/run_0000000.mcap"
    commands = [
        ["cloth_batch", "view", "out", "--run", "0", "--save", "run.rrd"],
        ["cloth_fit", session, "--parameters", "stretch,shear", "--until", "0.2", "--workers", "2"],
        ["cloth_replay", session, "--accuracy", "--save", "accuracy.rrd"],
        ["cloth_verify", session],
        ["cloth_session", "info", session],
        ["cloth_sim", "--check", "study.yaml"],
    ]
    for name, *arguments in commands:
        done = run([find_executable(name), *arguments], decoys)
        assert imported(decoys) == "", name
        assert "Traceback" not in done.stderr, done.stderr
    assert (decoys / "run.rrd").exists()
    assert (decoys / "accuracy.rrd").exists()


def test_rollouts_import_nothing_from_the_folder(decoys: Path, tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(ROLLOUTS)
    done = run([sys.executable, str(program)], decoys)
    assert (imported(decoys), done.returncode) == ("", 0), done.stderr


def test_empty_python_path_entry_names_no_folder(decoys: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", f":{decoys.parent}:")
    monkeypatch.chdir(decoys)
    command = module_command("cloth_sim_ros.session.main", "--help")
    done = subprocess.run(command, env=child_environment(), capture_output=True, text=True, check=False)
    assert (imported(decoys), done.returncode) == ("", 0), done.stderr
