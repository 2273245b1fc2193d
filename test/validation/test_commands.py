# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Command lines of benchmarks and validation: the list of names, and the names of `cloth_bench` of old."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path

import pytest

import validation.__main__
from cloth_sim_ros.session.moved_bench import MOVED

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = {"validate": "validation", "bench": "benchmarks"}


@pytest.mark.parametrize("target", PACKAGES)
def test_names_that_cloth_bench_points_to_are_there(target: str) -> None:
    commands = pytest.importorskip(f"{PACKAGES[target]}.__main__").COMMANDS
    assert {*MOVED[target].values()} <= commands.keys()
    for module, line in commands.values():
        assert ROOT.joinpath(*module.split(".")).with_suffix(".py").is_file()
        assert "\n" not in line


@pytest.mark.parametrize("package", PACKAGES.values())
def test_without_a_name_the_names_are_listed(package: str) -> None:
    commands = importlib.import_module(f"{package}.__main__").COMMANDS
    done = subprocess.run([sys.executable, "-m", package], cwd=ROOT, capture_output=True, text=True, check=True)
    listed = [line.split()[0] for line in done.stdout.splitlines() if line.startswith("  ") and line.strip()]
    assert listed[-len(commands) :] == [*commands]


def test_an_unknown_name_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        validation.__main__.main(["fly"])
    assert "invalid choice: 'fly'" in capsys.readouterr().err
