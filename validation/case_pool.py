# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Many independent cases in worker processes, each with a limit of wall time after which its process is ended."""

from __future__ import annotations

import json
import multiprocessing
import time
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, Generic, TypeVar

import attrs

C = TypeVar("C")
R = TypeVar("R")
_CONTEXT = multiprocessing.get_context("spawn")


@attrs.frozen
class Done(Generic[C, R]):
    """What became of a case."""

    case: C
    #: None where the case did not come to an end.
    result: R | None
    #: Wall time [s].
    seconds: float
    #: Why it did not come to an end; empty if it did.
    trouble: str = ""


class _Worker(Generic[C, R]):
    """One process, and the case that it is at."""

    def __init__(self, run: Callable[[C], R]) -> None:
        self.connection, theirs = _CONTEXT.Pipe()
        self.process = _CONTEXT.Process(target=_serve, args=(theirs, run), daemon=True)
        self.process.start()
        theirs.close()
        self.case: C | None = None
        #: When its case ends at the latest; None while the process starts, which is not timed.
        self.deadline: float | None = None
        self.started = 0.0

    def give(self, case: C, limit: float) -> None:
        self.case, self.started = case, time.monotonic()
        self.deadline = self.started + limit
        self.connection.send(case)

    def end(self) -> None:
        self.connection.close()
        self.process.kill()
        self.process.join()


def run_cases(run: Callable[[C], R], cases: Sequence[C], *, workers: int, limit: float) -> Iterator[Done[C, R]]:
    """Yield what became of each case, in the order in which they end.

    Args:
        run: runs one case; must be importable by name, as the cases and results must be picklable.
        cases: what to run.
        workers: number of processes.
        limit: wall time of one case [s].
    """
    waiting = list(reversed(cases))
    pool: list[_Worker[C, R]] = [_Worker(run) for _ in range(min(workers, len(cases)))]
    try:
        while pool:
            ends = [worker.deadline for worker in pool if worker.deadline is not None]
            timeout = max(0.0, min(ends) - time.monotonic()) if ends else None
            ready: list[Any] = wait([worker.connection for worker in pool], timeout)
            for worker in list(pool):
                done: Done[C, R] | None = None
                if worker.connection in ready:
                    done = _receive(worker)
                elif worker.deadline is not None and time.monotonic() >= worker.deadline and worker.case is not None:
                    done = Done(worker.case, None, limit, f"took longer than {limit:g} s")
                else:
                    continue
                if done is not None:
                    yield done
                if done is not None and done.result is None:
                    worker.end()
                    pool.remove(worker)
                    if waiting:
                        pool.append(_Worker(run))
                elif waiting:
                    worker.give(waiting.pop(), limit)
                else:
                    worker.end()
                    pool.remove(worker)
    finally:
        for worker in pool:
            worker.end()


def run_missing(
    run: Callable[[C], R],
    cases: Sequence[C],
    *,
    workers: int,
    limit: float,
    file: Path | None,
    read: Callable[[dict[str, Any]], Done[C, R]],
) -> Iterator[Done[C, R]]:
    """Yield what became of each case: what a file has of it, else as `run_cases`, kept in the file as it comes.

    Args:
        run: as for `run_cases`.
        cases: as for `run_cases`; none twice.
        workers: number of processes.
        limit: wall time of one case [s].
        file: a line of JSON a case; None keeps nothing. A last line that was cut off counts for nothing.
        read: makes of a line what was written.
    """
    known: dict[C, Done[C, R]] = {}
    for line in file.read_text().splitlines() if file is not None and file.exists() else []:
        try:
            entry = json.loads(line)
        except json.JSONDecodeError:
            continue
        done = read(entry)
        known[done.case] = done
    yield from (known[case] for case in cases if case in known)
    left = [case for case in cases if case not in known]
    for done in run_cases(run, left, workers=workers, limit=limit) if left else ():
        if file is not None:
            with file.open("a") as out:
                out.write(json.dumps(attrs.asdict(done), default=_plain) + "\n")
        yield done


def shown(dones: Iterator[Done[C, R]], total: int, unit: str) -> Any:
    """Yield what became of each case, beside a progress bar."""
    from tqdm import tqdm

    return tqdm(dones, total=total, unit=unit, smoothing=0.02, mininterval=1.0)


def _plain(number: Any) -> Any:
    """A number of numpy as Python's own."""
    return number.item()


def _receive(worker: _Worker[C, R]) -> Done[C, R] | None:
    """What a process has to say; None that it is ready."""
    case, seconds = worker.case, time.monotonic() - worker.started
    try:
        result = worker.connection.recv()
    except EOFError:
        if case is None:
            raise RuntimeError("a process ended before its first case: what it printed says why") from None
        return Done(case, None, seconds, "its process ended")
    return None if case is None else Done(case, result, seconds)


def _serve(connection: Connection, run: Callable[[C], R]) -> None:
    """Body of a process."""
    connection.send(None)
    while True:
        try:
            case = connection.recv()
        except EOFError:
            return
        connection.send(run(case))
