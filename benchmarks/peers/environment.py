# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Python environment of other engines, created on demand, and runs of them in it."""

from __future__ import annotations

import argparse
import fcntl
import json
import math
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray
from support.problems import PERIOD, Problem
from support.raw_sheet import SHEET

from cloth_sim_ros import Drag, Gravity, GridSprings
from cloth_sim_ros.physics.model.sheets.surface import grid_triangles
from validation.command import above
from validation.report import Report, print_progress

#: Variables that point another Python to this environment or to a sourced ROS: library and module paths, and the guard
#: with which the ROS wheels mark a library path that is already set.
_LEADING_BACK = ("_ROS_WHEELS_BOOTSTRAP_COMPLETE", "LD_LIBRARY_PATH", "PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")
#: Part of pip's warning before it tries again without a network. Its final message, no such version, misleads.
_NO_NETWORK = "connection broken by"
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


def prepare_selected(
    options: argparse.Namespace, requirements: Mapping[str, tuple[str, ...]], report: Report
) -> tuple[Path, dict[str, str]]:
    """Prepare the environment for the peers of the options; return it, and the reasons of `prepare`, also noted."""
    folder = options.environment.expanduser().absolute()
    selected = {name: requirements[name] for name in options.peers}
    absent = prepare(folder, selected, print_progress) if selected else {}
    report.notes += [f"ABSENT: {name}: {reason}" for name, reason in absent.items()]
    return folder, absent


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
    if _NO_NETWORK in output:
        return _UNREACHABLE
    if "No matching distribution" in output:
        version = ".".join(str(part) for part in sys.version_info[:2])
        return f"there is no wheel of {' '.join(packages)} for Python {version} on this machine"
    return f"pip failed with {' '.join(packages)}: {last_line(output)}"


def last_line(text: str) -> str:
    """Return the last line of a program's output."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1] if lines else "no word of why"


#: Time for start, compilation and set-up, on top of the time limit of the frames [s].
_START_TIMEOUT = 600.0
#: Upper bound of steps per frame in the search.
_MAX_STEPS = 4096
#: Bisections between the longest valid step and the shortest invalid one.
_REFINEMENTS = 2


class PeerFailed(RuntimeError):
    """Engine without a result; the message quotes its output."""


@attrs.frozen
class Peer:
    """Solver of another engine."""

    name: str
    #: Entry of the requirements that it needs.
    package: str
    variant: str
    #: Difference of its model from the product's.
    differs: str
    #: First steps per frame of the search, by particles a side.
    first_steps: Callable[[int], int] = lambda n: 1
    #: Differences in one contact scene, by its name.
    apart: dict[str, str] = attrs.field(factory=dict, eq=False)
    #: Whether its material bends and shears like that of the reference in contact.
    comparable: bool = True
    #: File that runs it, beside `runner`.
    script: str = attrs.field(default=attrs.Factory(lambda peer: f"engine_{peer.package.lower()}.py", takes_self=True))


@attrs.frozen(kw_only=True)
class Attempt:
    """Result of one run of an engine."""

    #: Steps per frame of 1/60 s.
    steps: int
    #: Whether no edge is torn and all positions are finite.
    whole: bool
    #: Largest stretch of an edge at a frame, and at the end.
    stretch: float
    #: Number of steps.
    n_steps: int
    #: Wall time and processor time of the steps [s].
    wall: float
    cpu: float
    versions: dict[str, str] = attrs.field(factory=dict)
    remarks: list[str] = attrs.field(factory=list)

    @property
    def factor(self) -> float:
        """Simulated seconds per wall second."""
        return self.simulated / self.wall

    @property
    def cpu_factor(self) -> float:
        """Simulated seconds per second of processor time."""
        return self.simulated / self.cpu

    @property
    def simulated(self) -> float:
        """Simulated time [s]."""
        return self.n_steps / self.steps * PERIOD


def sheet_tables(problem: Problem) -> dict[str, Any]:
    """Return a raw sheet as plain tables.

    The sheet has `positions` (n, 3) [m], `masses` (n,) [kg], `anchored` (n,), `rows` and `columns`. Springs have
    `pairs` (m, 2), `rest_lengths` [m], `stiffness` [N/m] and `damping` [N s/m]. Stretch is measured by those along the
    threads: `edges` (e, 2) and `edge_lengths` (e,) [m]. `triangles` (t, 3) form a checkerboard. `gravity` (3,) is in
    m/s^2, `drag` in 1/s.
    """
    plan, state = problem.build()
    model = plan.model
    sheet = model.force(SHEET)
    assert isinstance(sheet, GridSprings)
    n_per_side = math.isqrt(model.particle_count)
    gravity, drag = np.zeros(3), 0.0
    for force in model.forces:
        if isinstance(force, Gravity):
            gravity = force.acceleration
        elif isinstance(force, Drag):
            drag = force.rate
    springs = sheet.pair_springs
    edges = thread_edges(n_per_side, n_per_side)
    return {
        "positions": state.positions,
        "masses": model.masses,
        "anchored": model.inverse_masses == 0.0,
        "rows": n_per_side,
        "columns": n_per_side,
        "gravity": gravity,
        "drag": drag,
        "pairs": springs.pairs,
        "rest_lengths": springs.rest_length,
        "stiffness": springs.rigidity,
        "damping": springs.damping,
        "edges": edges,
        "edge_lengths": np.linalg.norm(np.subtract(*state.positions[edges.T]), axis=1),
        # Anticlockwise from above.
        "triangles": grid_triangles(n_per_side, n_per_side, "alternating")[:, ::-1],
    }


def thread_edges(rows: int, columns: int) -> NDArray[np.int64]:
    """Return the edges of a grid along its threads, (m, 2)."""
    index = np.arange(rows * columns).reshape(rows, columns)
    ends = ((index[:, :-1], index[:, 1:]), (index[:-1], index[1:]))
    return np.concatenate([np.stack([first.ravel(), second.ravel()], axis=1) for first, second in ends])


def attempt(peer: Peer, sheet: Path, steps: int, *, environment: Path, threads: int = 1, **job: Any) -> Attempt:
    """Run an engine with fixed steps per frame, in a process of the peers' environment.

    Args:
        peer: the engine.
        sheet: the tables of `sheet_tables`, as npz.
        steps: steps per frame of 1/60 s.
        environment: where the engines are installed.
        threads: limit for engines with several threads.
        job: `frames`, `seconds`, `whole`, and `record` and `hold` of a scene with contact; see `runner`.

    Raises:
        PeerFailed: if the engine gives no result.
    """
    job |= {"sheet": str(sheet.absolute()), "steps": steps, "frame": PERIOD}
    job |= {"script": peer.script, "variant": peer.variant}
    variables = clean_variables(
        OMP_NUM_THREADS=str(threads),
        OPENBLAS_NUM_THREADS=str(threads),
        # What Warp compiles belongs to the environment.
        WARP_CACHE_PATH=str(environment / "warp"),
    )
    python = python_of(environment.absolute())
    command = [str(python), "-I", str(Path(__file__).with_name("runner.py"))]
    limit = _START_TIMEOUT + 2.0 * job["seconds"]
    try:
        done = subprocess.run(
            command,
            input=json.dumps(job),
            # Some engines leave a log there.
            cwd=sheet.parent,
            env=variables,
            capture_output=True,
            text=True,
            timeout=limit,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise PeerFailed(f"{peer.name}: no result after {limit:.0f} s") from error
    if done.returncode:
        status = done.returncode
        end = f"ended with status {status}" if status > 0 else f"was killed by {signal.Signals(-status).name}"
        raise PeerFailed(f"{peer.name}: {end}: {last_line(done.stderr)}")
    return Attempt(steps=steps, **json.loads(done.stdout))


def longest_step(is_valid: Callable[[int], bool | None], first: int) -> int | None:
    """Find the longest valid step, to about a fifth, if every shorter step is valid; None if none was found.

    Args:
        is_valid: runs with a number of steps per frame; None if the run took too long, as then finer ones do too.
        first: steps per frame of the first run.

    Returns:
        The number of steps per frame.
    """
    invalid, best = 0, first
    while not (valid := is_valid(best)):
        if valid is None or 2 * best > _MAX_STEPS:
            return None
        invalid, best = best, 2 * best
    while not invalid and best > 1:
        invalid, best = (0, best // 2) if is_valid(best // 2) else (best // 2, best)
    for _ in range(_REFINEMENTS):
        middle = round(math.sqrt(invalid * best))
        if not invalid or middle in (invalid, best):
            break
        invalid, best = (invalid, middle) if is_valid(middle) else (middle, best)
    return best
