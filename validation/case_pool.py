# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pool of worker processes for independent cases with a wall time limit."""

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
class CaseResult(Generic[C, R]):
    """Result of one case, or the reason why it has none."""

    case: C
    #: None if the case did not finish.
    result: R | None
    #: Wall time [s].
    seconds: float
    #: Reason why it did not finish; empty if it did.
    trouble: str = ""


class _Worker(Generic[C, R]):
    """One process and its current case."""

    def __init__(self, run: Callable[[C], R]) -> None:
        self.connection, child_connection = _CONTEXT.Pipe()
        self.process = _CONTEXT.Process(target=_serve, args=(child_connection, run), daemon=True)
        self.process.start()
        child_connection.close()
        self.case: C | None = None
        #: Time at which its case is aborted; None while the process starts, which is not timed.
        self.deadline: float | None = None
        self.started = 0.0

    def assign(self, case: C, limit: float) -> None:
        self.case, self.started = case, time.monotonic()
        self.deadline = self.started + limit
        self.connection.send(case)

    def stop(self) -> None:
        self.connection.close()
        self.process.kill()
        self.process.join()


def run_cases(run: Callable[[C], R], cases: Sequence[C], *, workers: int, limit: float) -> Iterator[CaseResult[C, R]]:
    """Yield the result of each case, in the order in which they end.

    Args:
        run: runs one case; must be importable by name. Cases and results must be picklable.
        cases: the cases to run.
        workers: number of processes.
        limit: wall time of one case [s].
    """
    pending = list(reversed(cases))
    pool: list[_Worker[C, R]] = [_Worker(run) for _ in range(min(workers, len(cases)))]
    try:
        while pool:
            deadlines = [worker.deadline for worker in pool if worker.deadline is not None]
            timeout = max(0.0, min(deadlines) - time.monotonic()) if deadlines else None
            ready: list[Any] = wait([worker.connection for worker in pool], timeout)
            for worker in list(pool):
                case_result: CaseResult[C, R] | None = None
                if worker.connection in ready:
                    case_result = _receive(worker)
                elif worker.deadline is not None and time.monotonic() >= worker.deadline and worker.case is not None:
                    case_result = CaseResult(worker.case, None, limit, f"took longer than {limit:g} s")
                else:
                    continue
                if case_result is not None:
                    yield case_result
                if case_result is not None and case_result.result is None:
                    worker.stop()
                    pool.remove(worker)
                    if pending:
                        pool.append(_Worker(run))
                elif pending:
                    worker.assign(pending.pop(), limit)
                else:
                    worker.stop()
                    pool.remove(worker)
    finally:
        for worker in pool:
            worker.stop()


def run_missing(
    run: Callable[[C], R],
    cases: Sequence[C],
    *,
    workers: int,
    limit: float,
    file: Path | None,
    read: Callable[[dict[str, Any]], CaseResult[C, R]],
) -> Iterator[CaseResult[C, R]]:
    """Yield the result of each case: from a file, or else from `run_cases`, which is then appended to the file.

    Args:
        run: as for `run_cases`.
        cases: as for `run_cases`; none twice.
        workers: number of processes.
        limit: wall time of one case [s].
        file: one line of JSON per case; None stores nothing. A truncated last line is ignored.
        read: converts a line back to a result.
    """
    recorded: dict[C, CaseResult[C, R]] = {}
    for line in file.read_text().splitlines() if file is not None and file.exists() else []:
        try:
            entry = json.loads(line)
        except json.JSONDecodeError:
            continue
        case_result = read(entry)
        recorded[case_result.case] = case_result
    yield from (recorded[case] for case in cases if case in recorded)
    missing = [case for case in cases if case not in recorded]
    for case_result in run_cases(run, missing, workers=workers, limit=limit) if missing else ():
        if file is not None:
            with file.open("a") as stream:
                stream.write(json.dumps(attrs.asdict(case_result), default=_to_python) + "\n")
        yield case_result


def show_progress(results: Iterator[CaseResult[C, R]], total: int, unit: str) -> Any:
    """Yield the result of each case and draw a progress bar."""
    from tqdm import tqdm

    return tqdm(results, total=total, unit=unit, smoothing=0.02, mininterval=1.0)


def _to_python(scalar: Any) -> Any:
    """Convert a numpy scalar to a Python number."""
    return scalar.item()


def _receive(worker: _Worker[C, R]) -> CaseResult[C, R] | None:
    """Receive a result from a process; None means that the process is ready."""
    case, seconds = worker.case, time.monotonic() - worker.started
    try:
        result = worker.connection.recv()
    except EOFError:
        if case is None:
            raise RuntimeError("a worker process ended before its first case; its output states the cause") from None
        return CaseResult(case, None, seconds, "its process ended")
    return None if case is None else CaseResult(case, result, seconds)


def _serve(connection: Connection, run: Callable[[C], R]) -> None:
    """Run cases in a worker process until its connection closes."""
    connection.send(None)
    while True:
        try:
            case = connection.recv()
        except EOFError:
            return
        connection.send(run(case))
