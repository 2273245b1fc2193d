# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Separate Python environment for other engines, created on demand."""

from __future__ import annotations

import argparse
import fcntl
import json
import os
import subprocess
import sys
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from validation.command import above

#: Variables that point another Python to this environment or to a sourced ROS: library and module paths, and the guard
#: with which the ROS wheels mark a library path that is already set.
_LEADING_BACK = ("_ROS_WHEELS_BOOTSTRAP_COMPLETE", "LD_LIBRARY_PATH", "PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")
#: Messages of pip without a network. Its final message, that there is no such version, misleads.
NO_NETWORK = (
    "NewConnectionError",
    "Name or service not known",
    "Temporary failure in name resolution",
    "connection broken",
    "Network is unreachable",
    "Connection refused",
    "timed out",
    "ProxyError",
)
_UNREACHABLE = "it is not installed, and the package index is out of reach"


class EnvironmentUnusable(ValueError):
    """Environment that cannot be created or used; the message names cause and remedy."""


def default_folder() -> Path:
    """Return the default folder of the environment."""
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(cache) / "cloth_sim_ros" / "peers"


def add_arguments(parser: argparse.ArgumentParser, packages: Collection[str], seconds: float) -> None:
    """Declare the options of all comparisons with other engines."""
    parser.add_argument("--peers", nargs="*", choices=packages, default=[*packages], help="which engines besides ours")
    limit = "wall seconds after which a run ends early"
    parser.add_argument("--seconds", type=above(0.0), default=seconds, metavar="S", help=limit)
    folder_help = "where the peers are installed, from PyPI"
    parser.add_argument("--environment", type=Path, metavar="FOLDER", default=default_folder(), help=folder_help)


def clean_variables(**more: str) -> dict[str, str]:
    """Return this process's environment variables without those that point back to its environment."""
    variables = {name: value for name, value in os.environ.items() if name not in _LEADING_BACK}
    return variables | more


def python_of(folder: Path) -> Path:
    """Return the path of the environment's Python."""
    return folder / "bin" / "python"


def prepare(
    folder: Path, requirements: Mapping[str, tuple[str, ...]], on_message: Callable[[str], None]
) -> dict[str, str]:
    """Create the environment if it is missing, and install missing packages.

    Args:
        folder: the environment; empty, missing, or created here before.
        requirements: exact versions for pip, by peer.
        on_message: receives messages about slow steps.

    Returns:
        The reason, by peer that could not be installed.

    Raises:
        EnvironmentUnusable: if the folder holds other files, or no environment can be created there.
    """
    absent: dict[str, str] = {}
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise EnvironmentUnusable(f"environment {folder}: {error}; name another folder by --environment") from error
    with lock_folder(folder, on_message):
        if not python_of(folder).exists():
            _make(folder, on_message)
        present = _installed(folder)
        for peer, packages in requirements.items():
            versions = [package.partition("==") for package in packages]
            missing = ["".join(p) for p in versions if present.get(p[0].lower()) != p[2]]
            if not missing:
                continue
            if _UNREACHABLE in absent.values():
                # Each further attempt would time out after half a minute.
                absent[peer] = _UNREACHABLE
                continue
            on_message(f"installing {', '.join(packages)} into {folder}, once ...")
            reason = _install(folder, packages)
            if reason:
                absent[peer] = reason
    return absent


@contextmanager
def lock_folder(folder: Path, on_message: Callable[[str], None]) -> Iterator[None]:
    """Hold the lock of an environment, so that processes take turns."""
    with folder.with_name(folder.name + ".lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            on_message(f"another process is at work on {folder}; waiting for it ...")
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _run(command: list[str]) -> subprocess.CompletedProcess[str]:
    """Run a command with clean variables."""
    return subprocess.run(command, env=clean_variables(), capture_output=True, text=True, check=False)


def _make(folder: Path, on_message: Callable[[str], None]) -> None:
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        remedy = "name another folder by --environment, or remove it"
        raise EnvironmentUnusable(f"{folder} holds something, but no Python environment; {remedy}")
    on_message(f"making an environment for the peers in {folder}, once ...")
    done = _run([sys.executable, "-m", "venv", str(folder)])
    if done.returncode:
        raise EnvironmentUnusable(f"no environment can be made in {folder}: {last_line(done.stderr + done.stdout)}")


def _installed(folder: Path) -> dict[str, str]:
    """Return the versions of installed packages, by lower-case name."""
    try:
        done = _run([str(python_of(folder)), "-I", "-m", "pip", "list", "--format", "json"])
        reason = last_line(done.stderr) if done.returncode else ""
    except OSError as error:
        reason = str(error)
    if reason:
        remedy = "remove the folder; the next run creates it again"
        raise EnvironmentUnusable(f"the Python in {folder} does not run: {reason}; {remedy}")
    return {package["name"].lower(): package["version"] for package in json.loads(done.stdout)}


def _install(folder: Path, packages: tuple[str, ...]) -> str:
    """Install exact versions from wheels; return the cause of a failure, or an empty text."""
    command = [str(python_of(folder)), "-I", "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    command += ["--no-input", "--retries", "1", "--only-binary", ":all:", *packages]
    done = _run(command)
    if not done.returncode:
        return ""
    output = done.stderr + done.stdout
    if any(text in output for text in NO_NETWORK):
        return _UNREACHABLE
    if "No matching distribution" in output:
        version = ".".join(str(part) for part in sys.version_info[:2])
        return f"there is no wheel of {' '.join(packages)} for Python {version} on this machine"
    return f"pip failed with {' '.join(packages)}: {last_line(output)}"


def last_line(text: str) -> str:
    """Return the last line of a program's output."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1] if lines else "no word of why"
