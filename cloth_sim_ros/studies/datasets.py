# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Export of a study's runs as zarr v3, LeRobotDataset v3.0 or sessions.

A dataset gets its name when it is complete.
"""

from __future__ import annotations

import contextlib
import secrets
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

from cloth_sim_ros.studies import index, trajectories
from cloth_sim_ros.studies.errors import StudyError, folder_error
from cloth_sim_ros.studies.folder import StudyFolder
from cloth_sim_ros.studies.study_run import OK
from cloth_sim_ros.studies.trajectories import StudiedRun, Trajectory

#: Returns a new iterator over the runs at each call.
TrajectorySource = Callable[[], Iterator[Trajectory]]


def to_zarr(folder: Path, out: Path) -> int:
    """Simulate a study's successful runs again into a new zarr v3 group. Raises StudyError or StoppedError.

    Returns:
        The exit status 0.
    """
    from cloth_sim_ros.studies import zarr_export

    def write(study_folder: StudyFolder, target: Path, runs: TrajectorySource, count: int) -> None:
        zarr_export.write(target, runs(), count, study_folder)

    return _export(folder, out, write)


def to_lerobot(folder: Path, out: Path, *, task: str, video: bool) -> int:
    """Simulate a study's successful runs again into a new LeRobotDataset v3.0. Raises StudyError or StoppedError.

    Returns:
        The exit status 0.
    """
    from cloth_sim_ros.studies import lerobot_export

    def write(_study_folder: StudyFolder, target: Path, runs: TrajectorySource, _count: int) -> None:
        lerobot_export.write(target, runs(), task=task, video=video)

    return _export(folder, out, write)


def to_mcap(folder: Path, out: Path) -> int:
    """Simulate a study's successful runs again into sessions with clouds. Raises StudyError or StoppedError.

    Returns:
        The exit status 0.
    """
    study_folder = StudyFolder(folder)

    def write(_study_folder: StudyFolder, target: Path, _runs: TrajectorySource, count: int) -> None:
        target.mkdir()
        for _ in _trajectories(study_folder, successful_sessions(study_folder), copy_into=target):
            pass

    return _export(folder, out, write)


def successful_sessions(study_folder: StudyFolder) -> list[StudiedRun]:
    """Return each successful run with its session file. Raises StudyError without one.

    Raises:
        StudyError: if no run was successful.
    """
    table = index.read(study_folder)
    columns = (table[name].to_pylist() for name in ("run", "session", "frames", "digest", "status"))
    sessions = [
        StudiedRun(run=run, session=study_folder.path / path, n_frames=frames, digest=digest)
        for run, path, frames, digest, status in zip(*columns, strict=True)
        if status == OK
    ]
    if not sessions:
        raise StudyError(f"{study_folder.path} has no successful run to export; run the study first")
    return sessions


def _export(folder: Path, out: Path, write: Callable[[StudyFolder, Path, TrajectorySource, int], None]) -> int:
    study_folder = StudyFolder(folder)
    sessions = successful_sessions(study_folder)
    if out.exists():
        raise StudyError(f"{out} exists already; choose another name, or remove it")
    partial = out.absolute().parent / f".unfinished-{out.name}-{secrets.token_hex(4)}"
    try:
        partial.parent.mkdir(parents=True, exist_ok=True)
        write(study_folder, partial, lambda: _trajectories(study_folder, sessions), len(sessions))
        partial.rename(out)
    except OSError as error:
        raise folder_error(out, error) from error
    finally:
        with contextlib.suppress(OSError):
            shutil.rmtree(partial)
    print(f"{out}: {len(sessions)} runs of {study_folder.path}")
    return 0


def _trajectories(
    study_folder: StudyFolder, sessions: list[StudiedRun], *, copy_into: Path | None = None
) -> Iterator[Trajectory]:
    from tqdm import tqdm

    for studied in tqdm(sessions, unit="run", desc="export", disable=None, delay=1.0, leave=False):
        yield trajectories.read(studied, copy_into=copy_into)
