# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Views of a study: table, plot, or one run in Rerun."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cloth_sim_ros.scene.parameters.unknown_parameters import suggestion
from cloth_sim_ros.session.child_process import child_environment, module_command
from cloth_sim_ros.session.output_files import atomic_write
from cloth_sim_ros.studies import index
from cloth_sim_ros.studies.errors import StudyError
from cloth_sim_ros.studies.folder import StudyFolder, read_row

if TYPE_CHECKING:
    import pyarrow as pa

#: Columns for programs, which the table omits.
_FOR_PROGRAMS = ("seed", "session", "bytes", "digest", "error_estimate", "frames", "cpu_time")
#: Maximum width of a cell [characters].
_WIDEST = 24


def view(
    folder: Path,
    *,
    outcome: str | None = None,
    over: str | None = None,
    plot: Path | None = None,
    rows: int = 20,
    run: int | None = None,
    save: Path | None = None,
) -> int:
    """Print the results of a study as a table, plot them, or open a run in Rerun; return the exit status.

    Args:
        folder: folder of the study.
        outcome: outcome of the plot, and order of the table.
        over: factor on the x axis.
        plot: picture to write.
        rows: maximum number of rows of the table.
        run: index of a run to open in Rerun instead.
        save: Rerun recording of the run to write, instead of opening the viewer.

    Raises:
        StudyError: if the folder, run or column does not exist.
    """
    study_folder = StudyFolder(folder)
    table = index.read(study_folder)
    if run is not None:
        return _open_run(study_folder, run, save)
    name = None if outcome is None else column_of(table, outcome, "outcome")
    along = None if over is None else column_of(table, over, "factor")
    if plot is not None and name is not None and along is not None:
        draw_plot(table, name, along, plot)
        print(f"{plot}: {name} over {along}, {table.num_rows} runs")
        return 0
    print(format_table(table, order=name, rows=rows, first=along))
    return 0


def column_of(table: pa.Table, name: str, role: str) -> str:
    """Return the index's column for a name, in which an outcome's prefix may be missing. Raises StudyError.

    Args:
        table: the index.
        name: the name.
        role: role of the column, for the error text.

    Raises:
        StudyError: if the column does not exist.
    """
    for candidate in (name, index.OUTCOME_PREFIX + name):
        if candidate in table.column_names:
            return candidate
    known = [column.removeprefix(index.OUTCOME_PREFIX) for column in table.column_names]
    raise StudyError(f"{role} '{name}' is no column of the index{suggestion(name, known)}; it has {', '.join(known)}")


def format_table(table: pa.Table, *, order: str | None = None, rows: int = 20, first: str | None = None) -> str:
    """Return the index of a study as text: one line for each run.

    Args:
        table: the index.
        order: column by which rows are sorted, the largest first.
        rows: maximum number of rows.
        first: column that follows the run's index.
    """
    if order is not None:
        table = table.sort_by([(order, "descending")])
    names = [name for name in table.column_names if name not in _FOR_PROGRAMS]
    if all(not error for error in table["error"].to_pylist()):
        names.remove("error")
    for name in (order, first):
        if name is not None:
            names = ["run", name, *(column for column in names if column not in ("run", name))]
    shown = table.slice(0, rows).select(names).to_pylist()
    cells = [[name.removeprefix(index.OUTCOME_PREFIX) for name in names]]
    cells += [[_cell(row[name]) for name in names] for row in shown]
    widths = [max(len(row[k]) for row in cells) for k in range(len(names))]
    lines = ["  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in cells]
    if table.num_rows > rows:
        lines.append(f"... {table.num_rows - rows} more; --rows shows them")
    return "\n".join(lines)


def draw_plot(table: pa.Table, name: str, along: str, file: Path) -> None:
    """Write a plot of an outcome (`name`) over a factor (`along`), numeric or categorical. Raises StudyError.

    Raises:
        StudyError: if no run has both values, or the outcome is no number.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = zip(table[along].to_pylist(), table[name].to_pylist(), strict=True)
    pairs = [(x, y) for x, y in columns if x is not None and y is not None]
    if not pairs:
        raise StudyError(f"no run has both {name} and {along}: nothing to draw")
    if not all(isinstance(y, int | float) for _, y in pairs):
        raise StudyError(f"{name} is no number; choose an outcome or another number")
    plain = all(isinstance(x, int | float) for x, _ in pairs)
    figure = Figure(figsize=(7.0, 5.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.plot([x if plain else _cell(x) for x, _ in pairs], [y for _, y in pairs], "o", markersize=4, alpha=0.7)
    values = [x for x, _ in pairs]
    if plain and min(values) > 0 and max(values) > 50 * min(values):
        axes.set_xscale("log")
    axes.set(xlabel=along, ylabel=name.removeprefix(index.OUTCOME_PREFIX))
    axes.grid(alpha=0.3)
    with atomic_write(file) as output:
        figure.savefig(output, dpi=120, format=file.suffix.removeprefix(".") or "png")


def _open_run(study_folder: StudyFolder, run: int, save: Path | None) -> int:
    """Open one run in Rerun, or save it, in a separate process; wait, and return its exit status."""
    row = read_row(study_folder.row_file(run)) if run >= 0 else None
    if row is None:
        raise StudyError(f"{study_folder.path} has no finished run {run}")
    if not row["session"]:
        raise StudyError(f"run {run} has no session: {row['error']}")
    if not study_folder.read().clouds:
        remedy = "cloth_batch export FOLDER --mcap OUT adds them"
        print(f"cloth_batch: the sessions hold no clouds; {remedy}", file=sys.stderr)
    command = module_command("cloth_sim_ros.replay.main", str(study_folder.path / row["session"]))
    command += ["--save", str(save)] if save else []
    return subprocess.run(command, env=child_environment(), check=False).returncode


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.5g}"
    words = json.dumps(value) if isinstance(value, list) else str(value)
    return words if len(words) <= _WIDEST else words[: _WIDEST - 3] + "..."
