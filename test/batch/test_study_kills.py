# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A study under fire: a sample of test/soak_studies.py, with Dask's documented commands over TCP."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("distributed")
pytest.importorskip("pyarrow")


def test_killed_workers_a_killed_scheduler_and_a_full_disk_change_no_digest(tmp_path: Path) -> None:
    from soak_studies import soak

    count = soak(tmp_path, runs=24, kills=2, duration=0.5, say=lambda _text: None)
    assert count["runs that differ"] == 0
    assert count["scheduler kills"] == 1
    assert count["full disks"] == 1
    assert count["clients"] == 2
