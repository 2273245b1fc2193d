# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Queue of events that wait for their frame.

Callbacks put events into it; a frame takes those that are due.
"""

from __future__ import annotations

from collections.abc import Callable

import attrs

from cloth_sim_ros.simulation.bodies.grippers import GraspResult
from cloth_sim_ros.simulation.events import Event, Move, Step, Target
from cloth_sim_ros.simulation.simulation import Frame

#: Capacity of the queue. Above it, new events evict the oldest target; without a target they are refused. Enough for a
#: second of targets of a few grippers at 1 kHz.
MAX_QUEUED_EVENTS = 8192


@attrs.frozen(kw_only=True)
class EventResult:
    """Result of an event: the frame in which it took effect, or the reason why it did not."""

    #: The frame in which the event took effect; None if it did not.
    frame: Frame | None
    #: Result of a grasp that took effect.
    grasp: GraspResult | None = None
    #: The reason if the event did not take effect.
    reason: str = ""


AnswerCallback = Callable[[EventResult], None]


@attrs.frozen(kw_only=True)
class QueuedEvent:
    """Event that waits for its frame, with its due time and the callback for its result."""

    event: Event
    #: The first frame due at or after this ROS time [ns] takes the event; 0 for the next frame.
    stamp: int = 0
    #: Called with the result.
    answer: AnswerCallback | None = None


class QueueFullError(RuntimeError):
    """Error: the queue of events is full and holds no target that could be evicted."""


class EventQueue:
    """Events that wait for a frame, in order of arrival. It is not thread-safe: callers hold the node's lock."""

    def __init__(self) -> None:
        self._entries: list[QueuedEvent] = []
        #: Number of targets that were evicted for newer events.
        self.n_evicted = 0

    def __len__(self) -> int:
        return len(self._entries)

    def evict_target(self, event: Event) -> None:
        """Make room for an event: if the queue is full, remove the oldest target unanswered, or raise QueueFullError.

        Raises:
            QueueFullError: if the queue is full and holds no target.
        """
        if len(self._entries) < MAX_QUEUED_EVENTS:
            return
        for index, entry in enumerate(self._entries):
            if isinstance(entry.event, Target | Move):
                del self._entries[index]
                self.n_evicted += 1
                return
        raise QueueFullError(
            f"{type(event).__name__.lower()} is refused: {MAX_QUEUED_EVENTS} commands wait for a frame already; "
            "send fewer, and look in /diagnostics if frames go on"
        )

    def put(
        self, event: Event, *, stamp: int = 0, answer: AnswerCallback | None = None, reserved: bool = False
    ) -> None:
        """Queue an event for its frame; raise QueueFullError without room, unless `evict_target` `reserved` it before.

        Raises:
            QueueFullError: if the queue is full and holds no target.
        """
        if not reserved:
            self.evict_target(event)
        self._entries.append(QueuedEvent(event=event, stamp=stamp, answer=answer))

    def pop_ready(self, stamp: int) -> list[QueuedEvent]:
        """Remove and return the events due at a ROS time [ns], by stamp; equal stamps keep the order of arrival.

        Of several steps it returns the first, because each is a frame.
        """
        if not self._entries:
            return []
        ready: list[QueuedEvent] = []
        later: list[QueuedEvent] = []
        has_step = False
        for entry in self._entries:
            is_step = isinstance(entry.event, Step)
            (later if entry.stamp > stamp or (is_step and has_step) else ready).append(entry)
            has_step = has_step or is_step
        self._entries = later
        # The newest target of a gripper is the one with the newest stamp. Other events have stamp 0 and keep order.
        return sorted(ready, key=lambda entry: entry.stamp)

    def drop_later(self, stamp: int) -> None:
        """Remove, without an answer, the targets due after a ROS time [ns]; other events are due at once."""
        self._entries = [entry for entry in self._entries if entry.stamp <= stamp]

    def withdraw(self, event: Event) -> None:
        """Remove a waiting event, that very object, without an answer."""
        self._entries = [entry for entry in self._entries if entry.event is not event]

    def contains(self, kind: type[Event]) -> bool:
        """Return true if an event of a class waits in the queue."""
        return any(isinstance(entry.event, kind) for entry in self._entries)

    def refuse(self, reason: str, *, keep: tuple[type[Event], ...] = ()) -> None:
        """Remove waiting events and answer them with a reason, except those of the classes in `keep`."""
        entries = [entry for entry in self._entries if not isinstance(entry.event, keep)]
        self._entries = [entry for entry in self._entries if isinstance(entry.event, keep)]
        for entry in entries:
            if entry.answer is not None:
                entry.answer(EventResult(frame=None, reason=reason))
