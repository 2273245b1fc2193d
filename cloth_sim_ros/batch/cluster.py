# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Dask: the cluster that a study starts on this machine, or the one that it is told of."""

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

from cloth_sim_ros.batch.errors import StoppedError, StudyError
from cloth_sim_ros.session.child_process import safe_imports

if TYPE_CHECKING:
    from distributed import Client, Security

#: A terminal's Ctrl-C reaches workers as well. This process ends them; their own words would bury what it says.
_UNINTERRUPTED = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"
#: A worker that was killed takes its task with it: so often, before Dask says that the task kills workers.
_ALLOWED_FAILURES = 3


@attrs.frozen
class SchedulerAddress:
    """Address of a Dask scheduler, and the certificate without which it refuses a connection."""

    #: Such as ``tcp://host:8786``.
    address: str
    #: None: what Dask's own configuration says.
    security: Security | None = attrs.field(default=None, repr=False)


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0))


@contextlib.contextmanager
def local_scheduler(workers: int | None, say: Callable[[str], None]) -> Iterator[SchedulerAddress]:
    """Start a scheduler and a worker process a core on this machine.

    Its connections are encrypted and need a certificate that exists in these processes alone. A scheduler runs what it
    is sent, and every account of the machine reaches its port.
    """
    import dask
    from distributed import LocalCluster, Security

    _be_quiet()
    # A worker's profiler looks a hundred times a second at what its thread does, and takes the interpreter from it.
    settings = {
        "distributed.scheduler.allowed-failures": _ALLOWED_FAILURES,
        "distributed.worker.profile.enabled": False,
        # What a worker measures of itself for the dashboard interrupts too, fifty times a second where left as it is.
        "distributed.admin.tick.interval": "1s",
        "distributed.admin.system-monitor.interval": "2s",
    }
    dask.config.set(settings)
    security = Security.temporary()
    # All the time: a worker that is lost is replaced. Workers import from their folder: others may not write there.
    with safe_imports(), tempfile.TemporaryDirectory(prefix="cloth_batch_", ignore_cleanup_errors=True) as folder:
        with warnings.catch_warnings():
            # The dashboard's port may be taken: it gets another one.
            warnings.simplefilter("ignore")
            cluster = LocalCluster(
                n_workers=workers or cores(),
                threads_per_worker=1,
                processes=True,
                host="127.0.0.1",
                dashboard_address="127.0.0.1:8787",
                security=security,
                local_directory=folder,
                silence_logs=logging.CRITICAL,
                preload=[*dask.config.get("distributed.worker.preload"), _UNINTERRUPTED],
            )
        try:
            say(f"{workers or cores()} workers on this machine; Dask's dashboard: {cluster.dashboard_link}")
            yield SchedulerAddress(cluster.scheduler_address, security)
        finally:
            with contextlib.suppress(Exception):
                cluster.close(timeout=10)


def connect(scheduler: SchedulerAddress, *, wait: float) -> Client:
    """Connect to a scheduler, which may still be starting.

    Raises:
        StudyError: for an address that is none.
        StoppedError: if it does not answer within `wait` [s].
    """
    from distributed import Client

    _be_quiet()
    address = scheduler.address
    if "://" not in address:
        raise StudyError(f"scheduler '{address}' is no address; write tcp://host:8786, as `dask scheduler` prints it")
    end = time.monotonic() + wait
    while True:
        left = end - time.monotonic()
        try:
            timeout = f"{max(min(left, 10.0), 0.5):.1f}s"
            return Client(address, security=scheduler.security, timeout=timeout, set_as_default=False)
        except (OSError, TimeoutError, RuntimeError) as error:
            if time.monotonic() >= end:
                raise StoppedError(
                    f"no scheduler answers at {address} within {wait:g} s ({error}); does `dask scheduler` run there? "
                    "Finished runs are kept, --resume goes on"
                ) from None
            time.sleep(0.5)
        except ValueError as error:
            raise StudyError(f"scheduler '{address}' is no address: {error}") from error


def check_workers(client: Client, folder: Path, source: str) -> None:
    """Have every worker look for the study in its folder, and tell which code it runs.

    Raises:
        StudyError: if one does not see it, can't write there, or has other code.
    """
    for worker, (said, theirs) in client.run(look, str(folder)).items():
        if said:
            raise StudyError(
                f"worker {worker} can't use {folder}: {said}. Workers on other machines need a folder that all share, "
                "under the same name (NFS, Lustre, a persistent volume)"
            )
        if theirs != source:
            raise StudyError(
                f"worker {worker} has another version of cloth_sim_ros ({theirs}, here {source}): its bits may differ; "
                "install the same one there"
            )


def look(folder: str) -> tuple[str, str]:
    """On a worker: what is wrong with the folder as seen from here (nothing: empty), and the code's version."""
    import secrets
    import socket

    from cloth_sim_ros.simulation.environment import environment

    known = environment()
    version = f"{known['version']}, {known['source']}, numerics {known['numerics']}"
    place = Path(folder)
    probe = place / f".unfinished-probe-{socket.gethostname()}-{os.getpid()}-{secrets.token_hex(4)}"
    try:
        (place / "study.json").stat()
        probe.write_text("seen")
        probe.unlink()
    except OSError as error:
        return f"{error.strerror} ({error.filename})", version
    return "", version


def own_version() -> str:
    """This process's code, as `look` tells it."""
    from cloth_sim_ros.simulation.environment import environment

    known = environment()
    return f"{known['version']}, {known['source']}, numerics {known['numerics']}"


def _be_quiet() -> None:
    """Lost connections are dealt with here; Dask's own words on them would bury what matters."""
    for name in ("distributed", "distributed.client", "distributed.nanny", "distributed.worker", "distributed.core"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
