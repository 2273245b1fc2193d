# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""An environment of their own for other engines, made on demand: what they bring stays out of this one."""

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

#: Variables that lead another Python back to this environment, or to a sourced ROS: libraries, modules, and the guard
#: by which the ROS wheels know that they have set the libraries' path already.
_LEADING_BACK = ("_ROS_WHEELS_BOOTSTRAP_COMPLETE", "LD_LIBRARY_PATH", "PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")
#: What pip says when it gets no answer; it goes on to say that there is no such version, which misleads.
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
    """The environment can't be made or used; the message says why and what to do."""


def default_folder() -> Path:
    """Where the environment is unless another place is named."""
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(cache) / "cloth_sim_ros" / "peers"


def add_arguments(parser: argparse.ArgumentParser, packages: Collection[str], seconds: float) -> None:
    """Declare the options that all comparisons with other engines have."""
    parser.add_argument("--peers", nargs="*", choices=packages, default=[*packages], help="which engines besides ours")
    parser.add_argument(
        "--seconds", type=float, default=seconds, metavar="S", help="wall seconds after which a run ends early"
    )
    parser.add_argument(
        "--environment",
        type=Path,
        metavar="FOLDER",
        default=default_folder(),
        help="where the peers are installed, from PyPI (%(default)s)",
    )


def clean_variables(**more: str) -> dict[str, str]:
    """This process's environment variables without those that lead back to it."""
    kept = {name: value for name, value in os.environ.items() if name not in _LEADING_BACK}
    return kept | more


def python_of(folder: Path) -> Path:
    """The environment's Python."""
    return folder / "bin" / "python"


def prepare(folder: Path, requirements: Mapping[str, tuple[str, ...]], say: Callable[[str], None]) -> dict[str, str]:
    """Make the environment where it is missing, and install what is missing in it.

    Args:
        folder: the environment; empty or missing, or one that this made.
        requirements: of each peer, exact versions as pip takes them.
        say: is told what takes time.

    Returns:
        Of each peer that could not be installed, the reason.

    Raises:
        EnvironmentUnusable: if the folder holds something else, or no environment can be made there.
    """
    absent: dict[str, str] = {}
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise EnvironmentUnusable(f"environment {folder}: {error}; name another folder by --environment") from error
    with alone(folder, say):
        if not python_of(folder).exists():
            _make(folder, say)
        present = _installed(folder)
        for peer, wanted in requirements.items():
            missing = [one for one in wanted if present.get(one.partition("==")[0].lower()) != one.partition("==")[2]]
            if not missing:
                continue
            if _UNREACHABLE in absent.values():
                # It would be asked in vain, for half a minute each.
                absent[peer] = _UNREACHABLE
                continue
            say(f"installing {', '.join(wanted)} into {folder}, once ...")
            reason = _install(folder, wanted)
            if reason:
                absent[peer] = reason
    return absent


@contextmanager
def alone(folder: Path, say: Callable[[str], None]) -> Iterator[None]:
    """Two at a time wait for each other."""
    with folder.with_name(folder.name + ".lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            say(f"another process is at work on {folder}; waiting for it ...")
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _make(folder: Path, say: Callable[[str], None]) -> None:
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise EnvironmentUnusable(
            f"{folder} holds something, but no Python environment; name another folder by --environment, or remove it"
        )
    say(f"making an environment for the peers in {folder}, once ...")
    done = subprocess.run(
        [sys.executable, "-m", "venv", str(folder)], env=clean_variables(), capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise EnvironmentUnusable(f"no environment can be made in {folder}: {last_line(done.stderr + done.stdout)}")


def _installed(folder: Path) -> dict[str, str]:
    """Versions of what the environment holds, by lower-case name."""
    script = (
        "import importlib.metadata as m, json; "
        "print(json.dumps({d.metadata['Name'].lower(): d.version for d in m.distributions()}))"
    )
    try:
        done = subprocess.run(
            [str(python_of(folder)), "-I", "-c", script],
            env=clean_variables(),
            capture_output=True,
            text=True,
            check=False,
        )
        reason = last_line(done.stderr) if done.returncode else ""
    except OSError as error:
        reason = str(error)
    if reason:
        raise EnvironmentUnusable(f"the Python in {folder} does not run: {reason}; remove the folder, it is made anew")
    found: dict[str, str] = json.loads(done.stdout)
    return found


def _install(folder: Path, wanted: tuple[str, ...]) -> str:
    """Install exact versions, wheels alone; return why it failed, or an empty text."""
    command = [str(python_of(folder)), "-I", "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    command += ["--no-input", "--retries", "1", "--only-binary", ":all:", *wanted]
    done = subprocess.run(command, env=clean_variables(), capture_output=True, text=True, check=False)
    if not done.returncode:
        return ""
    said = done.stderr + done.stdout
    if any(text in said for text in NO_NETWORK):
        return _UNREACHABLE
    if "No matching distribution" in said:
        version = ".".join(str(part) for part in sys.version_info[:2])
        return f"there is no wheel of {' '.join(wanted)} for Python {version} on this machine"
    return f"pip failed with {' '.join(wanted)}: {last_line(said)}"


def last_line(text: str) -> str:
    """The last line of what a program said."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1] if lines else "no word of why"
