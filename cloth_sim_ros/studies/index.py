# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Index of a study: Parquet table with one row per run."""

from __future__ import annotations

import io
import json
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from cloth_sim_ros.studies.errors import StudyError, folder_error
from cloth_sim_ros.studies.folder import StudyFolder

if TYPE_CHECKING:
    import pyarrow as pa

#: Columns of every index and their types; columns of the factors and the outcomes follow.
COLUMNS = {
    "run": "int64",
    "status": "string",
    "error": "string",
    "seed": "uint64",
    "digest": "string",
    "frames": "int64",
    "flagged_frames": "int64",
    "error_estimate": "float64",
    "wall_time": "float64",
    "cpu_time": "float64",
    "session": "string",
    "bytes": "int64",
}
#: Prefix of the names of outcomes, which separates them from parameters.
OUTCOME_PREFIX = "outcome."
#: Limits of an index in memory [bytes] and of its cells. Repeated cells take no space on the disk.
_MAX_BYTES, _MAX_CELLS = 256 << 20, 20_000_000


def table_of(rows: Iterable[dict[str, Any]]) -> pa.Table:
    """Return the rows of finished runs as an Arrow table, in the order of the runs."""
    import pyarrow as pa

    ordered = sorted(rows, key=lambda row: row["run"])
    columns: dict[str, Any] = {}
    for name, kind in COLUMNS.items():
        columns[name] = pa.array([row[name] for row in ordered], type=pa.type_for_alias(kind))
    for group, prefix in (("values", ""), ("outcomes", OUTCOME_PREFIX)):
        names = dict.fromkeys(name for row in ordered for name in row[group])
        for name in names:
            columns[prefix + name] = _column([row[group].get(name) for row in ordered])
    return pa.table(columns)


def write(study_folder: StudyFolder, rows: Iterable[dict[str, Any]]) -> None:
    """Write the rows of finished runs as the study's index (Parquet), atomically. Raises FolderError.

    Raises:
        FolderError: if the folder can't be written.
    """
    import pyarrow.parquet as pq

    sink = io.BytesIO()
    pq.write_table(table_of(rows), sink)
    try:
        study_folder.write(study_folder.index_file, sink.getvalue())
    except OSError as error:
        raise folder_error(study_folder.path, error) from error


def read(study_folder: StudyFolder) -> pa.Table:
    """Return a study's index as an Arrow table; without a file, it is built from the rows. Raises StudyError.

    Raises:
        StudyError: if the folder holds no study, or the index is unreadable.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    if not study_folder.study_file.is_file():
        raise StudyError(f"{study_folder.path} is no study's folder: study.json is missing")
    try:
        if study_folder.index_file.is_file():
            _check_size(study_folder)
            return _check_columns(pq.read_table(study_folder.index_file))
    except (OSError, ValueError, pa.ArrowException) as error:
        remedy = "Remove it: it is rebuilt from the rows"
        raise StudyError(f"cannot read {study_folder.index_file}: {error} {remedy}") from error
    return table_of(study_folder.rows())


def _column(values: list[Any]) -> pa.Array:
    """Return values as an Arrow array: numbers, texts or lists of numbers; mixed types as JSON."""
    import pyarrow as pa

    kinds = {type(value) for value in values if value is not None}
    if kinds == {int, float}:
        values = [None if value is None else float(value) for value in values]
    try:
        return pa.array(values)
    except (pa.ArrowInvalid, pa.ArrowTypeError):
        return pa.array([None if value is None else json.dumps(value) for value in values])


def _check_size(folder: StudyFolder) -> None:
    """Raise ValueError for an index that would take too much memory.

    Raises:
        ValueError: if the index is too large; the text names the limits.
    """
    import pyarrow.parquet as pq

    metadata = pq.read_metadata(folder.index_file)
    size = sum(metadata.row_group(k).total_byte_size for k in range(metadata.num_row_groups))
    cells = metadata.num_rows * metadata.num_columns
    if size > _MAX_BYTES or cells > _MAX_CELLS:
        raise ValueError(f"it has {cells} cells and {size} bytes; the limits are {_MAX_CELLS} and {_MAX_BYTES}.")


def _check_columns(table: pa.Table) -> pa.Table:
    """Return the index unchanged. Raises ValueError if a column is missing or has another type.

    Raises:
        ValueError: if a column is missing or has another type.
    """
    for name, kind in COLUMNS.items():
        column_type = str(table.schema.field(name).type) if name in table.column_names else "none"
        if column_type not in (kind, "double" if kind == "float64" else kind):
            raise ValueError(f"its column '{name}' is of type {column_type}, not {kind}.")
    return table
