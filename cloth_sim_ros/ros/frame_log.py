# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""DEBUG lines of frames: the events that each applies, and the integrator's choices."""

from __future__ import annotations

from functools import partial

from cloth_sim_ros.ros.log import ThrottledLog
from cloth_sim_ros.simulation.frame import Frame


class FrameLog:
    """Logs at DEBUG which events a frame applied, and how it was stepped if that has changed.

    Args:
        log: of the node.
    """

    def __init__(self, log: ThrottledLog) -> None:
        self._log = log
        self._choice: tuple[str, str, str] | None = None

    def show(self, frame: Frame) -> None:
        """Log a frame that was computed; nothing unless the level is DEBUG."""
        if not self._log.debugging:
            return
        for event in frame.events:
            self._log.debug(partial("frame {} applies {}".format, frame.index, event))
        advance = frame.advance
        if advance is None:
            return
        choice = advance.integrator, advance.reason, advance.binds
        if choice != self._choice:
            self._choice = choice
            self._log.debug(
                lambda: (
                    f"frame {frame.index}: integrator {advance.integrator}, {advance.steps} steps, limited by "
                    f"{advance.binds}; {advance.reason}"
                )
            )
