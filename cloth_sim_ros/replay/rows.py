# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rows for the viewer, sent in batches: one call per entity, not per frame."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    import rerun as rr

#: Names of the timelines.
SIM_TIME, ROS_TIME, FRAME = "simulated time", "ros time", "frame"
#: Maximum simulated time of the viewer, which counts nanoseconds in 64 bits [s].
MAX_TIME = 9e9


class Moment(NamedTuple):
    """Simulated time [s], ROS time [ns] and frame index of a row, on Rerun's three timelines."""

    sim_time: float
    """Simulated time [s]."""
    ros_time: int
    """ROS time [ns since the epoch]."""
    frame: int


class Rows:
    """Rows of one Rerun entity and archetype, collected until they are sent at once.

    Args:
        path: entity path.
        archetype: an archetype class of rerun.
        ragged: components with a variable number of entries per row; the others have a constant number, usually one.
    """

    def __init__(self, path: str, archetype: Any, *, ragged: tuple[str, ...] = ()) -> None:
        self.path = path
        self._archetype = archetype
        self._ragged = ragged
        self._moments: list[Moment] = []
        self._values: dict[str, list[Any]] = {}
        #: Approximate size of the collected rows [bytes].
        self.size = 0

    def __len__(self) -> int:
        return len(self._moments)

    def add(self, moment: Moment, **components: Any) -> None:
        """Collect a row; all rows of an entity have the same components, each an array or a number."""
        self._moments.append(moment)
        for name, value in components.items():
            self._values.setdefault(name, []).append(value)
            self.size += getattr(value, "nbytes", 32)

    def send(self, recording: rr.RecordingStream) -> None:
        """Send the collected rows to Rerun in one call, and clear them."""
        if not self._moments:
            return
        import rerun as rr

        columns: list[Any] = []
        for name, values in self._values.items():
            if name in self._ragged:
                lengths = [len(value) for value in values]
                joined = np.concatenate(values)
                columns.extend(self._archetype.columns(**{name: joined}).partition(lengths))
            else:
                columns.extend(self._archetype.columns(**{name: np.asarray(values)}))
        rr.send_columns(self.path, indexes=_indexes(self._moments), columns=columns, recording=recording)
        self._moments, self._values, self.size = [], {}, 0


def _indexes(moments: list[Moment]) -> list[rr.TimeColumn]:
    import rerun as rr

    sim = np.round(np.array([moment.sim_time for moment in moments]) * 1e9).astype("timedelta64[ns]")
    ros = np.array([moment.ros_time for moment in moments], dtype=np.int64).astype("datetime64[ns]")
    frames = [moment.frame for moment in moments]
    times = [rr.TimeColumn(SIM_TIME, duration=sim), rr.TimeColumn(ROS_TIME, timestamp=ros)]
    return [*times, rr.TimeColumn(FRAME, sequence=frames)]
