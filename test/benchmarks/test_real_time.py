# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks real-time`, on tiny sheets."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.__main__ import main
from benchmarks.speed.real_time import CHOICES

OPTIONS = [
    "--moduli",
    "100",
    "1e6",
    "--choices-size",
    "6",
    "--choices-moduli",
    "1e3",
    "--frames",
    "5",
    "--rounds",
    "1",
    "--garment",
    "0",
]


def test_real_time_tables_have_all_sizes_and_integrators(tmp_path: Path) -> None:
    file = tmp_path / "out.json"
    assert main(["real-time", "--sizes", "6", "12", *OPTIONS, "--json", str(file)]) == 0
    factors, evaluations, choices = json.loads(file.read_text())["tables"]
    assert [row[0] for row in factors["rows"]] == [row[0] for row in evaluations["rows"]] == ["6 x 6", "12 x 12"]
    for row in evaluations["rows"]:
        # A stiffer sheet takes more steps: a hundred times the frequency, but accuracy limits the soft one.
        assert row[2] > 5.0 * row[1]
    assert all(factor > 0.0 for row in factors["rows"] for factor in row[1:])
    assert [(row[1], row[2]) for row in choices["rows"]] == [(name, limit or "fixed step") for name, limit in CHOICES]
    estimates = {(row[1], row[2]): row[5] for row in choices["rows"]}
    assert estimates["leapfrog", "fixed step"] == "-"
    assert estimates["auto", 1e-8] < estimates["auto", 1e-2]


def test_real_time_refuses_no_frames(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["real-time", "--frames", "0"])
    assert "--frames" in capsys.readouterr().err
