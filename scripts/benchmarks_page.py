# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Runs benchmarks and validation into docs/data, and draws docs/benchmarks.md and its figures from there.

scripts/benchmarks_page.py         All sections, one to two hours on an idle machine.
scripts/benchmarks_page.py speed   This section only.
scripts/benchmarks_page.py --draw  Tables and figures from the recorded rows; nothing is measured.
scripts/benchmarks_page.py --resume FOLDER tolerance  Keeps results there and runs missing cases.

The prose of the page is written by hand. A block between the comments `rows NAME` and `end` is replaced.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import attrs
import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(Path(__file__).resolve().parent)]

from benchmark_figures import draw_figures  # noqa: E402

from validation.report import Report, Table  # noqa: E402

PAGE, ROWS, PICTURES = (ROOT / "docs" / name for name in ("benchmarks.md", "data", "images"))
#: Command of each section, in the order of the page.
SECTIONS = {
    "speed": "benchmarks speed",
    "scale": "benchmarks scale",
    "feature-cost": "benchmarks feature-cost",
    "batch": "benchmarks batch",
    "studies": "benchmarks studies",
    "work-precision-16": "validation work-precision --scene curtain16 --slow",
    "work-precision-32": "validation work-precision --scene curtain32 --slow --limit 30",
    "tolerance-sweep": "validation tolerance-sweep --energy",
    "tolerance": "validation tolerance --seed 1 --count 500",
    "tolerance-contact": "validation tolerance --contact --seed 1 --count 40",
    "regimes": "validation tolerance --regimes",
    "violent": "validation tolerance --violent --seed 1 --count 200",
    "stability": "validation stability",
    "conditioning": "validation conditioning",
    "constants": "validation constants",
    "contact": "benchmarks contact",
    "peers": "benchmarks peers",
    "peers-contact": "benchmarks peers-contact",
}
#: Sections with hours of cases, which can resume.
RESUMABLE = ("tolerance", "violent", "tolerance-contact", "stability")
#: Missed requirements of a section that the page lists.
MAX_FAILURES = 5

Reports = dict[str, Report]
Row = dict[str, Any]


@attrs.frozen
class Excerpt:
    """Chosen rows and columns of a section's table."""

    section: str
    table: str
    columns: tuple[str, ...]
    #: Rows to show; all if left out.
    chosen: Callable[[Row], bool] = lambda row: True
    max_rows: int = 9

    def lines(self, reports: Reports) -> list[str]:
        """Return the excerpt as lines of Markdown."""
        rows = [row for row in reports[self.section].table(self.table).records() if self.chosen(row)]
        cells = [[row[column] for column in self.columns] for row in rows[: self.max_rows]]
        return Table(self.table, list(self.columns), cells).lines()


def error_bound_lines(reports: Reports) -> list[str]:
    """Return largest errors of random scenes in parts of the error bound."""
    table = Table("", ["scenes", "count", "median", "largest, unflagged", "largest, flagged", "scenes with flags"])
    for section, label in (("tolerance", "without contact"), ("tolerance-contact", "with contact")):
        rows = reports[section].table("Error relative to tolerance").records()
        unflagged, flagged = (
            [row[f"worst {kind}"] for row in rows if row[f"worst {kind}"] != "-"] for kind in ("unflagged", "flagged")
        )
        n_flagged = sum(row["flagged frames"] > 0 for row in rows)
        table.rows.append([label, len(rows), float(np.median(unflagged)), max(unflagged), max(flagged, default=0.0)])
        table.rows[-1].append(n_flagged)
    return table.lines()


def requirement_lines(reports: Reports) -> list[str]:
    """Return the requirements that recorded runs missed."""
    table = Table("", ["section", "missed requirement"])
    for section, report in reports.items():
        table.rows += [[section, failure] for failure in report.failures[:MAX_FAILURES]]
        if n_more := len(report.failures[MAX_FAILURES:]):
            table.rows.append([section, f"{n_more} more in its `failures`"])
    return table.lines()


def run_lines(reports: Reports) -> list[str]:
    """Return data file, command, date, commit and machine of each section."""
    rows = []
    for section, command in SECTIONS.items():
        program, _, arguments = command.partition(" ")
        target = {"benchmarks": "bench", "validation": "validate"}[program]
        line = f"`make {target} ARGS={arguments}`" if " " not in arguments else f'`make {target} ARGS="{arguments}"`'
        if section in reports:
            environment = reports[section].environment
            link = f"[{section}](data/{section}.json)"
            rows.append([link, line, *(environment[key] for key in ("date", "commit", "machine"))])
        else:
            rows.append([section, line, "not recorded", "", ""])
    return Table("", ["rows", "command", "date", "commit", "machine"], rows).lines()


def largest_effect(row: Row) -> bool:
    """Return true if half or double of a constant changes the work by more than a fifth."""
    return any(abs(np.log(row[f"{change}: work"])) > np.log(1.2) for change in ("half", "double"))


#: Blocks of the page that are excerpts of a table.
EXCERPTS = {
    "speed": Excerpt(
        "speed",
        "Scene C as shipped",
        ("N", "tolerance m", "x real time", "evaluations a frame", "error m"),
        lambda row: row["cores"] == "all",
    ),
    "spring-time": Excerpt(
        "speed",
        "Nanoseconds per spring",
        ("N", "precision", "C forces", "whole step"),
        lambda row: row["N"] in (32, 128, 512),
    ),
    "threads": Excerpt(
        "speed",
        "A frame of 1/60 s on two threads",
        ("N", "precision", "one thread ms", "two ms", "gain", "two sheets apart", "same bits"),
    ),
    "batch": Excerpt("batch", "Rollouts", ("futures", "frames", "particles", "contact with itself", "by", "wall s")),
    "studies": Excerpt("studies", "throughput", ("what", "wall s", "times real time", "a core", "of plain %")),
    "work-precision-16": Excerpt(
        "work-precision-16",
        "Least time to an error",
        ("error m", "product s", "one thread s", "best library s", "by library", "times"),
    ),
    "work-precision-32": Excerpt(
        "work-precision-32",
        "Least time to an error",
        ("error m", "product s", "one thread s", "best library s", "by library", "times"),
    ),
    "tolerance-sweep": Excerpt(
        "tolerance-sweep",
        "Achieved error",
        ("scene", "achieved m", "achieved / tolerance", "estimate / tolerance", "evaluations", "energy residual"),
        lambda row: row["tolerance m"] == 1e-3,
    ),
    "regimes": Excerpt(
        "regimes",
        "Error / (tolerance x max(1, g))",
        ("what", "1e-03", "1e-06", "1e-09", "g"),
        lambda row: "spring" in row["what"] or "33" in row["what"],
    ),
    "violent": Excerpt("violent", "Most expensive frames", ("what", "flagged", "of the cap", "longest s"), max_rows=4),
    "stability": Excerpt(
        "stability",
        "Scan by stiffness, damping",
        ("stiffness", "cases", "not finite", "largest energy gain", "with flags", "mean wall s"),
        lambda row: row["damping"] == 0.5,
    ),
    "conditioning": Excerpt("conditioning", "Amplification", ("scene", "horizon s", "at the horizon", "largest")),
    "constants": Excerpt(
        "constants",
        "Tuned numbers",
        ("name", "value", "half: error", "half: work", "double: error", "double: work"),
        largest_effect,
    ),
    "capstan": Excerpt("contact", "Capstan", ("mu", "angle deg", "ratio", "exp(mu theta)", "off %")),
    "impacts": Excerpt(
        "contact", "Impacts", ("speed m/s", "sheet falls", "deepest gap / thickness", "evaluations", "flagged")
    ),
    "contact-cost": Excerpt("contact", "Cost", ("what", "sheet", "against", "times", "at most")),
    "folding": Excerpt(
        "contact", "Folding a towel", ("sheet", "times real time", "in the worst second", "contacts at the end")
    ),
    "peers": Excerpt("peers", "Simulated seconds per wall second", ("engine", "N = 64", "N = 128")),
    "peers-contact": Excerpt(
        "peers-contact",
        "Cloth that touches",
        ("engine", "times real time", "deepest mm", "frames crossed", "longest edge", "outcome"),
        lambda row: row["scene"] == "fold",
    ),
}
#: Lines of each block.
BLOCKS: Mapping[str, Callable[[Reports], list[str]]] = {name: excerpt.lines for name, excerpt in EXCERPTS.items()} | {
    "error-bound": error_bound_lines,
    "requirements": requirement_lines,
    "runs": run_lines,
}


def main() -> int:
    """Run the requested sections and draw the page; return 1 if a command failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sections", nargs="*", metavar="section", help=f"of {', '.join(SECTIONS)}; all if left out")
    parser.add_argument("--draw", action="store_true", help="draw the page from the recorded rows and measure nothing")
    resume_help = f"folder for the finished cases of {', '.join(RESUMABLE)}"
    parser.add_argument("--resume", type=Path, metavar="FOLDER", help=resume_help)
    options = parser.parse_args()
    names = [] if options.draw else options.sections or list(SECTIONS)
    if unknown := [name for name in names if name not in SECTIONS]:
        parser.error(f"no section {', '.join(unknown)}; there are {', '.join(SECTIONS)}")
    n_failed = 0
    for name in names:
        resume = ["--resume", f"{options.resume / name}.jsonl"] if options.resume and name in RESUMABLE else []
        n_failed += not run_section(name, resume)
    reports = read_reports()
    PAGE.write_text(page_text(PAGE.read_text(), reports))
    draw_figures(reports, PICTURES)
    return 1 if n_failed else 0


def run_section(name: str, resume: list[str]) -> bool:
    """Run a section's command, or its missing cases, and write its rows; return false if it wrote none."""
    print(f"{name}: python -m {SECTIONS[name]}", flush=True)
    rows = ROWS / f"{name}.json"
    before = rows.stat().st_mtime_ns if rows.exists() else 0
    tool = [sys.executable, "-m", *SECTIONS[name].split()]
    done = subprocess.run([*tool, *resume, "--json", rows], cwd=ROOT, check=False)
    if rows.exists() and rows.stat().st_mtime_ns > before:
        return True
    print(f"python -m {SECTIONS[name]} ended with {done.returncode} and without rows", file=sys.stderr)
    return False


def read_reports() -> Reports:
    """Return the recorded reports by section."""
    paths = {name: ROWS / f"{name}.json" for name in SECTIONS}
    entries = {name: json.loads(path.read_text()) for name, path in paths.items() if path.exists()}
    return {
        name: Report(**{**entry, "tables": [Table(**table) for table in entry["tables"]]})
        for name, entry in entries.items()
    }


def page_text(text: str, reports: Reports) -> str:
    """Return the page's text with each block drawn from the reports."""

    def draw(block: re.Match[str]) -> str:
        return "\n".join([block[1], "", *BLOCKS[block[2]](reports), "", block[3]])

    return re.sub(r"^(<!-- rows (\S+) -->)\n.*?^(<!-- end -->)$", draw, text, flags=re.MULTILINE | re.DOTALL)


if __name__ == "__main__":
    sys.exit(main())
