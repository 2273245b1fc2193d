# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Evaluations at equal achieved error: this tree's step control against that of an older commit.

The older tree runs its own `cloth_bench tolerance` in its own environment. Scenes, references and the meaning of an
error are the same in both.
"""

from __future__ import annotations

import itertools
import json
import math
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from cloth_sim_ros.bench.old_tree import OldTree, prepare
from cloth_sim_ros.bench.peer_environment import EnvironmentUnusable, clean_variables, last_line
from cloth_sim_ros.bench.report import Table

#: What this tree takes at most of the older one's evaluations.
MOST = 1.1

#: Achieved error [m] and evaluations of one run.
Run = tuple[float, int]


def of_older_tree(commit: str, scenes: Iterable[str], tolerances: Iterable[float]) -> dict[str, list[Run]]:
    """Return the runs of an older commit by scene; made in its own environment.

    Raises:
        EnvironmentUnusable: where that commit can't be run here.
    """
    older = prepare(commit, lambda text: print(f"cloth_bench: {text}", file=sys.stderr))
    with tempfile.TemporaryDirectory() as folder:
        return runs_by_scene(_measured_by(older, list(scenes), list(tolerances), Path(folder) / "tolerance.json"))


def _measured_by(older: OldTree, scenes: Sequence[str], tolerances: Sequence[float], answer: Path) -> Table:
    command = [str(older.python), "-m", "cloth_sim_ros.bench.main", "tolerance", "--json", str(answer)]
    command += ["--scenes", *scenes, "--tolerances", *map(str, tolerances)]
    variables = clean_variables(PYTHONPATH=str(older.tree))
    done = subprocess.run(command, env=variables, cwd=older.tree, capture_output=True, text=True, check=False)
    # Its exit status tells whether its own promises held, which is not what is asked here.
    if not answer.exists():
        raise EnvironmentUnusable(f"{older.commit[:12]} measured nothing: {last_line(done.stderr + done.stdout)}")
    return Table(**json.loads(answer.read_text())["tables"][0])


def runs_by_scene(table: Table) -> dict[str, list[Run]]:
    """Return the runs that a table of achieved errors holds, by scene."""
    scene, error, count = (table.columns.index(name) for name in ("scene", "achieved m", "evaluations"))
    runs: dict[str, list[Run]] = {}
    for row in table.rows:
        runs.setdefault(row[scene], []).append((float(row[error]), int(row[count])))
    return runs


def evaluations_at(runs: Sequence[Run], error: float) -> float:
    """Return the evaluations that it takes to achieve an error [m].

    Between two runs the logarithm of the count is linear in that of the error. A run that another one beats in both is
    left out, as nobody would choose it. NaN for an error smaller than any that was achieved.
    """
    best: list[Run] = []
    for achieved, count in sorted(runs):
        if not best or count < best[-1][1]:
            best.append((achieved, count))
    if not best or error < best[0][0]:
        return math.nan
    for (low, dear), (high, cheap) in itertools.pairwise(best):
        if low <= error <= high:
            share = math.log(error / low) / math.log(high / low)
            return math.exp((1.0 - share) * math.log(dear) + share * math.log(cheap))
    return float(best[-1][1])


def compared(new: dict[str, list[Run]], old: dict[str, list[Run]], commit: str) -> tuple[Table, list[str]]:
    """Return the table, at every error that the older tree achieved, and what is above the limit."""
    columns: list[str] = ["scene", "error m", f"{commit} evaluations", "evaluations", "ratio"]
    table, missed, ratios = Table(f"Evaluations at equal achieved error, against {commit}", columns), [], []
    for scene, runs in old.items():
        for error, _ in sorted(set(runs), reverse=True):
            before, now = evaluations_at(runs, error), evaluations_at(new[scene], error)
            row: list[Any] = [scene, error, round(before), now if math.isnan(now) else round(now), now / before]
            table.rows.append(row)
            if not math.isnan(now):
                ratios.append(now / before)
                if now > MOST * before:
                    missed.append(f"{scene} at {error:.2g} m takes {now / before:.2f} of {commit}'s evaluations")
    if ratios:
        mean = math.exp(sum(map(math.log, ratios)) / len(ratios))
        table.rows.append(["geometric mean", "", "", "", mean])
    return table, missed
