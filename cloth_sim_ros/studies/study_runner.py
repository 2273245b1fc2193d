# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Scheduler of a study's runs on a Dask cluster.

The study runner submits a bounded number of tasks until each run has a row in the folder. A run is finished if its row
exists. If a worker, the scheduler or this process is lost, the pending runs are repeated.
"""

from __future__ import annotations

import collections
import contextlib
import time
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

import attrs

from cloth_sim_ros.studies import cluster
from cloth_sim_ros.studies.errors import FolderError, StoppedError, StudyError, folder_error
from cloth_sim_ros.studies.folder import StudyFolder, read_row
from cloth_sim_ros.studies.study import Study
from cloth_sim_ros.studies.study_run import FAILED, KILLED, empty_row, perform_all
from cloth_sim_ros.studies.user_code import format_error

if TYPE_CHECKING:
    from distributed import Client

#: Pending tasks per thread of the cluster: one runs, one waits.
_TASKS_PER_THREAD = 2
#: Wall time of a task of several short runs, approximately [s].
_TASK_SECONDS = 1.0
#: Limit of the number of runs in a task.
_MAX_RUNS_PER_TASK = 100
#: Time between two queries of the cluster's size [s].
_CLUSTER_POLL_PERIOD = 5.0
#: Dask abandons a task after several workers died with it. A run is abandoned after this many such failures.
_MAX_KILLS = 3


class _SchedulerGoneError(RuntimeError):
    """Error of a scheduler that was restarted and has lost its tasks."""


@attrs.define
class StudyRunner:
    """Execution of a study's unfinished runs on a Dask cluster.

    Args:
        study_folder: the study's folder.
        study: the study.
        samples: values of the factors for each run.
        seconds_per_run: approximate wall time of a run [s].
        on_progress: called with the index and the row of each finished run.
        on_message: called with each message for the user.
    """

    study_folder: StudyFolder
    study: Study
    samples: Sequence[tuple[Any, ...]]
    seconds_per_run: float
    on_progress: Callable[[int, dict[str, Any]], None]
    on_message: Callable[[str], None] = print
    _kills: collections.Counter[int] = attrs.field(factory=collections.Counter, init=False)

    def run(self, address: cluster.SchedulerAddress | str, runs: Iterable[int], *, wait: float) -> None:
        """Execute runs on a Dask cluster until each has a row; reconnect if the scheduler is lost.

        Args:
            address: address of the scheduler; a text such as ``tcp://host:8786`` if it needs no certificate.
            runs: indices of the runs.
            wait: time limit for a lost scheduler to return [s].

        Raises:
            FolderError: if the folder can't be written.
            StoppedError: if the scheduler does not return.
            StudyError: if a worker can't execute the study.
        """
        scheduler = cluster.SchedulerAddress(address) if isinstance(address, str) else address
        remaining = list(runs)
        last_progress = time.monotonic()
        while remaining:
            client = cluster.connect(scheduler, wait=wait)
            try:
                cluster.check_workers(client, self.study_folder.path, cluster.local_version())
                self._run_tasks(client, remaining)
            except StudyError:
                raise
            except Exception as error:  # A broken connection raises errors of several types.
                if client.status == "running" and not isinstance(error, _SchedulerGoneError | OSError):
                    raise
                self.on_message(f"the connection to the scheduler at {scheduler.address} broke ({error}); reconnecting")
                time.sleep(1.0)
            finally:
                _close(client)
            n_before, remaining = len(remaining), [run for run in remaining if not self._report_if_finished(run)]
            if len(remaining) < n_before:
                last_progress = time.monotonic()
            elif time.monotonic() - last_progress > wait:
                cause = f"the connection to the scheduler at {scheduler.address} breaks repeatedly"
                raise StoppedError(f"{cause}; finished runs are kept; continue with --resume")

    def _run_tasks(self, client: Client, runs: Sequence[int]) -> None:
        from distributed import as_completed

        queue = collections.deque(self._batches(runs, client))
        pending: dict[Any, list[int]] = {}
        completed = as_completed(loop=client.loop)
        last_poll, max_pending = 0.0, 1
        attempts = 0
        try:
            while queue or pending:
                if time.monotonic() - last_poll > _CLUSTER_POLL_PERIOD:
                    last_poll, max_pending = time.monotonic(), self._max_pending_tasks(client)
                while queue and len(pending) < max_pending:
                    batch = queue.popleft()
                    attempts += 1
                    folder, samples = str(self.study_folder.path), [(run, self.samples[run]) for run in batch]
                    key = f"cloth_batch-{batch[0]}-{attempts}-{time.time_ns()}"
                    future = client.submit(perform_all, folder, samples, key=key, pure=False)
                    pending[future] = batch
                    completed.add(future)
                future = next(completed)
                batch = pending.pop(future)
                queue.extendleft(self._collect(future, batch))
                future.release()
        finally:
            if pending and client.status == "running":
                client.cancel(list(pending), force=True)

    def _max_pending_tasks(self, client: Client) -> int:
        """Return the maximum number of submitted tasks, in proportion to the cluster's threads."""
        threads = sum(client.nthreads().values())
        if not threads:
            self.on_message("the cluster has no worker yet; start some: dask worker ADDRESS --nthreads 1")
        return max(_TASKS_PER_THREAD * threads, _TASKS_PER_THREAD)

    def _batches(self, runs: Sequence[int], client: Client) -> list[list[int]]:
        """Divide runs into batches, one for each Dask task."""
        threads = max(sum(client.nthreads().values()), 1)
        fitting = int(_TASK_SECONDS / max(self.seconds_per_run, 1e-3))
        size = max(min(fitting, _MAX_RUNS_PER_TASK, len(runs) // (4 * threads)), 1)
        return [list(runs[k : k + size]) for k in range(0, len(runs), size)]

    def _collect(self, future: Any, batch: list[int]) -> list[list[int]]:
        """Report an ended task's finished runs, record failed ones; return batches to be submitted again."""
        from distributed import KilledWorker

        if future.status == "cancelled":
            raise _SchedulerGoneError("the scheduler lost its tasks")
        if future.status == "finished":
            return [[run] for run in batch if not self._report_if_finished(run)]
        error = future.exception()
        if isinstance(error, FolderError):
            raise error
        unfinished = [run for run in batch if not self._report_if_finished(run)]
        if len(unfinished) > 1:
            # One run may have caused the failure, therefore each is repeated alone.
            return [[run] for run in unfinished]
        for run in unfinished:
            if isinstance(error, KilledWorker):
                self._kills[run] += 1
                if self._kills[run] < _MAX_KILLS:
                    return [[run]]
                message = "every worker that executed it was killed: out of memory, or a crash of a library"
                self._record_failure(run, KILLED, message)
            else:
                self._record_failure(run, FAILED, format_error(error))
        return []

    def _record_failure(self, run: int, status: str, message: str) -> None:
        factor_levels = dict(zip((factor.name for factor in self.study.factors), self.samples[run], strict=True))
        try:
            self.study_folder.write_row(empty_row(self.study, run, factor_levels, status=status, error=message))
        except OSError as error:
            raise folder_error(self.study_folder.path, error) from error
        self._report_if_finished(run)

    def _report_if_finished(self, run: int) -> bool:
        """Call `on_progress` for a run if it is finished; return True then."""
        row = read_row(self.study_folder.row_file(run))
        if row is None:
            return False
        self.on_progress(run, row)
        return True


def _close(client: Client) -> None:
    """Close a connection to a scheduler, even if the scheduler no longer exists."""
    with contextlib.suppress(Exception):
        client.close(timeout=2)
