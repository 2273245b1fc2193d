# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Deviations of an ensemble in a session: their colour range, and the frames to which they belong.

A node sends the deviations of a frame after later frames.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.replay.rows import Moment
from cloth_sim_ros.session.cdr import decode_cloud
from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.reader import SessionReader

#: Colour range of a session that is being recorded, and of one without deviations [m].
FOLLOWED_DEVIATION, _MIN_DEVIATION = 0.01, 1e-6
#: Number of frames of which late deviations find their time.
_N_MOMENTS = 1000


def ensemble_topic(node: str) -> str:
    """Return the topic on which a node publishes the cloud of its ensemble."""
    return f"{node}/ensemble"


def read_deviations(data: bytes, particle_count: int) -> NDArray[np.floating]:
    """Return the deviation of each particle [m], (n,), from an ensemble's cloud. Raises SessionError without them.

    Raises:
        SessionError: if it has none, or those of another cloth.
    """
    deviation = decode_cloud(data).deviation
    if deviation is None or len(deviation) != particle_count:
        raise SessionError(f"a cloud of the ensemble has no field deviation for {particle_count} particles")
    return deviation


def typical_deviation(
    reader: SessionReader, windows: Sequence[tuple[int | None, int | None]], particle_count: int
) -> float:
    """Return a deviation [m] that one in ten clouds exceeds, by a cloud from each window of log times [ns]."""
    largest = [_MIN_DEVIATION]
    for start, end in windows:
        for message in reader.messages([ensemble_topic(reader.node)], start=start, end=end):
            largest.append(float(read_deviations(message.data, particle_count).max()))
            if start is not None:
                break
    return float(np.quantile(largest, 0.9))


class RecentMoments:
    """Simulated and ROS times of the newest 1000 frames."""

    def __init__(self) -> None:
        self._moments: deque[Moment] = deque(maxlen=_N_MOMENTS)

    def add(self, moment: Moment) -> None:
        """Add the times of a frame."""
        self._moments.append(moment)

    def find(self, stamp: int) -> Moment | None:
        """Return the times of the newest frame that was due at a ROS time [ns]; None if it is unknown."""
        return next((moment for moment in reversed(self._moments) if moment.ros_time == stamp), None)
