# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""DEBUG log of frames: applied events and the integrator's choices."""

from __future__ import annotations

from functools import partial

from cloth_sim_ros.ros.reporting.log import ThrottledLog
from cloth_sim_ros.simulation.frame import Frame


class FrameLog:
    """Logs at DEBUG the events of each frame, and changes of integrator, reason or step limit.

    Args:
        log: the node's log.
    """

    def __init__(self, log: ThrottledLog) -> None:
        self._log = log
        self._choice: tuple[str, str, str] | None = None

    def log(self, frame: Frame) -> None:
        """Log a frame if the level is DEBUG."""
        if not self._log.debugging:
            return
        for event in frame.events:
            self._log.debug(partial("frame {} applies {}".format, frame.index, event))
        advance = frame.advance
        if advance is None:
            return
        choice = advance.integrator, advance.reason, advance.limited_by
        if choice != self._choice:
            self._choice = choice
            self._log.debug(
                lambda: (
                    f"frame {frame.index}: integrator {advance.integrator}, {advance.steps} steps, limited by "
                    f"{advance.limited_by}; {advance.reason}"
                )
            )
