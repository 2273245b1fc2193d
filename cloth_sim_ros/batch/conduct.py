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

from cloth_sim_ros.batch import cluster
from cloth_sim_ros.batch.errors import FolderError, StoppedError, StudyError, folder_error
from cloth_sim_ros.batch.folder import StudyFolder, read_row
from cloth_sim_ros.batch.study import Study
from cloth_sim_ros.batch.study_run import FAILED, KILLED, empty_row, perform_all
from cloth_sim_ros.batch.user_code import in_words

if TYPE_CHECKING:
    from distributed import Client

#: Pending tasks per thread of the cluster: one runs, one waits.
_AHEAD = 2
#: Wall time of a task of several short runs, approximately [s].
_TASK_SECONDS = 1.0
#: Limit of the number of runs in a task.
_MOST_TOGETHER = 100
#: Time between two queries of the cluster's size [s].
_LOOK_AGAIN = 5.0
#: Dask abandons a task after several workers died with it. A run is abandoned after this many such failures.
_MOST_KILLS = 3


class _LostError(RuntimeError):
    """The scheduler lost its tasks."""


@attrs.define
class Conductor:
    """Executes the unfinished runs of a study on a cluster.

    Args:
        study_folder: the study's folder.
        study: the study.
        samples: values of the factors for each run.
        seconds_per_run: approximate wall time of a run [s].
        on_progress: called with the index and the row of each finished run.
        on_message: called with each message for the user.
    """

    place: StudyFolder
    study: Study
    samples: Sequence[tuple[Any, ...]]
    seconds: float
    finished: Callable[[int, dict[str, Any]], None]
    say: Callable[[str], None] = print
    _kills: collections.Counter[int] = attrs.field(factory=collections.Counter, init=False)

    def conduct(self, address: cluster.SchedulerAddress | str, runs: Iterable[int], *, wait: float) -> None:
        """Execute runs on a cluster.

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
        left = list(runs)
        progressed = time.monotonic()
        while left:
            client = cluster.connect(scheduler, wait=wait)
            try:
                cluster.check_workers(client, self.place.path, cluster.own_version())
                self._drive(client, left)
            except StudyError:
                raise
            except Exception as error:  # A broken connection raises errors of several types.
                if client.status == "running" and not isinstance(error, _LostError | OSError):
                    raise
                self.say(f"the connection to the scheduler at {scheduler.address} broke ({error}); reconnecting")
                time.sleep(1.0)
            finally:
                _close(client)
            before, left = len(left), [run for run in left if not self._note(run)]
            if len(left) < before:
                progressed = time.monotonic()
            elif time.monotonic() - progressed > wait:
                raise StoppedError(
                    f"the connection to the scheduler at {scheduler.address} breaks repeatedly; finished runs are "
                    "kept; continue with --resume"
                )

    def _drive(self, client: Client, runs: Sequence[int]) -> None:
        from distributed import as_completed

        waiting = collections.deque(self._parts(runs, client))
        pending: dict[Any, list[int]] = {}
        completed = as_completed(loop=client.loop)
        looked, room = 0.0, 1
        attempts = 0
        try:
            while waiting or pending:
                if time.monotonic() - looked > _LOOK_AGAIN:
                    looked, room = time.monotonic(), self._room(client)
                while waiting and len(pending) < room:
                    part = waiting.popleft()
                    attempts += 1
                    future = client.submit(
                        perform_all,
                        str(self.place.path),
                        [(run, self.samples[run]) for run in part],
                        key=f"cloth_batch-{part[0]}-{attempts}-{time.time_ns()}",
                        pure=False,
                    )
                    pending[future] = part
                    completed.add(future)
                future = next(completed)
                part = pending.pop(future)
                waiting.extendleft(self._take(future, part))
                future.release()
        finally:
            if pending and client.status == "running":
                client.cancel(list(pending), force=True)

    def _room(self, client: Client) -> int:
        """Return the limit of pending tasks."""
        threads = sum(client.nthreads().values())
        if not threads:
            self.say("the cluster has no worker yet; start some: dask worker ADDRESS --nthreads 1")
        return max(_AHEAD * threads, _AHEAD)

    def _parts(self, runs: Sequence[int], client: Client) -> list[list[int]]:
        """Divide runs into batches, one task each."""
        threads = max(sum(client.nthreads().values()), 1)
        together = min(int(_TASK_SECONDS / max(self.seconds, 1e-3)), _MOST_TOGETHER, len(runs) // (4 * threads))
        size = max(together, 1)
        return [list(runs[k : k + size]) for k in range(0, len(runs), size)]

    def _take(self, future: Any, part: list[int]) -> list[list[int]]:
        """Process the end of a task and return the batches that must be repeated."""
        from distributed import KilledWorker

        if future.status == "cancelled":
            raise _LostError("the scheduler lost its tasks")
        if future.status == "finished":
            return [[run] for run in part if not self._note(run)]
        error = future.exception()
        if isinstance(error, FolderError):
            raise error
        left = [run for run in part if not self._note(run)]
        if len(left) > 1:
            # One run may have caused the failure, therefore each is repeated alone.
            return [[run] for run in left]
        for run in left:
            if isinstance(error, KilledWorker):
                self._kills[run] += 1
                if self._kills[run] < _MOST_KILLS:
                    return [[run]]
                words = "every worker that executed it was killed: out of memory, or a crash of a library"
                self._give_up(run, KILLED, words)
            else:
                self._give_up(run, FAILED, in_words(error))
        return []

    def _give_up(self, run: int, status: str, words: str) -> None:
        named = dict(zip((factor.name for factor in self.study.factors), self.samples[run], strict=True))
        try:
            self.place.write_row(empty_row(self.study, run, named, status=status, error=words))
        except OSError as error:
            raise folder_error(self.place.path, error) from error
        self._note(run)

    def _note(self, run: int) -> bool:
        """Return true if a run is finished, after a call of `on_progress`."""
        row = read_row(self.place.row_file(run))
        if row is None:
            return False
        self.finished(run, row)
        return True


def _close(client: Client) -> None:
    """Close a connection, also if the scheduler no longer exists."""
    with contextlib.suppress(Exception):
        client.close(timeout=2)
