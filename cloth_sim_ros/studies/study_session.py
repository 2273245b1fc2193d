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

from cloth_sim_ros.scene import input_file
from cloth_sim_ros.studies import index, study_file
from cloth_sim_ros.studies.cluster import SchedulerAddress, core_count, local_scheduler
from cloth_sim_ros.studies.errors import FolderError, StudyError
from cloth_sim_ros.studies.folder import StudyFolder
from cloth_sim_ros.studies.study import Study
from cloth_sim_ros.studies.study_estimate import check_disk_space, estimate_study, format_quantity, sample_and_estimate
from cloth_sim_ros.studies.study_run import KILLED, OK
from cloth_sim_ros.studies.study_runner import StudyRunner

#: Limits of a summary: kinds of failure, and runs per kind.
_MAX_KINDS, _MAX_NAMED_RUNS = 5, 5


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
    """Execute the unfinished runs of a study, write its index, print a summary; return 0 if all succeeded, else 1.

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
    study_folder = StudyFolder(out)
    with contextlib.ExitStack() as stack:
        if study_folder.study_file.is_file():
            stack.enter_context(study_folder.lock())
        rows = _finished_rows(study_folder, study, resume, retry_failed)
        count = workers or core_count()
        if study_folder.study_file.is_file():
            samples = study_folder.samples(study)
            estimate = estimate_study(study, samples)
        else:
            samples, estimate = sample_and_estimate(study, count)
            check_disk_space(study_folder.path, study, estimate)
            study_folder.create(study, samples, input_file.read_text(path))
            stack.enter_context(study_folder.lock())
        remaining = [run for run in range(study.runs) if run not in rows]
        if rows:
            tqdm.write(f"{len(rows)} of {study.runs} runs are finished, {len(remaining)} are left")
        elif scheduler is None:
            tqdm.write(f"{study.runs} runs take {estimate.describe(study.runs, count)}")
        start, n_before = time.perf_counter(), len(rows)
        study_folder.remove_leftovers()
        if remaining:
            # A killed client leaves no index, so that readers build it from the rows.
            study_folder.index_file.unlink(missing_ok=True)
        # The stack closes in reverse order: stop the cluster, remove incomplete files, write the index.
        stack.callback(_write_index, study_folder, rows)
        stack.callback(study_folder.remove_leftovers)
        bar = stack.enter_context(tqdm(total=study.runs, initial=n_before, unit="run", desc="study", disable=None))

        def on_progress(run: int, row: dict[str, Any]) -> None:
            if run not in rows:
                rows[run] = row
                bar.update()

        runner = StudyRunner(study_folder, study, samples, estimate.seconds_per_run, on_progress, tqdm.write)
        if remaining:
            if scheduler is None:
                address = stack.enter_context(local_scheduler(workers, tqdm.write))
            else:
                address = SchedulerAddress(scheduler)
            runner.run(address, remaining, wait=wait)
    index.write(study_folder, rows.values())
    print(summary(study_folder, rows.values(), time.perf_counter() - start, len(rows) - n_before))
    return 0 if all(row["status"] == OK for row in rows.values()) else 1


def _write_index(study_folder: StudyFolder, rows: dict[int, dict[str, Any]]) -> None:
    """Write the index of all rows, also of runs that finished unnoticed before an interrupt.

    A full disk is ignored here, because the error that stopped the study reports it.
    """
    known_files = {study_folder.row_file(run).name for run in rows}
    rows.update({int(row["run"]): row for row in study_folder.rows(omit=known_files)})
    with contextlib.suppress(FolderError):
        index.write(study_folder, rows.values())


def _finished_rows(
    study_folder: StudyFolder, study: Study, resume: bool, retry_failed: bool
) -> dict[int, dict[str, Any]]:
    """Return a folder's rows by run; delete those to repeat: killed and, with `retry_failed`, failed runs.

    Raises:
        StudyError: if the folder belongs to another study, or has results and `resume` is false.
    """
    if not study_folder.study_file.is_file():
        if resume and study_folder.path.is_dir() and not study_folder.is_incomplete():
            raise StudyError(
                f"{study_folder.path} holds no study to resume: study.json is missing; choose a new folder"
            )
        return {}
    study_folder.check_same(study)
    rows = {int(row["run"]): row for row in study_folder.rows()}
    if rows and not resume:
        cause = f"{study_folder.path} holds {len(rows)} of {study.runs} runs of this study"
        raise StudyError(f"{cause}; continue with --resume, or start in another folder")
    repeated = [run for run, row in rows.items() if row["status"] == KILLED or (retry_failed and row["status"] != OK)]
    if len(rows) - len(repeated) < study.runs:
        study_folder.check_package()
    for run in repeated:
        study_folder.row_file(run).unlink(missing_ok=True)
        del rows[run]
    return rows


def summary(study_folder: StudyFolder, rows: Iterable[dict[str, Any]], seconds: float, n_done: int) -> str:
    """Return a text summary of a study: successful runs, and failures with their causes.

    Args:
        study_folder: folder of the study.
        rows: rows of all finished runs.
        seconds: wall time of this execution [s].
        n_done: number of runs of this execution.
    """
    all_rows = list(rows)
    failed = [row for row in all_rows if row["status"] != OK]
    flagged = sum(row["flagged_frames"] > 0 for row in all_rows)
    size = format_quantity(sum(row["bytes"] for row in all_rows), "B")
    successes = f"{len(all_rows) - len(failed)} of {len(all_rows)} runs were successful"
    lines = [f"{successes}; {n_done} took {seconds:.1f} s; {size}"]
    if flagged:
        lines.append(f"{flagged} runs have frames that missed the tolerance (flagged_frames in the index)")
    kinds: dict[str, list[dict[str, Any]]] = collections.defaultdict(list)
    for row in failed:
        # Texts that differ only in numbers are the same kind of failure.
        kinds[re.sub(r"-?\d+(\.\d+)?(e[-+]?\d+)?", "#", row["error"])].append(row)
    for failures in sorted(kinds.values(), key=len, reverse=True)[:_MAX_KINDS]:
        named = [str(row["run"]) for row in failures[:_MAX_NAMED_RUNS]]
        run_list = ", ".join([*named, "..."] if failures[_MAX_NAMED_RUNS:] else named)
        lines.append(f"{len(failures)} failed ({run_list}): {failures[0]['error']}")
    if len(kinds) > _MAX_KINDS:
        lines.append(f"and {len(kinds) - _MAX_KINDS} other kinds of failure (error in the index)")
    lines.append(f"index: {study_folder.index_file}")
    return "\n".join(lines)
