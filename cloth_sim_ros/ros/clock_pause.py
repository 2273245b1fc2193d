# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pause of a cloth whose /clock stands, apart from the user's own."""

from __future__ import annotations

from cloth_sim_ros.ros.event_queue import EventQueue
from cloth_sim_ros.simulation.events import Event, Pause
from cloth_sim_ros.simulation.simulation import Frame, Simulation


class ClockPause:
    """Pauses the simulation while /clock stands, by recorded events; afterwards the user's pause is in force again.

    Args:
        simulation: the cloth.
        queue: has the user's events.
    """

    def __init__(self, simulation: Simulation, queue: EventQueue) -> None:
        self._simulation, self._queue = simulation, queue
        #: Whether the simulation is paused because /clock stands.
        self._holds = False
        self._user = False
        #: Of the newest frame while it stands: the user's pause before it, and whether a pause was added to it.
        self._before = self._added = False

    @property
    def user_paused(self) -> bool:
        """Pause that the user asked for, with a moving /clock as with a standing one."""
        return self._user if self._holds else self._simulation.paused

    def events(self, *, stands: bool) -> tuple[list[Event], list[Event]]:
        """Return what a frame begins with and what it ends with; `stands`: /clock does."""
        if not stands:
            return [Pause(False)] if self._holds and not self._user else [], []
        self._before = self.user_paused
        self._added = not self._simulation.paused or self._queue.holds(Pause)
        return [], [Pause(True)] if self._added else []

    def settle(self, frame: Frame, *, stands: bool) -> None:
        """Take note of a frame that succeeded."""
        if not stands:
            self._holds = False
            return
        pauses = [event.paused for event in frame.events if isinstance(event, Pause)]
        user_pauses = pauses[:-1] if self._added else pauses
        self._user = user_pauses[-1] if user_pauses else self._before
        self._holds = True
