# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks scale`: time and memory of large sheets."""

import json

import pytest

from benchmarks.__main__ import main


@pytest.mark.parametrize("kind", ["grid", "mesh"])
def test_scale_reports_time_and_memory(kind, tmp_path):
    file = tmp_path / "scale.json"
    main(["scale", "--kinds", kind, "--sizes", "16", "24", "--seconds", "0.05", "--rounds", "1", "--json", str(file)])
    time, memory = json.loads(file.read_text())["tables"]
    assert [row[:2] for row in time["rows"]] == [[kind, 256], [kind, 576]]
    for row in memory["rows"]:
        state, forces, tables = row[4:7]
        # Positions, velocities and those of the two frames before; at rest also two positions of the last second.
        assert 0.95 * 48e-6 < state / row[1] < 1.1 * 144e-6
        assert forces == pytest.approx(row[1] * 24e-6)
        assert tables > state
