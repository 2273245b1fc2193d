# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Events that wait for their frame. Callbacks only put events here; a frame takes those that are due."""

from __future__ import annotations

from collections.abc import Callable

import attrs

from cloth_sim_ros.simulation.events import Event, Move, Target
from cloth_sim_ros.simulation.grippers import GraspResult
from cloth_sim_ros.simulation.simulation import Frame

#: Waiting events, above which targets give way to newer ones and everything else is refused: a second of 1 kHz targets
#: of a few grippers.
MOST_WAITING = 8192


@attrs.frozen(kw_only=True)
class Outcome:
    """What became of an event."""

    #: The frame in which it took effect; None if it didn't.
    frame: Frame | None
    #: For a grasp that took effect.
    grasp: GraspResult | None = None
    #: Why it did not take effect.
    reason: str = ""


Answer = Callable[[Outcome], None]


@attrs.frozen(kw_only=True)
class Entry:
    """A waiting event."""

    event: Event
    #: The frame that is due at or after this ROS time [ns] takes it; 0 for the next one.
    stamp: int = 0
    #: Told what became of it.
    answer: Answer | None = None


class QueueFullError(RuntimeError):
    """Too many events wait."""


class EventQueue:
    """Events in order of arrival. Whoever works on it holds the node's turn: it has no lock of its own."""

    def __init__(self) -> None:
        self._entries: list[Entry] = []
        #: Targets that gave way to newer commands so far.
        self.displaced = 0

    def __len__(self) -> int:
        return len(self._entries)

    def make_room(self, event: Event) -> None:
        """Let the oldest target give way where too many events wait.

        Raises:
            QueueFullError: if none of them is a target.
        """
        if len(self._entries) < MOST_WAITING:
            return
        for index, entry in enumerate(self._entries):
            if isinstance(entry.event, Target | Move):
                del self._entries[index]
                self.displaced += 1
                return
        raise QueueFullError(
            f"{MOST_WAITING} commands wait for a frame already, and {type(event).__name__.lower()} is one more; "
            "is /clock standing still?"
        )

    def put(self, event: Event, *, stamp: int = 0, answer: Answer | None = None, promised: bool = False) -> None:
        """Let an event wait for its frame; one that was promised its place by `make_room` is never refused.

        Raises:
            QueueFullError: if too many wait and none of them is a target, of which the oldest gives way.
        """
        if not promised:
            self.make_room(event)
        self._entries.append(Entry(event=event, stamp=stamp, answer=answer))

    def take(self, due: int) -> list[Entry]:
        """Remove and return what a frame due at a ROS time [ns] takes: by stamp, equal ones in order of arrival."""
        if not self._entries:
            return []
        ready = [entry for entry in self._entries if entry.stamp <= due]
        self._entries = [entry for entry in self._entries if entry.stamp > due]
        # The newest target of a gripper is the one with the newest stamp; all else is stamped 0 and keeps its order.
        return sorted(ready, key=lambda entry: entry.stamp)

    def holds(self, kind: type[Event]) -> bool:
        """Return true if an event of a kind waits."""
        return any(isinstance(entry.event, kind) for entry in self._entries)

    def clear(self, reason: str) -> None:
        """Forget everything that waits, telling why."""
        self.refuse(reason)

    def refuse(self, reason: str, *, keep: tuple[type[Event], ...] = ()) -> None:
        """Answer what waits, but for events of some kinds, with the reason why it takes no effect."""
        entries = [entry for entry in self._entries if not isinstance(entry.event, keep)]
        self._entries = [entry for entry in self._entries if isinstance(entry.event, keep)]
        for entry in entries:
            if entry.answer is not None:
                entry.answer(Outcome(frame=None, reason=reason))
