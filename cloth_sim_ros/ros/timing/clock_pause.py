# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pause of a cloth while /clock stands, separate from the user's pause."""

from __future__ import annotations

from cloth_sim_ros.ros.timing.event_queue import EventQueue
from cloth_sim_ros.simulation.events import Event, Pause
from cloth_sim_ros.simulation.simulation import Frame, Simulation


class ClockPause:
    """Pause of the simulation while a followed /clock stands still; the user's pause is restored afterwards.

    Args:
        simulation: the cloth.
        queue: holds the user's events.
    """

    def __init__(self, simulation: Simulation, queue: EventQueue) -> None:
        self._simulation, self._queue = simulation, queue
        #: True while the simulation is paused because /clock stands.
        self._is_active = False
        self._user_pause = False
        #: For the newest frame while /clock stands: the user's pause before it, and whether a pause was added.
        self._previous_user_pause = self._has_added_pause = False

    @property
    def user_paused(self) -> bool:
        """True if the user paused the cloth, regardless of /clock."""
        return self._user_pause if self._is_active else self._simulation.paused

    def events(self, *, stands: bool) -> tuple[list[Event], list[Event]]:
        """Return pause events to apply before, and after, the user's events of a frame; `commit` follows a good frame.

        Args:
            stands: true if /clock stands.
        """
        if not stands:
            return [Pause(False)] if self._is_active and not self._user_pause else [], []
        self._previous_user_pause = self.user_paused
        self._has_added_pause = not self._simulation.paused or self._queue.contains(Pause)
        return [], [Pause(True)] if self._has_added_pause else []

    def commit(self, frame: Frame, *, stands: bool) -> None:
        """Update the user's pause from the events of a frame that succeeded."""
        if not stands:
            self._is_active = False
            return
        pauses = [event.paused for event in frame.events if isinstance(event, Pause)]
        user_pauses = pauses[:-1] if self._has_added_pause else pauses
        self._user_pause = user_pauses[-1] if user_pauses else self._previous_user_pause
        self._is_active = True
