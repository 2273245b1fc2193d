# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Trees driven as processes of their own: both packages have one name, so no process can hold both."""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import IO, Any

import attrs

from cloth_sim_ros.bench.peer_environment import clean_variables

WORKER = Path(__file__).parent / "engine_worker.py"
ROOT = Path(__file__).resolve().parent.parent.parent
#: What the older tree's compiler is told of a processor that shall have no wider vectors than AVX2.
NARROW = "x86-64-v3"
#: Turns of each that a median needs at least.
FEWEST_ROUNDS = 3


class SideFailed(ValueError):
    """A tree could not measure what it was asked for."""


class Side:
    """One tree at work.

    Args:
        name: in tables and messages.
        tree: folder that holds its package.
        python: its Python.
        variables: of its environment, beside this process's.
        worker: script that it runs.
    """

    def __init__(
        self,
        name: str,
        *,
        tree: Path = ROOT,
        python: Path = Path(sys.executable),
        variables: Mapping[str, str] | None = None,
        worker: Path = WORKER,
    ) -> None:
        self.name = name
        self._process = subprocess.Popen(
            [str(python), "-P", str(worker)],
            env=clean_variables(PYTHONPATH=str(tree), **(variables or {})),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def measure(self, job: str, **options: Any) -> dict[str, Any]:
        """Return a job's figures, see `engine_jobs`.

        Raises:
            SideFailed: with what the other process said.
        """
        return self._ask({"measure": job, **options})

    def forget(self) -> None:
        """Let it free what it made ready."""
        self._ask({"forget": True})

    def _ask(self, request: dict[str, Any]) -> dict[str, Any]:
        what = request.get("measure", "forget")
        try:
            _pipe(self._process.stdin).write(json.dumps(request) + "\n")
            _pipe(self._process.stdin).flush()
            line = _pipe(self._process.stdout).readline()
        except BrokenPipeError:
            line = ""
        if not line:
            raise SideFailed(
                f"{self.name} ended at '{what}' with status {self._process.wait()}; see what it said above"
            )
        figures: dict[str, Any] = json.loads(line)
        if "error" in figures:
            raise SideFailed(f"{self.name} can't do '{what}': {figures['error']}")
        return figures

    def close(self) -> None:
        """End the process."""
        _pipe(self._process.stdin).close()
        self._process.wait()
        _pipe(self._process.stdout).close()

    def __enter__(self) -> Side:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if kind is not None:
            # Whatever it is busy with.
            self._process.kill()
        self.close()


@attrs.frozen(kw_only=True)
class Pair:
    """Figures of two sides, one a round each."""

    old: list[dict[str, Any]]
    new: list[dict[str, Any]]

    def ratios(self, name: str = "seconds") -> list[float]:
        """A figure of the new over that of the old, round by round."""
        return [b[name] / a[name] for a, b in zip(self.old, self.new, strict=True)]

    def ratio(self, name: str = "seconds") -> float:
        """Median of the ratios."""
        return statistics.median(self.ratios(name))


def median(figures: Sequence[dict[str, Any]], name: str = "seconds") -> float:
    """Median of one figure."""
    return statistics.median(one[name] for one in figures)


def in_turns(
    sides: Sequence[Side], job: str, options: Mapping[str, Any], *, rounds: int, say: Callable[[str], None]
) -> list[list[dict[str, Any]]]:
    """Let sides measure a job in turns, the order turned round each time, after a round that is not counted.

    Returns:
        Of each side its figures, a round each.
    """
    found: list[list[dict[str, Any]]] = [[] for _ in sides]
    for side in sides:
        side.measure(job, **options)
    order = list(range(len(sides)))
    for number in range(max(rounds, FEWEST_ROUNDS)):
        say(f"{job} {' '.join(f'{k}={v}' for k, v in options.items())}: round {number + 1}")
        for k in order:
            found[k].append(sides[k].measure(job, **options))
        order.reverse()
    for side in sides:
        side.forget()
    return found


def _pipe(pipe: IO[str] | None) -> IO[str]:
    assert pipe is not None
    return pipe
