# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Old command `cloth_bench`: each subcommand names the command that took its place."""

from __future__ import annotations

import subprocess

import pytest

from cloth_sim_ros.session.moved_bench import main

COMMANDS = {
    "work-precision": "make validate ARGS=work-precision",
    "tolerance": "make validate ARGS=tolerance-sweep",
    "conditioning": "make validate ARGS=conditioning",
    "constants": "make validate ARGS=constants",
    "promise": "make validate ARGS=tolerance",
    "stability": "make validate ARGS=stability",
    "mesh-moduli": "make validate ARGS=mesh-moduli",
    "contact": "make bench ARGS=contact",
    "speed": "make bench ARGS=speed",
    "peers": "make bench ARGS=peers",
    "peers-contact": "make bench ARGS=peers-contact",
    "scale": "make bench ARGS=scale",
    "adds": "make bench ARGS=feature-cost",
    "batch": "make bench ARGS=batch",
    "studies": "make bench ARGS=studies",
    "skip": "make bench ARGS=feature-cost",
}


@pytest.mark.parametrize("name", COMMANDS)
def test_old_subcommand_names_its_successor(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([name]) == 2
    said = f"cloth_bench has left the package: run `{COMMANDS[name]}` in a clone of the repository\n"
    assert capsys.readouterr().err == said


def test_old_options_are_passed_on(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["promise", "--contact", "--seed", "3"]) == 2
    assert "`make validate ARGS='tolerance --contact --seed 3'`" in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [[], ["--help"], ["fly"]])
def test_unknown_subcommand_names_both_targets(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 2
    assert "run `make bench` or `make validate` in a clone" in capsys.readouterr().err


def test_engine_subcommand_is_said_to_be_deleted(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["engine"]) == 2
    assert "is deleted" in capsys.readouterr().err


def test_installed_command_exits_with_2(find_executable) -> None:
    done = subprocess.run([find_executable("cloth_bench"), "speed"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert "make bench ARGS=speed" in done.stderr
