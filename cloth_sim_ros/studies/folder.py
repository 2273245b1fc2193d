# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Folder of a study, with atomic writes.

study.json: the checked study. Workers need it, files/ and samples.json.

package.json: the code that began the study.

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
from collections.abc import Container, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from cloth_sim_ros.scene import files as scene_files
from cloth_sim_ros.scene import input_file
from cloth_sim_ros.session import plain_json
from cloth_sim_ros.simulation.environment import environment
from cloth_sim_ros.studies.errors import StudyError, folder_error
from cloth_sim_ros.studies.study import Study

#: Limit of files per folder, because file systems slow down with many files.
_FILES_PER_FOLDER = 1000
_PARTIAL_PREFIX = ".unfinished-"
#: What `create` writes before study.json.
_CREATED_NAMES = {"files", "runs", "rows", "study.yaml", "samples.json", "package.json"}
#: Entries of package.json that decide about bits.
_CODE_NAMES = ("numerics", "source")
#: Remedy for an unreadable file of the study.
_BROKEN = "; the study can't continue with it: restore the file, or start in another folder"
#: Least limit of the size of the study's own JSON files [bytes].
_MAX_JSON = 1 << 26
#: Length of a number in JSON with its separator, at most [characters].
_NUMBER_LENGTH = 27
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
        """Write a new study's files; a folder with the same study stays unchanged. Raises StudyError or FolderError.

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
        if len(content) > input_file.MAX_TEXT:
            cause = (
                f"the study takes {len(content)} bytes, with lists, policy and outcomes; at most {input_file.MAX_TEXT}"
            )
            raise StudyError(f"{cause} are possible: shorten them, or give a distribution instead of a list")
        if self.path.exists() and not (self.path.is_dir() and self.is_incomplete()):
            raise StudyError(f"{self.path} exists already and holds no study; choose a new folder")
        try:
            for name in ("runs", "rows", "files"):
                (self.path / name).mkdir(parents=True, exist_ok=True)
            for data in study.files.values():
                self.write(self.path / "files" / _content_name(data), data)
            self.write(self.path / "study.yaml", text.encode())
            self.write(self.path / "samples.json", json.dumps([list(values) for values in samples]).encode())
            self.write(self.path / "package.json", json.dumps(_package()).encode())
            self.write(self.study_file, content.encode())
        except OSError as error:
            raise folder_error(self.path, error) from error

    def is_incomplete(self) -> bool:
        """Return True if the folder is empty, or its creation was interrupted; it has no study and no results then."""
        if self.study_file.exists():
            return False
        names = {path.name for path in self.path.iterdir() if not path.name.startswith(_PARTIAL_PREFIX)}
        has_results = any(any((self.path / name).glob("*/*")) for name in ("runs", "rows"))
        return names <= _CREATED_NAMES and not has_results

    def check_same(self, study: Study) -> None:
        """Raise StudyError, with the differing entries, if the folder holds another study.

        Raises:
            StudyError: if the studies differ; the text names the differences.
        """
        stored, requested = self._read_json(self.study_file, dict), json.loads(self.canonical_text(study))
        differing = [name for name in requested if stored.get(name) != requested[name]]
        if differing:
            names = ", ".join(differing)
            raise StudyError(f"{self.path} holds another study: it differs in {names}; choose another folder")

    def check_package(self) -> None:
        """Refuse a folder whose study was begun by other code, whose bits may differ; older folders do not name it.

        Raises:
            StudyError: if the code differs; the text names both versions.
        """
        path = self.path / "package.json"
        if not path.is_file():
            return
        begun, present = self._read_json(path, dict), _package()
        if any(begun.get(name) != present[name] for name in _CODE_NAMES):
            versions = [", ".join(f"{name} {package.get(name)}" for name in present) for package in (begun, present)]
            cause = (
                f"{self.path} was begun by cloth_sim_ros {versions[0]}; here is {versions[1]}, whose bits may differ"
            )
            raise StudyError(f"{cause}: continue with the former version, or start in another folder")

    @staticmethod
    def canonical_text(study: Study) -> str:
        """Return the study's exact text; two studies are the same if their texts are."""
        return study.to_json({name: _content_name(data) for name, data in study.files.items()})

    def read(self) -> Study:
        """Return the study that the folder holds. Raises StudyError without a readable one.

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
        """Return each run's tuple of factor values, as drawn at the study's start. Raises StudyError.

        Raises:
            StudyError: if the file is unreadable, or its shape does not match the study.
        """
        path = self.path / "samples.json"
        # The study bounds the file: a value of a list is as long as its longest one, any other is a number.
        texts = [[json.dumps(value) for value in factor.values] for factor in study.factors if factor.kind == "choices"]
        length = 4 + _NUMBER_LENGTH * len(study.factors) + sum(max(map(len, values)) for values in texts)
        n_values = (
            1 + len(study.factors) + sum(max(sum(map(value.count, ",[{")) for value in values) for values in texts)
        )
        rows = self._read_json(path, list, max_bytes=study.runs * length, max_values=study.runs * n_values)
        if len(rows) != study.runs or any(not isinstance(v, list) or len(v) != len(study.factors) for v in rows):
            raise StudyError(f"{path} does not hold the values of {study.runs} runs{_BROKEN}")
        return [tuple(tuple(v) if isinstance(v, list) else v for v in values) for values in rows]

    def rows(self, *, omit: Container[str] = ()) -> Iterator[dict[str, Any]]:
        """Yield the rows of results of all finished runs, in their order; unreadable rows are skipped.

        Args:
            omit: names of row files that are not read.
        """
        for path in sorted((self.path / "rows").glob("*/*.json")):
            row = None if path.name in omit else read_row(path)
            if row is not None:
                yield row

    def _read_json(self, path: Path, kind: type, *, max_bytes: int = 0, max_values: int = 0) -> Any:
        """Return the JSON content of one of the study's files. Raises StudyError unless it is of type `kind`.

        Raises:
            StudyError: if the file is unreadable or has another type of content.
        """
        try:
            max_bytes, max_values = max(max_bytes, _MAX_JSON), max(max_values, plain_json.MAX_VALUES)
            text = input_file.read_text(path, max_bytes=max_bytes)
            content = plain_json.loads(text, max_length=max_bytes, max_values=max_values)
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
        """Write a file atomically, on the disk: a reader finds the new content or the previous one. Raises OSError."""
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
        """Context that locks the folder, if its file system can. Raises StudyError if another process has the lock.

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
        """Delete incomplete files and run folders, which killed workers have left.

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


def _package() -> dict[str, str]:
    """Return version, arithmetic and digest of this code."""
    record = environment()
    return {name: record[name] for name in ("version", *_CODE_NAMES)}


def _content_name(data: bytes) -> str:
    import xxhash

    return str(xxhash.xxh3_128_hexdigest(data))
