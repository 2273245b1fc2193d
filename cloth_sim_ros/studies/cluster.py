# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Dask clusters: one started on this machine, or an existing one."""

from __future__ import annotations

import contextlib
import logging
import os
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import attrs

from cloth_sim_ros.session.child_process import safe_imports
from cloth_sim_ros.studies.errors import StoppedError, StudyError

if TYPE_CHECKING:
    from distributed import Client, Security

#: Workers ignore Ctrl-C, which the terminal sends to them as well. This process stops them and prints one message.
_IGNORE_INTERRUPT = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"
#: Number of workers that may die with a task before Dask reports the task as failed.
_ALLOWED_FAILURES = 3


@attrs.frozen
class SchedulerAddress:
    """Address of a Dask scheduler and the certificate for a connection to it."""

    #: Address such as ``tcp://host:8786``.
    address: str
    #: TLS certificate; None uses Dask's configuration.
    security: Security | None = attrs.field(default=None, repr=False)


def core_count() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0))


@contextlib.contextmanager
def local_scheduler(workers: int | None, on_message: Callable[[str], None]) -> Iterator[SchedulerAddress]:
    """Context of a Dask scheduler and worker processes, by default one per core, on this machine; yields its address.

    Connections are encrypted and need a certificate that exists in these processes alone. Without it, every account of
    the machine could run code through the scheduler's port.

    Args:
        workers: number of worker processes; None starts one per core.
        on_message: receives one line of text about the cluster.
    """
    import dask
    from distributed import LocalCluster, Security

    _silence_dask_logs()
    # A worker's profiler interrupts its thread a hundred times a second, and holds the interpreter lock meanwhile.
    settings = {
        "distributed.scheduler.allowed-failures": _ALLOWED_FAILURES,
        "distributed.worker.profile.enabled": False,
        # The dashboard's measurements interrupt the worker too, fifty times a second by default.
        "distributed.admin.tick.interval": "1s",
        "distributed.admin.system-monitor.interval": "2s",
    }
    dask.config.set(settings)
    security = Security.temporary()
    # Both contexts stay open with the cluster, because it replaces lost workers. Workers import from their folder,
    # therefore other accounts must not be able to write there.
    with safe_imports(), tempfile.TemporaryDirectory(prefix="cloth_batch_", ignore_cleanup_errors=True) as folder:
        with warnings.catch_warnings():
            # Dask warns if the dashboard's port is in use, and takes another one.
            warnings.simplefilter("ignore")
            cluster = LocalCluster(
                n_workers=workers or core_count(),
                threads_per_worker=1,
                processes=True,
                host="127.0.0.1",
                dashboard_address="127.0.0.1:8787",
                security=security,
                local_directory=folder,
                silence_logs=logging.CRITICAL,
                preload=[*dask.config.get("distributed.worker.preload"), _IGNORE_INTERRUPT],
            )
        try:
            on_message(f"{workers or core_count()} workers on this machine; Dask's dashboard: {cluster.dashboard_link}")
            yield SchedulerAddress(cluster.scheduler_address, security)
        finally:
            with contextlib.suppress(Exception):
                cluster.close(timeout=10)


def connect(scheduler: SchedulerAddress, *, wait: float) -> Client:
    """Connect to a Dask scheduler, retrying for `wait` [s]; return the client. Raises StudyError or StoppedError.

    Args:
        scheduler: its address.
        wait: time limit of the connection [s].

    Raises:
        StudyError: if the address is invalid.
        StoppedError: if the scheduler does not answer within `wait`.
    """
    from distributed import Client

    _silence_dask_logs()
    address = scheduler.address
    if "://" not in address:
        raise StudyError(f"scheduler '{address}' is no address; give tcp://host:8786, as `dask scheduler` prints it")
    end = time.monotonic() + wait
    while True:
        remaining = end - time.monotonic()
        try:
            timeout = f"{max(min(remaining, 10.0), 0.5):.1f}s"
            return Client(address, security=scheduler.security, timeout=timeout, set_as_default=False)
        except (OSError, TimeoutError, RuntimeError) as error:
            if time.monotonic() >= end:
                raise StoppedError(
                    f"no scheduler answers at {address} within {wait:g} s ({error}); start `dask scheduler` there. "
                    "Finished runs are kept; continue with --resume"
                ) from None
            time.sleep(0.5)
        except ValueError as error:
            raise StudyError(f"scheduler '{address}' is no address: {error}") from error


def check_workers(client: Client, folder: Path, version: str) -> None:
    """Raise StudyError if a worker of the cluster can't use the study's folder or runs other code.

    Args:
        client: connection to the cluster.
        folder: the study's folder.
        version: version of the code in this process, as `local_version` returns it.

    Raises:
        StudyError: if a worker can't read or write the folder, or has other code.
    """
    for worker, (problem, worker_version) in client.run(probe_folder, str(folder)).items():
        if problem:
            shared = "a shared folder under the same name (NFS, Lustre, a persistent volume)"
            raise StudyError(f"worker {worker} can't use {folder}: {problem}. Workers on other machines need {shared}")
        if worker_version != version:
            difference = f"another version of cloth_sim_ros ({worker_version}, here {version})"
            raise StudyError(f"worker {worker} has {difference}: its bits may differ; install the same version there")


def probe_folder(folder: str) -> tuple[str, str]:
    """Return a worker's problem with the study's folder ("" if none) and its code's version; writes a probe file."""
    import secrets
    import socket

    from cloth_sim_ros.simulation.environment import environment

    record = environment()
    version = f"{record['version']}, {record['source']}, numerics {record['numerics']}"
    study_path = Path(folder)
    probe = study_path / f".unfinished-probe-{socket.gethostname()}-{os.getpid()}-{secrets.token_hex(4)}"
    try:
        (study_path / "study.json").stat()
        probe.write_text("seen")
        probe.unlink()
    except OSError as error:
        return f"{error.strerror} ({error.filename})", version
    return "", version


def local_version() -> str:
    """Return the version of this process's code as text, to be compared with that of workers."""
    from cloth_sim_ros.simulation.environment import environment

    environment_record = environment()
    return f"{environment_record['version']}, {environment_record['source']}, numerics {environment_record['numerics']}"


def _silence_dask_logs() -> None:
    """Silence Dask's logs of lost connections, because this module handles them."""
    for name in ("distributed", "distributed.client", "distributed.nanny", "distributed.worker", "distributed.core"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
