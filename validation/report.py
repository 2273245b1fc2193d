# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Report of a measurement: tables, notes, failures and environment, written as Markdown and as JSON."""

from __future__ import annotations

import datetime
import importlib.metadata
import json
import math
import os
import platform
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import attrs

#: Innermost lists of the tables in indented JSON, and the breaks between their entries.
_INNER_LIST = re.compile(r"\[\n\s+([^\[\]{}]*?)\n {3,}\]")
_LINE_BREAK = re.compile(r",\n\s+")


@attrs.define
class Table:
    """Rows under named columns."""

    name: str
    columns: list[str]
    rows: list[list[Any]] = attrs.field(factory=list)

    def lines(self) -> list[str]:
        """Return the table as lines of Markdown."""
        cells = [[_format_cell(value) for value in row] for row in self.rows]
        widths = [max([len(name), *(len(row[i]) for row in cells)]) for i, name in enumerate(self.columns)]
        pad = [[text.ljust(width) for text, width in zip(row, widths, strict=True)] for row in [self.columns, *cells]]
        head, *body = ["| " + " | ".join(row) + " |" for row in pad]
        return [head, "|" + "|".join("-" * (width + 2) for width in widths) + "|", *body]

    def records(self) -> list[dict[str, Any]]:
        """Return each row with the names of its columns."""
        return [dict(zip(self.columns, row, strict=True)) for row in self.rows]


@attrs.define
class Report:
    """Results of one command."""

    title: str
    #: Set by `command.run_command`.
    command: str = ""
    tables: list[Table] = attrs.field(factory=list)
    notes: list[str] = attrs.field(factory=list)
    #: Requirements that were not met; any makes the exit status 1.
    failures: list[str] = attrs.field(factory=list)
    environment: dict[str, str] = attrs.field(factory=lambda: environment())

    def note(self, text: str) -> None:
        """Add a note."""
        self.notes.append(text)

    def fail(self, text: str) -> None:
        """Add a requirement that was not met."""
        self.failures.append(text)

    def require(self, holds: bool, failure: str) -> None:
        """Add a requirement that was not met, unless it holds."""
        if not holds:
            self.fail(failure)

    def add_table(self, name: str, columns: list[str]) -> Table:
        """Add a table without rows."""
        self.tables.append(Table(name, columns))
        return self.tables[-1]

    def table(self, name: str) -> Table:
        """Return the table whose name begins so."""
        return next(table for table in self.tables if table.name.startswith(name))

    def text(self) -> str:
        """Return the report as Markdown, for the terminal and for documentation."""
        lines = [f"## {self.title}", "", f"`{self.command}`", ""]
        for table in self.tables:
            lines += [f"### {table.name}", "", *table.lines(), ""]
        lines += [f"- {note}" for note in self.notes]
        lines += [f"- NOT MET: {failure}" for failure in self.failures]
        lines += ["", ", ".join(f"{key} {value}" for key, value in self.environment.items())]
        return "\n".join(lines)

    def json_text(self) -> str:
        """Return the report as JSON, a line for each row of a table; numbers that are not finite are null."""
        text = json.dumps(attrs.asdict(self, value_serializer=_finite), indent=1, default=float)
        return _INNER_LIST.sub(lambda found: f"[{_LINE_BREAK.sub(', ', found[1])}]", text) + "\n"


def print_progress(text: str) -> None:
    """Write a line of progress to standard error."""
    sys.stderr.write(f"{text}\n")
    sys.stderr.flush()


def environment() -> dict[str, str]:
    """Return the date, the machine, the versions of libraries and the commit."""
    from cloth_sim_ros.simulation.environment import environment as product_environment

    versions = {
        "date": datetime.datetime.now(tz=datetime.UTC).date().isoformat(),
        "machine": product_environment()["processor"],
        "cores": str(len(os.sched_getaffinity(0))),
        "python": platform.python_version(),
    }
    for name in ("numpy", "numba", "scipy", "scikit-sundae"):
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = "absent"
    versions["commit"] = _commit()
    return versions


def _commit() -> str:
    command = ["git", "describe", "--always", "--dirty"]
    try:
        done = subprocess.run(command, cwd=Path(__file__).parent, check=False, capture_output=True, text=True)
    except FileNotFoundError:
        return "unknown"
    return done.stdout.strip() or "unknown"


def _finite(_owner: type, _attribute: Any, value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _format_cell(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
