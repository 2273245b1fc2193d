# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Choice of Python and creation of the environment by `make`, on simulated machines without network."""

from __future__ import annotations

import os
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("ensurepip", reason="this Python cannot make environments")

ROOT = Path(__file__).resolve().parent.parent
FIND_PYTHON = ROOT / "scripts" / "find_python.sh"


def write_script(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return path


@pytest.fixture
def machine(tmp_path: Path) -> Path:
    """A folder that is the whole PATH of an x86-64 Linux machine, without Python."""
    folder = tmp_path / "bin"
    write_script(folder / "uname", 'case $1 in -s) echo Linux ;; -m) echo "${MACHINE:-x86_64}" ;; esac')
    (folder / "sh").symlink_to(shutil.which("sh") or "/bin/sh")
    return folder


def find_python(machine: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    environment = {"PATH": str(machine), **variables}
    return subprocess.run([FIND_PYTHON], env=environment, check=False, capture_output=True, text=True)


def link_this_python(path: Path) -> None:
    write_script(path, f'exec {sys.executable} "$@"')


def test_a_name_that_does_not_run_is_passed_over(machine: Path) -> None:
    write_script(machine / "python3.13", "echo 'python3.13: command not found' >&2; exit 127")
    link_this_python(machine / "python3")
    result = find_python(machine)
    assert result.returncode == 0, result.stderr
    assert Path(result.stdout.strip()).resolve() == Path(sys.executable).resolve()


def test_python_that_was_named_is_the_one(machine: Path) -> None:
    write_script(machine / "python3.13", "echo /never; exit 0")
    link_this_python(machine / "mine")
    assert find_python(machine, PYTHON="mine").stdout.strip() != "/never"
    missing = find_python(machine, PYTHON="absent")
    assert missing.returncode == 1
    assert "absent was not found" in missing.stderr


def test_no_python_gets_one_sentence(machine: Path) -> None:
    # A Python of another version prints its version for the probe.
    write_script(machine / "python3", "echo 'is Python 3.8.18'; exit 1")
    result = find_python(machine)
    assert result.returncode == 1
    assert len(result.stderr.splitlines()) == 1
    assert "Python 3.11, 3.12 or 3.13" in result.stderr
    assert "python3 is Python 3.8.18" in result.stderr


def test_another_processor_gets_one_sentence(machine: Path) -> None:
    link_this_python(machine / "python3")
    result = find_python(machine, MACHINE="aarch64")
    assert result.returncode == 1
    assert len(result.stderr.splitlines()) == 1
    assert "x86-64 Linux" in result.stderr
    assert "installed ROS 2" in result.stderr


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A copy of the environment's inputs, with an environment whose pip the test controls."""
    folder = tmp_path / "project"
    inputs = ("setup.py", "setup.cfg", "constraints.txt", "scripts/environment.py", "scripts/compiler.py")
    for name in (*inputs, "cloth_sim_ros/engine/build.py"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, folder / name)
    # This Python answers the probe. As pip it counts its calls, installs a package and ends with $PIP_STATUS.
    fake = (
        'here=$(dirname "$0")/..\n'
        '[ "$1" = -m ] || exit 0\n'
        'echo pip >> "$here/calls"\n'
        '[ "${PIP_INSTALLS:-1}" = 1 ] && touch "$here/lib/python3/site-packages/package-$$"\n'
        "exit ${PIP_STATUS:-0}"
    )
    write_script(folder / "env" / "bin" / "python", fake)
    (folder / "env" / "lib" / "python3" / "site-packages").mkdir(parents=True)
    (folder / "env" / "calls").touch()
    return folder


def make(project: Path, extras: str = "demo", **variables: str) -> subprocess.CompletedProcess[str]:
    environment = project / "env"
    return subprocess.run(
        [sys.executable, project / "scripts" / "environment.py", "--folder", environment, "--extras", extras,
         "--stamp", environment / f"has_{extras}"],
        env={**os.environ, **variables}, check=False, capture_output=True, text=True,
    )  # fmt: skip


def pip_calls(project: Path) -> int:
    return len((project / "env" / "calls").read_text().splitlines())


def test_an_environment_made_by_hand_is_completed_once(project: Path) -> None:
    assert make(project).returncode == 0
    assert (project / "env" / "has_demo").exists()
    assert not (project / "env" / "unfinished").exists()
    (project / "setup.py").touch()  # newer, and the same: nothing to do
    assert make(project).returncode == 0
    assert pip_calls(project) == 1
    (project / "constraints.txt").write_text("# other pins\n")
    assert make(project).returncode == 0
    assert pip_calls(project) == 2


@pytest.mark.parametrize(("extras", "names"), [("demo", ["wide"]), ("dev", ["wide", "plain"])])
def test_engine_is_built_while_pip_runs(project: Path, extras: str, names: list[str]) -> None:
    # The second library takes a second, and pip no time.
    (project / "cloth_sim_ros" / "engine" / "build.py").write_text(
        "import time\nfrom pathlib import Path\n"
        "BuildError = NoCompilerError = RuntimeError\n"
        "def find_compiler():\n    return ['g++']\n"
        "def names_here():\n    return ['wide', 'plain']\n"
        "def build(names):\n    time.sleep(len(names[0]) - 4)\n"
        f"    Path({str(project)!r}, 'built').open('a').write(f'{{names[0]}}\\n')\n"
    )
    done = make(project, extras)
    assert done.returncode == 0, done.stdout + done.stderr
    assert (project / "built").read_text().split() == names


def test_without_a_network_a_working_environment_is_kept(project: Path) -> None:
    failed = make(project, PIP_STATUS="1", PIP_INSTALLS="0")
    assert failed.returncode == 1
    assert "PyPI out of reach" in failed.stdout
    assert not (project / "env" / "has_demo").exists()
    assert not (project / "env" / "unfinished").exists()
    assert make(project).returncode == 0
    assert pip_calls(project) == 2


def test_interrupted_environment_is_created_again(project: Path) -> None:
    assert make(project, PIP_STATUS="1").returncode == 1
    assert (project / "env" / "unfinished").exists()
    # A new environment comes from venv with a real pip. It fails here, because the project's sources are missing.
    process = make(project, PIP_NO_INDEX="1", PIP_FIND_LINKS="")
    assert "making env with Python" in process.stdout
    assert not (project / "env" / "calls").exists()
    assert not (project / "env" / "has_demo").exists()


def test_missing_compiler_is_reported_before_pip_starts(project: Path, tmp_path: Path) -> None:
    # Nothing on the PATH, and so neither a compiler nor apt-get.
    process = make(project, PATH=str(tmp_path), CXX="")
    assert process.returncode == 1
    assert len(process.stdout.splitlines()) == 1
    assert "install the package g++" in process.stdout
    assert pip_calls(project) == 0
    # A named compiler that is missing is not replaced by another.
    process = make(project, CXX="absent-compiler")
    assert process.returncode == 1
    assert "absent-compiler, was not found" in process.stdout
    assert pip_calls(project) == 0


@pytest.mark.skipif(os.geteuid() != 0, reason="only root installs packages")
def test_as_root_with_apt_the_compiler_is_installed(project: Path, tmp_path: Path) -> None:
    folder = tmp_path / "packages"
    write_script(folder / "apt-get", f'echo "$@" >> {tmp_path}/apt\n[ "$1" = update ] || {{ echo; }} > {folder}/g++')
    for tool in ("dirname", "touch"):  # used by the fake pip
        (folder / tool).symlink_to(shutil.which(tool) or f"/bin/{tool}")
    process = make(project, PATH=str(folder), CXX="")
    assert process.returncode == 0, process.stdout + process.stderr
    assert "installing g++ with apt-get" in process.stdout
    assert (tmp_path / "apt").read_text().splitlines()[-1].endswith("g++")
    assert pip_calls(project) == 1


@pytest.mark.skipif(os.geteuid() != 0, reason="only root installs packages")
def test_failed_apt_is_reported(project: Path, tmp_path: Path) -> None:
    write_script(tmp_path / "packages" / "apt-get", "exit 100")
    process = make(project, PATH=str(tmp_path / "packages"), CXX="")
    assert process.returncode == 1
    assert "apt-get update ended with status 100" in process.stdout
    assert pip_calls(project) == 0


def test_moved_environment_or_missing_python_is_not_sound(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(project / "scripts")
    scripts = runpy.run_path(str(project / "scripts" / "environment.py"))
    assert make(project).returncode == 0
    assert scripts["is_sound"](project / "env")
    origin = (project / "env" / "made_in").read_text()
    (project / "env" / "made_in").write_text("/another/place\n")
    assert not scripts["is_sound"](project / "env")
    (project / "env" / "made_in").write_text(origin)
    (project / "env" / "bin" / "python").unlink()
    assert not scripts["is_sound"](project / "env")


def test_make_lets_python_cache_compiled_files() -> None:
    done = subprocess.run(
        ["make", "--no-print-directory", "-f", "Makefile", "-f", "-", "print-cache"],
        cwd=ROOT, input='print-cache:\n\t@echo "[$${PYTHONDONTWRITEBYTECODE}]"\n', text=True, capture_output=True,
        env={"PATH": "/usr/bin:/bin", "PYTHONDONTWRITEBYTECODE": "1"}, check=True,
    )  # fmt: skip
    assert done.stdout.splitlines()[-1] == "[]"
