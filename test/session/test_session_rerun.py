# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rerun's MCAP reader agrees on every message and shows the cloth."""

from __future__ import annotations

from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from support import session_samples as samples

from cloth_sim_ros.session.mcap_builder import Compression
from cloth_sim_ros.session.writer import WriterOptions

chunk = pytest.importorskip("rerun.chunk")
CONTENT = list(samples.samples(60))


@pytest.fixture(params=get_args(Compression))
def session(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    options = WriterOptions(chunk_bytes=8192, compression=request.param, sync_seconds=0)
    return samples.write_session(tmp_path, CONTENT, options=options)


def _columns(session: Path, decoder: str, component: str) -> list[tuple[str, int, Any]]:
    """Return entity path, log time and contents of a component, for every row that has it."""
    rows = []
    for piece in chunk.McapReader(session, decoders=[decoder]).stream().to_chunks():
        batch = piece.to_record_batch()
        if component in batch.schema.names:
            times = batch.column("message_log_time").cast("int64").to_pylist()
            rows += list(zip([str(piece.entity_path)] * len(times), times, batch.column(component), strict=True))
    return rows


def test_rerun_agrees_on_every_message(session: Path) -> None:
    got = [
        (topic, time, value.values[0].values.to_numpy().tobytes())
        for topic, time, value in _columns(session, "raw", "McapMessage:data")
    ]
    expected = [(item.topic, item.log_time, item.data) for item in CONTENT]
    assert sorted(got) == sorted(expected)
    for topic in {item.topic for item in CONTENT}:
        assert [item for item in got if item[0] == topic] == [item for item in expected if item[0] == topic]


def test_rerun_sees_the_cloth(session: Path) -> None:
    rows = _columns(session, "ros2msg", "Points3D:positions")
    assert [topic for topic, _, _ in rows] == [samples.POINTS] * 60
    for frame, (_, _, value) in enumerate(sorted(rows, key=lambda row: row[1])):
        got = np.array(value.values.to_pylist(), np.float32)
        assert np.array_equal(got, samples.positions(frame, 40))


def test_rerun_reports_no_damage(session: Path) -> None:
    info = chunk.McapReader(session).info()
    assert (info.profile, info.library, info.summary_source) == ("ros2", "cloth_sim_ros", "embedded")
    assert (info.message_count, info.attachment_count, info.metadata_count) == (len(CONTENT), 3, 2)
    assert not info.chunks.has_overlapping_time_ranges
