# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Reader of Rerun recordings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np


def rows(path: Path, entity: str, component: str) -> tuple[np.ndarray, list[Any]]:
    """Return simulated times [s] and contents of an entity's component in a recording, sorted by time."""
    from rerun.chunk import RrdReader

    times, values = [], []
    for chunk in RrdReader(path).stream():
        if chunk.entity_path == entity and not chunk.is_static:
            batch = chunk.to_record_batch()
            if component in batch.schema.names:
                times += (1e-9 * batch.column("simulated time").cast("int64").to_numpy()).tolist()
                values += batch.column(component).to_pylist()
    order = np.argsort(times, kind="stable")
    return np.array(times)[order], [values[k] for k in order]
