# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Page of the benchmarks: its tables and figures come from docs/data."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from types import ModuleType

import pytest

from validation.report import Report, Table

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def benchmarks_page() -> ModuleType:
    path = list(sys.path)
    sys.path.insert(0, str(ROOT / "scripts"))
    try:
        import benchmarks_page
    finally:
        sys.path[:] = path
    return benchmarks_page


def test_page_shows_the_recorded_rows(benchmarks_page: ModuleType) -> None:
    text = benchmarks_page.PAGE.read_text()
    assert benchmarks_page.page_text(text, benchmarks_page.read_reports()) == text, "run make benchmarks ARGS=--draw"
    assert all(f"<!-- rows {name} -->" in text for name in benchmarks_page.BLOCKS)
    assert len(text.split()) <= 4000


def test_each_file_of_rows_is_on_the_page(benchmarks_page: ModuleType) -> None:
    assert {path.stem for path in benchmarks_page.ROWS.iterdir()} == benchmarks_page.read_reports().keys()
    text = benchmarks_page.PAGE.read_text()
    assert all(f"(data/{path.name})" in text for path in benchmarks_page.ROWS.iterdir())


def test_figures_of_the_page_are_drawn(benchmarks_page: ModuleType, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    benchmarks_page.draw_figures(benchmarks_page.read_reports(), tmp_path)
    drawn = {path.name for path in tmp_path.iterdir()}
    assert len(drawn) == 6
    assert drawn == {path.name for path in benchmarks_page.PICTURES.glob("bench_*")}
    text = benchmarks_page.PAGE.read_text()
    assert all(f"(images/{name})" in text for name in drawn)


def test_report_json_has_a_line_for_each_row() -> None:
    table = Table("Times", ["scene, size", "time s"], [["a [m], b", 1.5], ["c", math.nan]])
    text = Report("Speed", "python -m benchmarks speed", [table], environment={}).json_text()
    assert '    ["c", null]\n' in text
    (read,) = json.loads(text)["tables"]
    assert read == {"name": "Times", "columns": ["scene, size", "time s"], "rows": [["a [m], b", 1.5], ["c", None]]}
