# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pool of worker processes for independent cases with a wall time limit."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import time
import types
import typing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any, Generic, TypeVar

import attrs

from cloth_sim_ros.session.child_process import exit_with_parent
from validation.report import Report

C = TypeVar("C")
R = TypeVar("R")


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
    """One process, which runs one case at a time."""

    def __init__(self, run: Callable[[C], R]) -> None:
        from loky.process_executor import ProcessPoolExecutor

        self._run = run
        self._executor = ProcessPoolExecutor(1, initializer=exit_with_parent, initargs=(os.getpid(),))
        # The start of the process and its imports are not timed.
        self._executor.submit(callable, run).result()

    def run(self, case: C, limit: float) -> CaseResult[C, R]:
        """Run a case; after a time limit [s] kill the process."""
        from loky.process_executor import TerminatedWorkerError

        begin = time.monotonic()
        try:
            return CaseResult(case, self._executor.submit(self._run, case).result(limit), time.monotonic() - begin)
        except TimeoutError:
            trouble = f"took longer than {limit:g} s"
        except TerminatedWorkerError:
            trouble = "its process ended"
        except Exception as error:
            trouble = f"{type(error).__name__}: {error}"
        self.kill()
        return CaseResult(case, None, time.monotonic() - begin, trouble)

    def kill(self) -> None:
        """End the process."""
        self._executor.shutdown(kill_workers=True)


@attrs.frozen
class CasePool:
    """Processes that run cases."""

    #: Number of processes, and limit of the wall time of one case [s].
    workers: int
    limit: float
    #: File of finished results, one line of JSON per case; None stores nothing. A truncated last line is ignored.
    file: Path | None = None

    def run(self, run: Callable[[C], R], cases: Sequence[C]) -> Iterator[CaseResult[C, R]]:
        """Yield the result of each case, in the order in which they end.

        Args:
            run: runs one case; must be importable by name. Cases and results must be picklable.
            cases: the cases to run.
        """
        workers: set[_Worker[C, R]] = set()
        idle: list[_Worker[C, R]] = []

        def run_case(case: C) -> CaseResult[C, R]:
            worker = idle.pop() if idle else _Worker(run)
            workers.add(worker)
            case_result = worker.run(case, self.limit)
            if not case_result.trouble:
                idle.append(worker)
            return case_result

        threads = ThreadPoolExecutor(self.workers)
        try:
            for future in as_completed([threads.submit(run_case, case) for case in cases]):
                yield future.result()
        finally:
            threads.shutdown(wait=False, cancel_futures=True)
            for worker in workers:
                worker.kill()

    def run_missing(
        self, run: Callable[[C], R], cases: Sequence[C], kinds: tuple[Any, Any]
    ) -> Iterator[CaseResult[C, R]]:
        """Yield the result of each case with a progress bar: from the file, or else from `run`, appended to the file.

        Args:
            run: as for `run`.
            cases: as for `run`; none twice.
            kinds: types of a case and of a result, see `restored`.
        """
        from tqdm import tqdm

        recorded: dict[C, CaseResult[C, R]] = {}
        missing = list(cases)
        if self.file is not None and self.file.exists():
            recorded = {done.case: done for done in read_results(self.file, kinds)}
            missing = [case for case in cases if case not in recorded]
        known = (recorded[case] for case in cases if recorded and case in recorded)
        results = itertools.chain(known, self.run(run, missing) if missing else ())
        for done in tqdm(results, total=len(cases), unit="case", smoothing=0.02, mininterval=1.0):
            if self.file is not None and done.case not in recorded:
                with self.file.open("a") as stream:
                    stream.write(json.dumps(attrs.asdict(done), default=_to_python) + "\n")
            yield done

    def report(
        self,
        run: Callable[[C], R],
        cases: Sequence[C],
        report: Report,
        *,
        name: Callable[[C], str],
        describe: Callable[[R], str],
        kinds: tuple[Any, Any] = (None, None),
    ) -> list[tuple[C, R]]:
        """Return cases and results by `run_missing`; print each, and fail those without a result.

        Args:
            run: as for `run`.
            cases: as for `run_missing`.
            report: receives the failures.
            name: returns the name of a case.
            describe: returns a line about a result.
            kinds: as for `run_missing`.
        """
        from tqdm import tqdm

        finished: list[tuple[C, R]] = []
        for done in self.run_missing(run, cases, kinds):
            if done.result is None:
                report.fail(f"{name(done.case)}: {done.trouble}")
            else:
                finished.append((done.case, done.result))
            tqdm.write(f"{name(done.case)}: {done.trouble if done.result is None else describe(done.result)}")
        return finished


def read_results(file: Path, kinds: tuple[Any, Any]) -> Iterator[CaseResult[Any, Any]]:
    """Yield the results of a file of `run_missing`."""
    for entry in read_lines(file):
        case, result = (restored(kind, entry[name]) for name, kind in zip(("case", "result"), kinds, strict=True))
        yield CaseResult(case, result, entry["seconds"], entry["trouble"])


def read_lines(file: Path) -> Iterator[Any]:
    """Yield the values of a file with one line of JSON per value, without the truncated line of an interrupted run."""
    for line in file.read_text().splitlines():
        with contextlib.suppress(json.JSONDecodeError):
            yield json.loads(line)


def restored(kind: Any, value: Any) -> Any:
    """Return the value of a type from its JSON: attrs classes, and tuples and options of them. Others stay."""
    if value is None:
        return None
    if attrs.has(kind):
        hints = typing.get_type_hints(kind)
        return kind(**{name: restored(hints[name], entry) for name, entry in value.items()})
    arguments = typing.get_args(kind)
    if typing.get_origin(kind) is types.UnionType:
        return restored(arguments[0], value)
    if typing.get_origin(kind) is tuple:
        entry_kinds = itertools.repeat(arguments[0]) if arguments[-1] is ... else arguments
        return tuple(restored(entry_kind, entry) for entry_kind, entry in zip(entry_kinds, value, strict=False))
    return value


def _to_python(scalar: Any) -> Any:
    """Convert a numpy scalar to a Python number."""
    return scalar.item()
