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

from cloth_sim_ros.batch import index, trajectories
from cloth_sim_ros.batch.errors import StudyError, folder_error
from cloth_sim_ros.batch.folder import StudyFolder
from cloth_sim_ros.batch.study_run import OK
from cloth_sim_ros.batch.trajectories import Trajectory

#: Returns a new iterator over the runs at each call.
Runs = Callable[[], Iterator[Trajectory]]


def to_zarr(folder: Path, out: Path) -> int:
    """Write a zarr v3 group and return exit status 0."""
    from cloth_sim_ros.batch import zarr_export

    return _write(folder, out, lambda place, there, runs, count: zarr_export.write(there, runs(), count, place))


def to_lerobot(folder: Path, out: Path, *, task: str, video: bool) -> int:
    """Write a LeRobotDataset v3.0 and return exit status 0."""
    from cloth_sim_ros.batch import lerobot_export

    return _write(
        folder, out, lambda _place, there, runs, _count: lerobot_export.write(there, runs(), task=task, video=video)
    )


def to_mcap(folder: Path, out: Path) -> int:
    """Write sessions with clouds and return exit status 0."""
    place = StudyFolder(folder)

    def write(_place: StudyFolder, there: Path, _runs: Runs, count: int) -> None:
        there.mkdir()
        for _ in _read(place, sessions_of(place), copy_into=there):
            pass

    return _write(folder, out, write)


def sessions_of(place: StudyFolder) -> list[tuple[int, Path]]:
    """Return the index and the session file of each successful run.

    Raises:
        StudyError: if no run was successful.
    """
    table = index.read(place)
    columns = (table[name].to_pylist() for name in ("run", "status", "session"))
    found = [(run, place.path / path) for run, status, path in zip(*columns, strict=True) if status == OK]
    if not found:
        raise StudyError(f"{place.path} has no successful run to export; run the study first")
    return found


def _write(folder: Path, out: Path, write: Callable[[StudyFolder, Path, Runs, int], None]) -> int:
    place = StudyFolder(folder)
    sessions = sessions_of(place)
    if out.exists():
        raise StudyError(f"{out} exists already; choose another name, or remove it")
    hidden = out.absolute().parent / f".unfinished-{out.name}-{secrets.token_hex(4)}"
    try:
        hidden.parent.mkdir(parents=True, exist_ok=True)
        write(place, hidden, lambda: _read(place, sessions), len(sessions))
        hidden.rename(out)
    except OSError as error:
        raise folder_error(out, error) from error
    finally:
        with contextlib.suppress(OSError):
            shutil.rmtree(hidden)
    print(f"{out}: {len(sessions)} runs of {place.path}")
    return 0


def _read(
    place: StudyFolder, sessions: list[tuple[int, Path]], *, copy_into: Path | None = None
) -> Iterator[Trajectory]:
    from tqdm import tqdm

    for run, session in tqdm(sessions, unit="run", desc="export", disable=None, delay=1.0, leave=False):
        yield trajectories.read(run, session, copy_into=copy_into)
