# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Builds docs/benchmarks.md from the output of benchmarks and validation, a section per command.

scripts/benchmarks_page.py        All sections, one to two hours on an idle machine.
scripts/benchmarks_page.py speed  This section only.
scripts/benchmarks_page.py --resume FOLDER tolerance  Keeps verdicts there and runs missing ones.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "benchmarks.md"
PICTURES = ROOT / "docs" / "images"
#: Command of each section, in the order of the page.
SECTIONS = {
    "conditioning": "validation conditioning",
    "tolerance-sweep": "validation tolerance-sweep --energy",
    "work-precision-16": "validation work-precision --scene curtain16 --slow",
    "work-precision-32": "validation work-precision --scene curtain32 --slow --limit 30",
    "constants": "validation constants",
    "tolerance": "validation tolerance --seed 1 --count 500",
    "regimes": "validation tolerance --regimes",
    "violent": "validation tolerance --violent --seed 1 --count 200",
    "tolerance-contact": "validation tolerance --contact --seed 1 --count 40",
    "stability": "validation stability",
    "contact": "benchmarks contact",
    "speed": "benchmarks speed",
    "feature-cost": "benchmarks feature-cost",
    "cost-additivity": "benchmarks cost-additivity",
    "scale": "benchmarks scale",
    "peers": "benchmarks peers",
    "peers-contact": "benchmarks peers-contact",
    "batch": "benchmarks batch",
    "studies": "benchmarks studies",
}
#: Sections of many cases, hours of them, that can be gone on with.
RESUMED = ("tolerance", "violent", "tolerance-contact", "stability")
HEAD = """# Benchmarks

`make benchmarks` writes this page from the output of `make bench` (speed, cost, other engines) and `make validate`
(error, stability); nothing here is written by hand. Run a section's command from the top of a clone. Each section names
its machine, versions and commit. NOT MET marks a requirement that was missed. The figures are explained in
docs/time_stepping.md and docs/engine.md.
"""


def main() -> int:
    """Run the requested sections and write the page; return 1 if a command failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sections", nargs="*", metavar="section", help=f"of {', '.join(SECTIONS)}; all if left out")
    resume_help = f"where verdicts of {', '.join(RESUMED)} are kept"
    parser.add_argument("--resume", type=Path, metavar="FOLDER", help=resume_help)
    options = parser.parse_args()
    names = options.sections or list(SECTIONS)
    if unknown := [name for name in names if name not in SECTIONS]:
        parser.error(f"no section {', '.join(unknown)}; there are {', '.join(SECTIONS)}")
    n_failed = 0
    for name in names:
        print(f"{name}: python -m {SECTIONS[name]}", flush=True)
        resume = ["--resume", f"{options.resume / name}.jsonl"] if options.resume and name in RESUMED else []
        text = run_section(SECTIONS[name].split(), resume)
        if text is None:
            n_failed += 1
            continue
        # The page is written after each section, so that results survive an interruption.
        write(page_sections() | {name: text})
    return 1 if n_failed else 0


def run_section(command: list[str], resume: list[str]) -> str | None:
    """Run a command, or its missing cases; return its section with pictures, or None if it failed."""
    with tempfile.TemporaryDirectory() as folder:
        page, plots = Path(folder) / "section.md", Path(folder) / "plots"
        tool = [sys.executable, "-m", *command]
        done = subprocess.run([*tool, *resume, "--markdown", page, "--plots", plots], cwd=ROOT, check=False)
        if not page.exists():
            print(f"python -m {' '.join(command)} ended with {done.returncode} and without figures", file=sys.stderr)
            return None
        text = page.read_text().rstrip()
        for plot in sorted(plots.glob("*.png")) if plots.exists() else []:
            plot.rename(PICTURES / f"bench_{plot.name}")
            text += f"\n\n![{plot.stem}](images/bench_{plot.name})"
        return text + "\n"


def page_sections() -> dict[str, str]:
    """Return the page's sections by name."""
    if not PAGE.exists():
        return {}
    parts = re.split(r"^<!-- (\S+) -->\n", PAGE.read_text(), flags=re.MULTILINE)
    return {name: text.strip() + "\n" for name, text in zip(parts[1::2], parts[2::2], strict=True)}


def write(sections: dict[str, str]) -> None:
    """Write the page."""
    body = [f"<!-- {name} -->\n{sections[name]}" for name in SECTIONS if name in sections]
    PAGE.write_text("\n".join([HEAD, *body]))


if __name__ == "__main__":
    sys.exit(main())
