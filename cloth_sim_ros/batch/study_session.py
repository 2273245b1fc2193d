# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Complete execution of a study: checks, runs, index and summary."""

from __future__ import annotations

import collections
import contextlib
import re
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from cloth_sim_ros.batch import index, study_file
from cloth_sim_ros.batch.cluster import SchedulerAddress, cores, local_scheduler
from cloth_sim_ros.batch.conduct import Conductor
from cloth_sim_ros.batch.errors import FolderError, StudyError
from cloth_sim_ros.batch.folder import StudyFolder
from cloth_sim_ros.batch.forecast import attempt, check_room, draw, quantity
from cloth_sim_ros.batch.study import Study
from cloth_sim_ros.batch.study_run import KILLED, OK
from cloth_sim_ros.scene import input_file

#: Limits of a summary: kinds of failure, and runs per kind.
_KINDS, _NAMED = 5, 5


def run_study(
    path: Path,
    out: Path,
    *,
    resume: bool = False,
    retry_failed: bool = False,
    scheduler: str | None = None,
    workers: int | None = None,
    wait: float = 300.0,
) -> int:
    """Execute the unfinished runs of a study.

    Args:
        path: file of the study.
        out: folder of the results.
        resume: true if the folder may hold results already.
        retry_failed: true to repeat runs that failed by their own fault.
        scheduler: address of a Dask scheduler; by default one is started on this machine.
        workers: number of worker processes of the local scheduler.
        wait: time limit for a lost scheduler to return [s].

    Returns:
        0 if every run was successful, else 1.

    Raises:
        StudyError: before the first run, if the study or the folder is invalid.
        StoppedError: if the study can't continue.
    """
    from tqdm import tqdm

    study = study_file.read(path)
    place = StudyFolder(out)
    rows = _held(place, study, resume, retry_failed)
    count = workers or cores()
    if place.study_file.is_file():
        samples = place.samples(study)
        forecast = attempt(study, samples)
    else:
        samples, forecast = draw(study, count)
        check_room(place.path, study, forecast)
        place.create(study, samples, input_file.read_text(path))
    left = [run for run in range(study.runs) if run not in rows]
    if rows:
        tqdm.write(f"{len(rows)} of {study.runs} runs are finished, {len(left)} are left")
    elif scheduler is None:
        tqdm.write(f"{study.runs} runs take {forecast.in_words(study.runs, count)}")
    begun, before = time.perf_counter(), len(rows)
    with contextlib.ExitStack() as stack:
        stack.enter_context(place.held())
        place.remove_leftovers()
        # The stack closes in reverse order: stop the cluster, remove incomplete files, write the index.
        stack.callback(_write_index, place, rows)
        stack.callback(place.remove_leftovers)
        bar = stack.enter_context(tqdm(total=study.runs, initial=before, unit="run", desc="study", disable=None))

        def finished(run: int, row: dict[str, Any]) -> None:
            if run not in rows:
                rows[run] = row
                bar.update()

        conductor = Conductor(place, study, samples, forecast.seconds, finished, tqdm.write)
        if left:
            if scheduler is None:
                address = stack.enter_context(local_scheduler(workers, tqdm.write))
            else:
                address = SchedulerAddress(scheduler)
            conductor.conduct(address, left, wait=wait)
    index.write(place, rows.values())
    print(summary(place, rows.values(), time.perf_counter() - begun, len(rows) - before))
    return 0 if all(row["status"] == OK for row in rows.values()) else 1


def _write_index(place: StudyFolder, rows: dict[int, dict[str, Any]]) -> None:
    """Write the index; a full disk is ignored here, because the error that stopped the study reports it."""
    with contextlib.suppress(FolderError):
        index.write(place, rows.values())


def _held(place: StudyFolder, study: Study, resume: bool, retry_failed: bool) -> dict[int, dict[str, Any]]:
    """Return the rows of the finished runs in a folder, by run.

    Raises:
        StudyError: if the folder belongs to another study, or has results and `resume` is false.
    """
    if not place.study_file.is_file():
        if resume and place.path.exists() and any(place.path.iterdir()):
            raise StudyError(f"{place.path} holds no study to resume: study.json is missing; omit --resume")
        return {}
    place.check_same(study)
    rows = {int(row["run"]): row for row in place.rows()}
    if rows and not resume:
        raise StudyError(
            f"{place.path} holds {len(rows)} of {study.runs} runs of this study; continue with --resume, or "
            "start in another folder"
        )
    again = [run for run, row in rows.items() if row["status"] == KILLED or (retry_failed and row["status"] != OK)]
    for run in again:
        place.row_file(run).unlink(missing_ok=True)
        del rows[run]
    return rows


def summary(place: StudyFolder, rows: Iterable[dict[str, Any]], seconds: float, done: int) -> str:
    """Return a text summary of a study: successful runs, and failures with their causes.

    Args:
        study_folder: folder of the study.
        rows: rows of all finished runs.
        seconds: wall time of this execution [s].
        n_done: number of runs of this execution.
    """
    held = list(rows)
    failed = [row for row in held if row["status"] != OK]
    flagged = sum(row["flagged_frames"] > 0 for row in held)
    size = quantity(sum(row["bytes"] for row in held), "B")
    lines = [f"{len(held) - len(failed)} of {len(held)} runs were successful; {done} took {seconds:.1f} s; {size}"]
    if flagged:
        lines.append(f"{flagged} runs have frames that missed the tolerance (flagged_frames in the index)")
    kinds: dict[str, list[dict[str, Any]]] = collections.defaultdict(list)
    for row in failed:
        # Texts that differ only in numbers are the same kind of failure.
        kinds[re.sub(r"-?\d+(\.\d+)?(e[-+]?\d+)?", "#", row["error"])].append(row)
    for same in sorted(kinds.values(), key=len, reverse=True)[:_KINDS]:
        numbers = ", ".join(str(row["run"]) for row in same[:_NAMED]) + (", ..." if same[_NAMED:] else "")
        lines.append(f"{len(same)} failed ({numbers}): {same[0]['error']}")
    if len(kinds) > _KINDS:
        lines.append(f"and {len(kinds) - _KINDS} other kinds of failure (error in the index)")
    lines.append(f"index: {place.index}")
    return "\n".join(lines)
