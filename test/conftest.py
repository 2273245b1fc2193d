# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Shared fixtures: a reserved ROS domain, child processes that always end, and waits with a limit."""

from __future__ import annotations

import atexit
import contextlib
import itertools
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

# Threads of numpy's and scipy's linear algebra wait in busy loops for each other beside other tests; matrices here are
# small. The libraries read their number when they load. Processes of the tests have their own number.
_N_BLAS_THREADS = os.environ.get("OPENBLAS_NUM_THREADS")
os.environ["OPENBLAS_NUM_THREADS"] = "1"
import numpy  # noqa: E402, F401
import scipy.linalg  # noqa: E402, F401

del os.environ["OPENBLAS_NUM_THREADS"]
if _N_BLAS_THREADS is not None:
    os.environ["OPENBLAS_NUM_THREADS"] = _N_BLAS_THREADS

ROOT = Path(__file__).resolve().parent.parent

#: Files whose tests take longest, most of them with few tests. Run first, they leave no process alone at the end.
_SLOW_FILES = (
    "test_ros_soak.py",
    "test_cpp.py",
    "test_examples.py",
    "test_ros_restarts.py",
    "test_fit_motions.py",
    "test_fit.py",
    "test_ros_benchmarks.py",
    "test_bits.py",
    "test_ros_bad_input.py",
    "test_ros_stalled_subscribers.py",
    "test_engine_build.py",
    "test_ros_simulation_interfaces.py",
    "test_docs.py",
    "test_hostile_files.py",
    "test_accuracy.py",
    "test_ros_stopping.py",
    "test_ros_cameras.py",
    "test_peers.py",
    "test_layers.py",
    "test_working_directory.py",
    "test_contact_control.py",
    "test_study_kills.py",
    "test_session_kill.py",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the tests of slow files first."""
    items.sort(
        key=lambda item: _SLOW_FILES.index(item.path.name) if item.path.name in _SLOW_FILES else len(_SLOW_FILES)
    )


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """Return the number of workers of `-n auto`."""
    from support import worker_scheduling

    return worker_scheduling.count_workers(len(os.sched_getaffinity(0)))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> object:
    """Return a scheduler that separates timed tests for `--dist loadfile`, and None for other distributions."""
    if config.getvalue("dist") != "loadfile":
        return None
    from support import worker_scheduling

    return worker_scheduling.TimedFileScheduling(config, log)


if "PYTEST_XDIST_WORKER" in os.environ:
    from support import worker_scheduling

    worker_scheduling.lower_priority(os.environ)


# Without a folder at the top of the repository there is nothing that its tests could measure.
collect_ignore = [name for name in ("benchmarks", "validation") if not (ROOT / name / "__init__.py").exists()]

# Discovery takes up to 2.6 s, a first import some seconds on a busy machine.
PATIENCE = 60.0

# A shell's background job ignores interrupts, and so do its children: tests that send one would wait.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

#: ROS domains of the tests, from 1 on, and the order in which this process tries them; each worker starts elsewhere.
_DOMAINS = 100
_WORKER = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:])
_WORKERS = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
_CANDIDATES = itertools.cycle([(_WORKER * _DOMAINS // _WORKERS + i) % _DOMAINS + 1 for i in range(_DOMAINS)])


#: Folder of the shared-memory segments of Fast DDS's ports, and the first number of a complete segment.
_SEGMENTS, _WHOLE = Path("/dev/shm"), (2).to_bytes(4, sys.byteorder)
#: First port of domain 0, and number of ports per domain (PB and DG of the RTPS specification).
_PORTS, _PORTS_EACH = 7400, 250


def remove_broken_ports(domain: int) -> None:
    """Remove incomplete ports of a domain, which a killed process left: a process that opens one waits for ever.

    The segment of such a port is empty, or lacks the first number that Boost.Interprocess writes at the end.
    """
    first = _PORTS + _PORTS_EACH * domain
    for path in _SEGMENTS.glob("fastrtps_port*"):
        match = re.fullmatch(r"fastrtps_port(\d+)", path.name)
        if match is None or not first <= int(match[1]) < first + _PORTS_EACH:
            continue
        with contextlib.suppress(FileNotFoundError):
            with path.open("rb") as file:
                whole = file.read(4) == _WHOLE
            if not whole:
                path.unlink()


def _reserve_domain() -> tuple[int, socket.socket]:
    """Reserve a ROS domain that no other test process on this machine uses; return its id and the reserving socket.

    As in ROS 2's `domain_coordinator`, the process that binds port 32768 + id owns domain id. This separates these
    tests from other workers and from tests of other packages. The system frees the port when the process ends. Each
    call starts after the last id, because killed nodes stay in a domain's graph for some seconds.
    """
    for _ in range(_DOMAINS):
        domain = next(_CANDIDATES)
        reservation = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            reservation.bind(("", 32768 + domain))
        except OSError:
            reservation.close()
        else:
            remove_broken_ports(domain)
            return domain, reservation
    raise RuntimeError(f"all ROS domains 1 to {_DOMAINS} are reserved by other tests on this machine; end some of them")


# At import, before any test module can create a ROS context. Each pytest process, workers included, has its own
# domain, and its children inherit it.
_DOMAIN, _RESERVATION = _reserve_domain()
atexit.register(_RESERVATION.close)
os.environ["ROS_DOMAIN_ID"] = str(_DOMAIN)
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ.pop("ROS_STATIC_PEERS", None)
# Exceptions in frames are raised here and in the nodes that tests start, so that the state `failed` hides none.
os.environ["CLOTH_SIM_ROS_RAISE"] = "1"


# Libraries that a robot with the distribution's packages only may lack; `make test` has all of them.
_OPTIONAL = {
    "lz4",
    "matplotlib",
    "mcap",
    "plyfile",
    "pyarrow",
    "rclpy",
    "rerun",
    "rosbags",
    "sksundae",
    "trimesh",
    "zstandard",
}


@pytest.hookimpl(hookwrapper=True)
def pytest_make_collect_report(collector: pytest.Collector) -> Iterator[None]:
    """Skip a test module that can't be imported because an optional library is missing, and name the library."""
    outcome = yield
    report = outcome.get_result()  # type: ignore[attr-defined]
    missing = re.findall(r"ModuleNotFoundError: No module named '(\w+)", str(report.longrepr)) if report.failed else []
    if isinstance(collector, pytest.Module) and missing and missing[-1] in _OPTIONAL:
        report.outcome = "skipped"
        report.longrepr = (str(collector.path), 1, f"Skipped: {missing[-1]} is not installed")


# `make test` is reproducible: its random examples depend only on the tests' text. `make soak` draws at random.
# No deadline, because a busy machine is no failure.
with contextlib.suppress(ImportError):
    from hypothesis import settings

    settings.register_profile("repeated", derandomize=True, deadline=None)
    settings.register_profile("random", print_blob=True, deadline=None)
    settings.load_profile("repeated")


@pytest.fixture(scope="session", autouse=True)
def _ros_log_folder(tmp_path_factory: pytest.TempPathFactory) -> None:
    os.environ["ROS_LOG_DIR"] = str(tmp_path_factory.mktemp("ros_log"))


@pytest.fixture
def ros_domain(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """A ROS domain for one test and its children, without messages of earlier tests."""
    domain, reservation = _reserve_domain()
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
    yield domain
    reservation.close()


def _wait_until(
    condition: Callable[[], object], *, limit: float = PATIENCE, description: str = "the condition"
) -> object:
    """Poll until `condition()` is true and return its value; fail after `limit` [s] with the description."""
    end = time.monotonic() + limit
    while True:
        value = condition()
        if value:
            return value
        if time.monotonic() >= end:
            pytest.fail(f"waited {limit:g} s in vain for {description}")
        time.sleep(0.01)


@pytest.fixture
def wait_until() -> Callable[..., object]:
    """`wait_until(condition, limit=60.0, description="...")`: poll with a limit instead of a fixed sleep."""
    return _wait_until


class RunningProcess:
    """A child process in its own process group, with its output (both streams) in a file; it ends with the test."""

    def __init__(self, arguments: Sequence[str | Path], *, output: Path, env: dict[str, str], cwd: Path) -> None:
        self.arguments = [str(argument) for argument in arguments]
        self._output = output
        with output.open("wb") as stream:
            self.popen = subprocess.Popen(
                self.arguments,
                stdin=subprocess.DEVNULL,
                stdout=stream,
                stderr=subprocess.STDOUT,
                env=env,
                cwd=cwd,
                start_new_session=True,
            )

    @property
    def pid(self) -> int:
        """Process id, which is also the id of its group."""
        return self.popen.pid

    @property
    def output(self) -> str:
        """The output so far."""
        return self._output.read_text(errors="replace")

    def wait_for_output(self, text: str, *, limit: float = PATIENCE) -> str:
        """Wait until the output contains `text`, and return it; fail if the process ends, or after `limit` [s]."""

        def seen() -> str | None:
            ended = self.popen.poll() is not None
            output = self.output
            if text in output:
                return output
            if ended:
                pytest.fail(f"{self.arguments} ended with {self.popen.returncode} before {text!r}:\n{output}")
            return None

        return str(
            _wait_until(seen, limit=limit, description=f"{text!r} from {self.arguments}, which wrote:\n{self.output}")
        )

    def wait(self, *, limit: float = PATIENCE) -> int:
        """Wait for the end and return the exit status; fail after `limit` [s]."""
        try:
            return self.popen.wait(limit)
        except subprocess.TimeoutExpired:
            pytest.fail(f"{self.arguments} still runs after {limit:g} s; it wrote:\n{self.output}")

    def send_signal(self, signum: int) -> None:
        """Send a signal to the process and its children, as a terminal or `ros2 launch` does."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.pid, signum)

    def interrupt(self, *, limit: float = PATIENCE) -> int:
        """Send SIGINT and return the exit status."""
        self.send_signal(signal.SIGINT)
        return self.wait(limit=limit)

    def kill(self) -> None:
        """Kill the process and its children."""
        self.send_signal(signal.SIGKILL)
        self.popen.wait()
        remove_broken_ports(int(os.environ["ROS_DOMAIN_ID"]))


def _stop(process: RunningProcess) -> None:
    # Interrupt first, so that a running recording is closed; then kill, children included.
    if process.popen.poll() is None:
        process.send_signal(signal.SIGINT)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.popen.wait(10.0)
    process.kill()


@pytest.fixture
def start_process(tmp_path: Path) -> Iterator[Callable[..., RunningProcess]]:
    """`start_process(arguments, env={...}, cwd=...)` starts a child that always ends with the test.

    The child inherits the test's environment (its ROS domain included), with `env` on top. An argument list that
    begins with "-m" runs under this Python: `start_process(["-m", "cloth_sim_ros.ros.main"])`.
    """
    running: list[RunningProcess] = []

    def start(
        arguments: Sequence[str | Path], *, env: dict[str, str] | None = None, cwd: Path = ROOT
    ) -> RunningProcess:
        if arguments[0] == "-m":
            arguments = [sys.executable, *arguments]
        output = tmp_path / f"process_{len(running)}.log"
        process = RunningProcess(
            arguments, output=output, env={**os.environ, "PYTHONUNBUFFERED": "1", **(env or {})}, cwd=cwd
        )
        running.append(process)
        return process

    yield start
    for process in running:
        _stop(process)
        # Shown if the test fails: the output of the processes explains it.
        print(f"--- {' '.join(process.arguments)}\n{process.output[-4000:]}")


@pytest.fixture
def find_executable() -> Callable[[str], str]:
    """`find_executable(name)`: a command of the package in this Python's folder; skips if it is not installed."""

    def find(name: str) -> str:
        path = shutil.which(name, path=str(Path(sys.executable).parent)) or shutil.which(name)
        if path is None:
            pytest.skip(f"the command {name} is not installed; `make test` installs it")
        return path

    return find
