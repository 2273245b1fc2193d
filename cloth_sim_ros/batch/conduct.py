# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Conducts a study: hands its runs to a Dask cluster, a bounded number at a time, until each has its row.

What is finished is told by the rows in the folder alone. Whatever gets lost (workers, the scheduler, this process)
costs the runs that were under way, which are done again.
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

#: Tasks on their way for each thread of the cluster: one that runs, one that waits beside it.
_AHEAD = 2
#: Runs that are short go together into a task of about this wall time [s] ...
_TASK_SECONDS = 1.0
#: ... of so many at most.
_MOST_TOGETHER = 100
#: How often the cluster is asked for its size [s].
_LOOK_AGAIN = 5.0
#: Dask gives a task up when several workers died with it. If that happens so often to a run alone, it kills them.
_MOST_KILLS = 3


class _LostError(RuntimeError):
    """The scheduler is gone."""


@attrs.define
class Conductor:
    """Runs what is left of a study.

    Args:
        place: its folder.
        study: what is run.
        samples: each run's values.
        seconds: what a run takes, about [s].
        finished: told the number of each run as it is finished, and its row.
        say: told what else happens.
    """

    place: StudyFolder
    study: Study
    samples: Sequence[tuple[Any, ...]]
    seconds: float
    finished: Callable[[int, dict[str, Any]], None]
    say: Callable[[str], None] = print
    _kills: collections.Counter[int] = attrs.field(factory=collections.Counter, init=False)

    def conduct(self, address: cluster.SchedulerAddress | str, runs: Iterable[int], *, wait: float) -> None:
        """Run some runs on a cluster.

        Args:
            address: of the cluster's scheduler; a text such as ``tcp://host:8786`` for one without a certificate.
            runs: their numbers.
            wait: how long a scheduler that is gone is waited for [s].

        Raises:
            FolderError: if the folder can't be written.
            StoppedError: if the scheduler stays away.
            StudyError: if a worker can't work on it.
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
            except Exception as error:  # What a broken connection raises is not one kind of error.
                if client.status == "running" and not isinstance(error, _LostError | OSError):
                    raise
                self.say(f"the connection to the scheduler at {scheduler.address} broke ({error}); connecting anew")
                time.sleep(1.0)
            finally:
                _close(client)
            before, left = len(left), [run for run in left if not self._note(run)]
            if len(left) < before:
                progressed = time.monotonic()
            elif time.monotonic() - progressed > wait:
                raise StoppedError(
                    f"the connection to the scheduler at {scheduler.address} breaks again and again; finished runs are "
                    "kept, --resume goes on"
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
        """How many tasks may be on their way."""
        threads = sum(client.nthreads().values())
        if not threads:
            self.say("there is no worker yet; start some: dask worker ADDRESS --nthreads 1")
        return max(_AHEAD * threads, _AHEAD)

    def _parts(self, runs: Sequence[int], client: Client) -> list[list[int]]:
        """Runs that go into a task together."""
        threads = max(sum(client.nthreads().values()), 1)
        together = min(int(_TASK_SECONDS / max(self.seconds, 1e-3)), _MOST_TOGETHER, len(runs) // (4 * threads))
        size = max(together, 1)
        return [list(runs[k : k + size]) for k in range(0, len(runs), size)]

    def _take(self, future: Any, part: list[int]) -> list[list[int]]:
        """Take note of a task's end; what must be done again, in parts."""
        from distributed import KilledWorker

        if future.status == "cancelled":
            raise _LostError("it forgot its tasks")
        if future.status == "finished":
            return [[run] for run in part if not self._note(run)]
        error = future.exception()
        if isinstance(error, FolderError):
            raise error
        left = [run for run in part if not self._note(run)]
        if len(left) > 1:
            # One of them may be the reason: each alone.
            return [[run] for run in left]
        for run in left:
            if isinstance(error, KilledWorker):
                self._kills[run] += 1
                if self._kills[run] < _MOST_KILLS:
                    return [[run]]
                words = "every worker that tried it was killed: out of memory, or a crash of a library"
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
        """Whether a run is finished; if so, it is told."""
        row = read_row(self.place.row_file(run))
        if row is None:
            return False
        self.finished(run, row)
        return True


def _close(client: Client) -> None:
    """Close a connection whose other end may be gone."""
    with contextlib.suppress(Exception):
        client.close(timeout=2)
