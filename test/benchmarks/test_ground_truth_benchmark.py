# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks ground-truth` measures each part."""

from __future__ import annotations

import json
from pathlib import Path

from benchmarks.__main__ import main


def test_each_part_has_a_cost(tmp_path: Path) -> None:
    path = tmp_path / "costs.json"
    assert main(["ground-truth", "--sizes", "6", "--seconds", "0.01", "--json", str(path)]) == 0
    ((row,),) = [table["rows"] for table in json.loads(path.read_text())["tables"]]
    assert len(row) == 8
    assert all(value > 0.0 for value in row)
