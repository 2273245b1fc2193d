# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Study with injected failures: random kills of workers, one kill of the scheduler, one full disk.

Every run must be complete exactly once, with the digest of an undisturbed study.

    .venv/bin/python test/soak_studies.py --runs 1000 --kills 50

Scheduler and workers are separate processes of the documented commands, over TCP on the loopback interface.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import resource
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pyarrow.parquet as pq

BIN = Path(sys.executable).parent
ROOT = Path(__file__).resolve().parent.parent
STUDY = """\
scene: cloth_sim.yaml
parameters:
  cloth.resolution: [8, 8]
  tolerance: 1.0e-3
  gripper.radius: 0.2
scripts: grasp.yaml
duration: {duration}
runs: {runs}
seed: 11
vary:
  material.density: {{uniform: [0.1, 0.3]}}
  target.gripper.z: {{normal: [0.0, 0.01]}}
"""
#: Limit of the file size that lets every write of a run fail [bytes].
TOO_SMALL = 4096


def free_port() -> int:
    """Return a free TCP port."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def batch(*arguments: str | Path) -> list[str]:
    """Return a command line of cloth_batch."""
    return [sys.executable, "-m", "cloth_sim_ros.studies.main", *map(str, arguments)]


class Cluster:
    """Dask's scheduler and workers as processes of the documented commands, restarted when they end."""

    def __init__(self, workers: int, folder: Path) -> None:
        self.address = f"tcp://127.0.0.1:{free_port()}"
        self._folder = folder
        self._environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        self._scheduler = self._start_scheduler()
        self.limit_files = False
        self._workers = [self._start_worker() for _ in range(workers)]

    def _start(self, *command: str, limited: bool = False) -> subprocess.Popen[bytes]:
        def limit() -> None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (TOO_SMALL, resource.RLIM_INFINITY))

        return subprocess.Popen(
            [str(BIN / "dask"), *command],
            env=self._environment,
            cwd=self._folder,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
            preexec_fn=limit if limited else None,
        )

    def _start_scheduler(self) -> subprocess.Popen[bytes]:
        port = self.address.rpartition(":")[2]
        return self._start("scheduler", "--host", "127.0.0.1", "--port", port, "--no-dashboard")

    def _start_worker(self) -> subprocess.Popen[bytes]:
        # Without a nanny, the process is the worker.
        return self._start(
            "worker", self.address, "--nthreads", "1", "--no-nanny", "--no-dashboard", limited=self.limit_files
        )

    def tend(self) -> None:
        """Restart processes that have ended, like a batch system."""
        if self._scheduler.poll() is not None:
            self._scheduler = self._start_scheduler()
        for k, worker in enumerate(self._workers):
            if worker.poll() is not None:
                self._workers[k] = self._start_worker()

    def kill_worker(self, which: int) -> None:
        """Kill a worker during its work."""
        _kill(self._workers[which % len(self._workers)])

    def kill_scheduler(self) -> None:
        """Kill the scheduler; its state is lost."""
        _kill(self._scheduler)

    def limit(self, limited: bool) -> None:
        """Limit the file size of workers to simulate a full disk, or remove the limit."""
        self.limit_files = limited
        for worker in self._workers:
            _kill(worker)

    def stop(self) -> None:
        """End all processes."""
        for process in (*self._workers, self._scheduler):
            _kill(process)


def _kill(process: subprocess.Popen[bytes]) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


@contextlib.contextmanager
def cluster(workers: int, folder: Path) -> Iterator[Cluster]:
    """Yield a cluster that ends with the context."""
    new_cluster = Cluster(workers, folder)
    try:
        yield new_cluster
    finally:
        new_cluster.stop()


def rows_in(folder: Path) -> int:
    """Return the number of finished runs in a study's folder."""
    return sum(1 for _ in (folder / "rows").glob("*/*.json") if not _.name.startswith("."))


def disturbed(
    study: Path, out: Path, *, runs: int, kills: int, workers: int, seed: int, on_message: Callable[[str], None]
) -> dict[str, int]:
    """Run a study on a cluster with injected failures until it is complete; return the counts of failures."""
    chance = random.Random(seed)
    # Kills depend on the number of finished runs, not on time; their number is the same on every machine.
    shots = sorted(chance.uniform(1.0, 0.95 * runs) for _ in range(kills))
    count = {"worker kills": 0, "scheduler kills": 0, "full disks": 0, "clients": 0}
    with cluster(workers, out.parent) as dask:
        client: subprocess.Popen[str] | None = None
        while True:
            dask.tend()
            done = rows_in(out) if out.exists() else 0
            if client is None:
                more = ["--resume"] if count["clients"] else []
                client = subprocess.Popen(
                    batch(study, "--out", out, "--scheduler", dask.address, "--wait", "300", *more),
                    env={**os.environ, "PYTHONPATH": str(ROOT)},
                    stdout=subprocess.PIPE,
                    stderr=subprocess.STDOUT,
                    text=True,
                )
                count["clients"] += 1
            elif client.poll() is not None:
                text = client.stdout.read() if client.stdout else ""
                on_message(f"client ended with {client.returncode}: {text.strip().splitlines()[-3:]}")
                if client.returncode == 0:
                    return count
                assert "no space left in" in text, text
                assert not list((out / "runs").glob(".unfinished-*/*.mcap")), "half-written sessions stay"
                dask.limit(False)
                client = None
            elif done >= runs // 3 and not count["scheduler kills"]:
                count["scheduler kills"] += 1
                dask.kill_scheduler()
            elif done >= runs // 2 and not count["full disks"]:
                count["full disks"] += 1
                dask.limit(True)
            elif shots and done >= shots[0] and not dask.limit_files:
                dask.kill_worker(chance.randrange(workers))
                count["worker kills"] += 1
                del shots[0]
            time.sleep(0.1)


def compare(calm: Path, shot: Path, runs: int) -> int:
    """Compare the indexes of two folders; return the number of differing runs."""
    tables = [pq.read_table(folder / "index.parquet").to_pydict() for folder in (calm, shot)]
    for table, folder in zip(tables, (calm, shot), strict=True):
        assert table["run"] == list(range(runs)), f"{folder}: runs are missing or twice there"
        assert set(table["status"]) == {"ok"}, f"{folder}: {set(table['error'])}"
        assert not list(folder.rglob(".unfinished-*")), f"{folder}: leftovers"
        assert rows_in(folder) == runs
        assert all((folder / name).is_file() for name in table["session"])
    return sum(
        undisturbed != disturbed_digest
        for undisturbed, disturbed_digest in zip(tables[0]["digest"], tables[1]["digest"], strict=True)
    )


def soak(
    folder: Path, *, runs: int, kills: int, workers: int = 2, seed: int = 1, duration: float = 2.5, on_message=print
) -> dict[str, int]:
    """Run the study undisturbed and with failures; return the counts of failures and differing runs."""
    study = folder / "study.yaml"
    study.write_text(STUDY.format(runs=runs, duration=duration))
    subprocess.run(
        batch(study, "--out", folder / "calm", "--workers", str(workers)),
        check=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.DEVNULL,
    )
    count = disturbed(study, folder / "shot", runs=runs, kills=kills, workers=workers, seed=seed, on_message=on_message)
    count["runs that differ"] = compare(folder / "calm", folder / "shot", runs)
    return count


def main() -> int:
    """Run the soak; return 1 if a run differs, or the study ended before all kills."""
    parser = argparse.ArgumentParser(description="Run a study with killed workers, a killed scheduler and a full disk.")
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--duration", type=float, default=2.5, help="duration of each run [s]")
    options = parser.parse_args()
    begun = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="soak_studies_") as folder:
        count = soak(Path(folder), **vars(options))
    totals = ", ".join(f"{n_events} {event}" for event, n_events in count.items())
    print(f"{options.runs} runs: {totals}; {time.monotonic() - begun:.0f} s")
    return 1 if count["runs that differ"] or count["worker kills"] < options.kills else 0


if __name__ == "__main__":
    sys.exit(main())
