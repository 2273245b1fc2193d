# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""An older commit of this tree with an environment of its own, made once and kept, to be measured against."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import attrs

from cloth_sim_ros.bench.peer_environment import (
    NO_NETWORK,
    EnvironmentUnusable,
    alone,
    clean_variables,
    last_line,
    python_of,
)

#: The last commit before the engine.
BEFORE_ENGINE = "bd9f05d"


@attrs.frozen
class OldTree:
    """Where an older commit stands."""

    commit: str
    #: Root of its sources.
    tree: Path
    #: Its own Python.
    python: Path


def default_folder() -> Path:
    """Where older trees are kept: CLOTH_SIM_ROS_BENCH_CACHE, or the user's cache."""
    named = os.environ.get("CLOTH_SIM_ROS_BENCH_CACHE")
    if named:
        return Path(named).expanduser().absolute()
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "cloth_sim_ros" / "older"


def prepare(
    commit: str, say: Callable[[str], None], *, folder: Path | None = None, repository: Path | None = None
) -> OldTree:
    """Return an older commit, ready to run; make it where it is missing.

    Args:
        commit: as git names it.
        say: is told what takes time.
        folder: where it is kept.
        repository: a checkout with the history; the one that this file is in where left out.

    Raises:
        EnvironmentUnusable: without the history, without a network when it is needed, or if it can't be installed.
    """
    repository = repository or Path(__file__).resolve().parent.parent.parent
    whole = _resolved(commit, repository)
    version = ".".join(str(part) for part in sys.version_info[:2])
    place = (folder or default_folder()) / f"{whole[:12]}-python{version}"
    tree, environment, ready = place / "tree", place / "environment", place / "ready"
    found = OldTree(whole, tree, python_of(environment))
    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise EnvironmentUnusable(
            f"{place} can't be made: {error}; name another folder by CLOTH_SIM_ROS_BENCH_CACHE"
        ) from error
    with alone(place, say):
        # Written last: what was interrupted is made anew.
        if ready.exists() and found.python.exists() and (tree / "cloth_sim_ros").is_dir():
            return found
        ready.unlink(missing_ok=True)
        _check_out(whole, tree, repository, say)
        _install(tree, environment, say)
        ready.write_text(f"{whole}\n")
    return found


def _resolved(commit: str, repository: Path) -> str:
    done = _git(repository, "rev-parse", "--verify", "--quiet", "--end-of-options", f"{commit}^{{commit}}")
    if done.returncode:
        raise EnvironmentUnusable(
            f"{repository} has no commit {commit}: measuring against it needs a checkout with its history; clone the "
            "repository whole, or `git fetch --unshallow`, or name another commit by --against"
        )
    return done.stdout.strip()


def _check_out(commit: str, tree: Path, repository: Path, say: Callable[[str], None]) -> None:
    say(f"checking out {commit[:12]} into {tree}, once ...")
    if tree.exists():
        shutil.rmtree(tree)
    # Forced: git may remember a worktree there that was removed by hand.
    done = _git(repository, "worktree", "add", "--force", "--force", "--detach", str(tree), commit)
    if done.returncode:
        raise EnvironmentUnusable(f"git can't check out {commit[:12]} into {tree}: {last_line(done.stderr)}")


def _install(tree: Path, environment: Path, say: Callable[[str], None]) -> None:
    say(f"installing it with its own versions into {environment}, once ...")
    if environment.exists():
        shutil.rmtree(environment)
    done = _run([sys.executable, "-m", "venv", str(environment)])
    if done.returncode:
        raise EnvironmentUnusable(
            f"no environment can be made in {environment}: {last_line(done.stderr + done.stdout)}"
        )
    command = [str(python_of(environment)), "-I", "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    constraints = tree / "constraints.txt"
    if constraints.exists():
        command += ["--constraint", str(constraints)]
    done = _run([*command, "--no-input", "--retries", "1", "--editable", str(tree)])
    if not done.returncode:
        return
    said = done.stderr + done.stdout
    if any(text in said for text in NO_NETWORK):
        raise EnvironmentUnusable(
            "the older tree needs packages that are not here, and the package index is out of reach; run it once with "
            "a network, it is kept"
        )
    raise EnvironmentUnusable(f"pip can't install the older tree: {last_line(said)}")


def _git(repository: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    try:
        return _run(["git", "-C", str(repository), *arguments])
    except FileNotFoundError as error:
        raise EnvironmentUnusable("measuring against an older commit needs git, and it is not installed") from error


def _run(command: list[str]) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, env=clean_variables(), capture_output=True, text=True, check=False)
