# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Folder of a study, with atomic writes.

study.json: the checked study. Workers need it, files/ and samples.json.

runs/000/run_0000123.mcap: session of a run.

rows/000/0000123.json: row of a run, written last. A run with a row is finished.

index.parquet: table of all rows, written by the client.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import secrets
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from cloth_sim_ros.scene import files as scene_files
from cloth_sim_ros.scene import input_file
from cloth_sim_ros.session import plain_json
from cloth_sim_ros.studies.errors import StudyError, folder_error
from cloth_sim_ros.studies.study import Study

#: Limit of files per folder, because file systems slow down with many files.
_FILES_PER_FOLDER = 1000
_PARTIAL_PREFIX = ".unfinished-"
#: Remedy for an unreadable file of the study.
_BROKEN = "; the study can't continue with it: restore the file, or start in another folder"
#: Limit of the size of samples.json [bytes].
_MAX_SAMPLES = 1 << 26
#: Keys of a row, and their types.
_ROW_TYPES: dict[str, type | tuple[type, ...]] = {
    "run": int,
    "status": str,
    "error": str,
    "seed": int,
    "values": dict,
    "outcomes": dict,
    "digest": str,
    "frames": int,
    "flagged_frames": int,
    "error_estimate": (int, float, type(None)),
    "wall_time": (int, float),
    "cpu_time": (int, float),
    "session": str,
    "bytes": int,
}


class StudyFolder:
    """Folder of one study: its description, factor values, sessions and a row of results for each run.

    Args:
        path: the folder.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path).absolute()

    @property
    def study_file(self) -> Path:
        """Path of the file with the checked study."""
        return self.path / "study.json"

    @property
    def index_file(self) -> Path:
        """Path of the index: a Parquet table with a row for each run."""
        return self.path / "index.parquet"

    def study_files(self) -> list[Path]:
        """Return the files of the study itself, those of scenes included, without those of its runs."""
        files = [path for path in (self.path / "files").rglob("*") if path.is_file()]
        return [self.study_file, self.index_file, self.path / "study.yaml", self.path / "samples.json", *files]

    def session_file(self, run: int) -> Path:
        """Return the path of a run's session."""
        return self.path / "runs" / f"{run // _FILES_PER_FOLDER:03d}" / f"run_{run:07d}.mcap"

    def row_file(self, run: int) -> Path:
        """Return the path of the JSON file with a run's row of results."""
        return self.path / "rows" / f"{run // _FILES_PER_FOLDER:03d}" / f"{run:07d}.json"

    def create(self, study: Study, samples: Sequence[Sequence[Any]], text: str) -> None:
        """Write the files of a new study into the folder; a folder with the same study stays unchanged.

        Args:
            study: the study.
            samples: values of the factors for each run.
            text: the study as the user wrote it.

        Raises:
            StudyError: if the folder holds another study or other files.
            FolderError: if the folder can't be written.
        """
        content = self.canonical_text(study)
        if self.study_file.is_file():
            self.check_same(study)
            return
        if self.path.exists() and (not self.path.is_dir() or any(self.path.iterdir())):
            raise StudyError(f"{self.path} exists already and holds no study; choose a new folder")
        try:
            for name in ("files", "runs", "rows"):
                (self.path / name).mkdir(parents=True, exist_ok=True)
            for data in study.files.values():
                self.write(self.path / "files" / _content_name(data), data)
            self.write(self.path / "study.yaml", text.encode())
            self.write(self.path / "samples.json", json.dumps([list(values) for values in samples]).encode())
            self.write(self.study_file, content.encode())
        except OSError as error:
            raise folder_error(self.path, error) from error

    def check_same(self, study: Study) -> None:
        """Refuse a folder that holds another study.

        Raises:
            StudyError: if the studies differ; the text names the differences.
        """
        stored, requested = self._read_json(self.study_file, dict), json.loads(self.canonical_text(study))
        differing = [name for name in requested if stored.get(name) != requested[name]]
        if differing:
            names = ", ".join(differing)
            raise StudyError(f"{self.path} holds another study: it differs in {names}; choose another folder")

    @staticmethod
    def canonical_text(study: Study) -> str:
        """Return the study's exact text; two studies are the same if their texts are."""
        return study.to_json({name: _content_name(data) for name, data in study.files.items()})

    def read(self) -> Study:
        """Return the study that the folder holds.

        Raises:
            StudyError: if the folder holds no readable study.
        """
        try:
            text = input_file.read_text(self.study_file)
            stored_names = dict(plain_json.loads(text, max_length=input_file.MAX_TEXT)["files"])
            files = {name: self._file(stored_name) for name, stored_name in stored_names.items()}
            return Study.from_json(text, files)
        except StudyError:
            raise
        except FileNotFoundError as error:
            raise StudyError(f"{self.path} is no study's folder: {Path(error.filename).name} is missing") from None
        except (OSError, ValueError, TypeError, AttributeError, LookupError) as error:
            cause = error or type(error).__name__
            raise StudyError(f"{self.path} holds no readable study: {cause}{_BROKEN}") from error

    def _file(self, stored_name: str) -> bytes:
        """Return the content of a parameter's file by its stored name, which can't lead out of the folder."""
        if not stored_name.isalnum():
            raise ValueError(f"'{stored_name}' is no file name of the study")
        return input_file.read_bytes(self.path / "files" / stored_name, max_bytes=scene_files.MAX_BYTES)

    def samples(self, study: Study) -> list[tuple[Any, ...]]:
        """Return the values of the factors for each run, as they were drawn at the study's start.

        Raises:
            StudyError: if the file is unreadable, or its shape does not match the study.
        """
        path = self.path / "samples.json"
        rows = self._read_json(path, list)
        if len(rows) != study.runs or any(not isinstance(v, list) or len(v) != len(study.factors) for v in rows):
            raise StudyError(f"{path} does not hold the values of {study.runs} runs{_BROKEN}")
        return [tuple(tuple(v) if isinstance(v, list) else v for v in values) for values in rows]

    def rows(self) -> Iterator[dict[str, Any]]:
        """Yield the rows of results of all finished runs, in their order; unreadable rows are skipped."""
        for path in sorted((self.path / "rows").glob("*/*.json")):
            row = read_row(path)
            if row is not None:
                yield row

    def _read_json(self, path: Path, kind: type) -> Any:
        """Return the JSON content of one of the study's own files.

        Raises:
            StudyError: if the file is unreadable or has another type of content.
        """
        try:
            content = plain_json.loads(input_file.read_text(path, max_bytes=_MAX_SAMPLES), max_length=_MAX_SAMPLES)
        except (OSError, ValueError) as error:
            raise StudyError(f"{path} can't be read: {error}{_BROKEN}") from error
        if not isinstance(content, kind):
            raise StudyError(f"{path} holds {str(content)[:40]!r}{_BROKEN}")
        return content

    def create_run_folder(self, run: int) -> Path:
        """Create and return a temporary folder for one attempt of a run, which no other process uses."""
        run_folder = self.path / "runs" / f"{_PARTIAL_PREFIX}{run:07d}-{secrets.token_hex(6)}"
        run_folder.mkdir(parents=True)
        return run_folder

    def write(self, path: Path, data: bytes) -> None:
        """Write a file atomically: a reader finds the new content or the previous one."""
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.parent / f"{_PARTIAL_PREFIX}{path.name}-{secrets.token_hex(6)}"
        try:
            with partial.open("xb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            os.replace(partial, path)
        except BaseException:
            partial.unlink(missing_ok=True)
            raise

    def write_row(self, row: Mapping[str, Any]) -> None:
        """Write a run's row of results, which marks the run as finished."""
        self.write(self.row_file(int(row["run"])), json.dumps(row, allow_nan=False).encode())

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Lock the folder, so that only one process runs the study at a time.

        Raises:
            StudyError: if another client has the lock.
        """
        descriptor = os.open(self.path / ".lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise StudyError(f"another cloth_batch works on {self.path}; wait for it, or stop it") from None
            except OSError:
                # Some network file systems do not support locks.
                pass
            yield
        finally:
            os.close(descriptor)

    def remove_leftovers(self) -> None:
        """Remove incomplete files of killed workers.

        A worker of a lost client that still runs fails because of it, without a message.
        """
        for path in list(self.path.rglob(f"{_PARTIAL_PREFIX}*")):
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)


def read_row(path: Path) -> dict[str, Any] | None:
    """Return a run's row of results from its JSON file; None if it is missing or incomplete."""
    try:
        run, row = int(path.stem), plain_json.loads(input_file.read_text(path))
    except (OSError, ValueError):
        return None
    if not isinstance(row, dict) or not row.keys() >= _ROW_TYPES.keys() or row["run"] != run:
        return None
    return row if all(isinstance(row[name], kinds) for name, kinds in _ROW_TYPES.items()) else None


def _content_name(data: bytes) -> str:
    import xxhash

    return str(xxhash.xxh3_128_hexdigest(data))
