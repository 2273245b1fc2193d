# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Completeness of a session: sequence numbers, log times, the end record's counts.

The recorder numbers the messages of each topic from 0, including those that it dropped because of a slow disk. Clouds,
wrenches and transforms may be dropped; the end record of each file counts them.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from cloth_sim_ros.session.part import Message, SessionPart
from cloth_sim_ros.session.words import counted
from cloth_sim_ros.verify.verdict import Findings, Place

#: Maximum step back of a log time that the recorder corrects [ns].
_IN_ORDER = 1_000_000_000
_WRAP = 0xFFFFFFFF
#: Limit of the digits of a count.
_DIGITS = 20


@dataclass(slots=True)
class _Topic:
    """State of one topic."""

    kind: str
    droppable: bool
    count: int = 0
    last: Message | None = None
    unnumbered: bool = False
    """True if all of several sequence numbers so far are 0."""
    lacking: int = 0
    """Number of frames without their message since the last message."""
    lacks_from: Place | None = None
    """Position of the first of them."""


class Numbering:
    """Checks the messages of a session from its first file to its last.

    Args:
        findings: collects missing messages and differences.
    """

    def __init__(self, findings: Findings) -> None:
        self._findings = findings
        self._topics: dict[str, _Topic] = {}
        self._part: SessionPart | None = None
        self._opened = 0
        self._log_time: int | None = None
        self._counts = Counter[bool]()
        self._dropped = 0
        self._may_lack = False
        """True if a file is damaged, or lacks an end record with the count of dropped messages."""
        self._gaps: list[tuple[Place, str, int]] = []
        """Missing messages of droppable topics: position of the first frame, topic, count."""

    def begin(self, part: SessionPart, opened: int) -> None:
        """Begin a file that was opened at a log time [ns]."""
        self._part, self._opened = part, opened
        self._counts = Counter()
        if part.number:
            self._log_time = opened

    def declare(self, topic: str, kind: str, *, droppable: bool) -> None:
        """Declare a topic of the node: the kind of its messages, and True if they may be dropped."""
        self._topics.setdefault(topic, _Topic(kind, droppable))

    def is_seen(self, topic: str) -> bool:
        """Return True if a message of the topic was read."""
        return topic in self._topics and self._topics[topic].count > 0

    def last(self, topic: str) -> Message | None:
        """Return the last message of a topic; None before the first."""
        return self._topics[topic].last if topic in self._topics else None

    def is_repeated(self, message: Message) -> bool:
        """Return True if a message repeats the last one of its topic, as at the beginning of a split file."""
        last = self.last(message.topic)
        return last is not None and (last.data, last.publish_time, last.sequence) == (
            message.data,
            message.publish_time,
            message.sequence,
        )

    def add(self, message: Message, *, own: bool, opens: bool = False) -> None:
        """Add a message.

        Args:
            message: the message.
            is_from_node: True for a message of the node, or one that it receives and records.
            is_opening: True if it may repeat the last message of a latched topic at the beginning of a file.
        """
        self._counts[own] += 1
        topic = self._topics.setdefault(message.topic, _Topic("other message", droppable=False))
        if own:
            later = opens and self._part is not None and self._part.number > 0
            repeated = later and self.is_repeated(message)
            self._check_log_time(message, repeated or (later and topic.last is None), topic.kind)
            if not repeated:
                self._check_sequence(message, topic)
        topic.count += 1
        topic.last = message

    def lack(self, topic: str) -> None:
        """Count a missing message of the last frame on a topic."""
        entry = self._topics[topic]
        entry.lacking += 1
        if entry.lacks_from is None:
            entry.lacks_from = self._findings.place

    def finish(self, *, whole: bool) -> None:
        """End a file and compare its end record. `whole`: True if the file was read to its end."""
        part = self._part
        assert part is not None
        notes = part.end_notes
        self._dropped += _number(notes.get("dropped", "")) or 0
        self._may_lack |= bool(part.damage) or not notes or notes.get("reason") == "recovered"
        told = _number(notes.get("messages", ""))
        if not notes and part.at_end:
            self._findings.missing(f"{part.path.name}: its end record, which tells how many messages it held")
        elif notes and told is None:
            self._findings.missing(f"{part.path.name}: the number of its messages in the end record")
        if notes.get("reason") == "recovered":
            self._findings.missing(f"{part.path.name}: recovered, {notes.get('missing') or 'nothing was lost'}")
        if not whole or part.damage or told is None or not part.at_end:
            return
        found = self._counts[True]
        if told not in (found, found + self._counts[False]):
            self._findings.difference(
                "message count",
                f"the end record of {part.path.name}: it counts {counted(told, 'message')}, {found} are there",
            )

    def end(self) -> None:
        """End the session: the missing messages must equal the dropped ones."""
        for name, topic in self._topics.items():
            if topic.unnumbered:
                self._findings.not_compared(name, "without sequence numbers, so that missing ones do not show")
            if topic.lacking and topic.count:
                self._resolve(name, topic, None)
        gone = sum(count for _, _, count in self._gaps)
        if gone <= self._dropped:
            return
        place, name, _ = min(self._gaps)
        if self._may_lack:
            self._findings.missing(f"{counted(gone, 'message')} of {self._names()}, dropped or lost")
        else:
            self._findings.difference(
                self._topics[name].kind,
                f"{counted(gone, 'message')} of {self._names()} that are missing, where the end record tells of "
                f"{self._dropped} dropped",
                place=place,
                count=gone - self._dropped,
            )

    def absent(self, topic: str) -> bool:
        """Return True if frames lack messages of a topic and the session has none."""
        entry = self._topics[topic]
        return not entry.count and entry.lacking > 0

    def pardon(self, place: Place) -> list[str]:
        """Forgive missing messages of the last frame in a file that ended within it; return their topics."""
        found = []
        for name, topic in self._topics.items():
            if topic.lacking == 1 and topic.lacks_from == place:
                topic.lacking, topic.lacks_from = 0, None
                found.append(name)
        return found

    def _names(self) -> str:
        return ", ".join(sorted({name for _, name, _ in self._gaps}))

    def _check_sequence(self, message: Message, topic: _Topic) -> None:
        if topic.last is None:
            # A later file may be verified alone.
            first = self._part is not None and not self._part.number
            self._resolve(message.topic, topic, message.sequence if first else None)
            return
        before, number = topic.last.sequence, message.sequence
        if number == before == 0 and (topic.unnumbered or topic.count == 1):
            topic.unnumbered = True
            self._resolve(message.topic, topic, None)
            return
        ahead = (number - before) & _WRAP
        if not 0 < ahead < _WRAP >> 1:
            word = "twice" if not ahead else f"behind number {before}"
            self._findings.difference(topic.kind, f"number {number} of {message.topic} is there {word}")
            return
        if topic.unnumbered:
            topic.unnumbered = False
            self._findings.difference(topic.kind, f"number 0 of {message.topic} is there twice")
        self._resolve(message.topic, topic, ahead - 1)

    def _resolve(self, name: str, topic: _Topic, gap: int | None) -> None:
        """Compare a gap of sequence numbers (None if unknown) with the number of frames without a message."""
        lacking, place = topic.lacking, topic.lacks_from or self._findings.place
        topic.lacking, topic.lacks_from = 0, None
        gone = lacking if gap is None else gap
        if not gone and not lacking:
            return
        if topic.droppable and gone == lacking:
            self._gaps.append((place, name, gone))
        elif self._is_lenient():
            self._findings.missing(f"{counted(max(gone, lacking), 'message')} of {name}")
        else:
            self._findings.difference(
                topic.kind,
                f"{counted(max(gone, lacking), 'message')} of {name} that {'is' if max(gone, lacking) == 1 else 'are'} "
                "missing",
                place=place,
                count=max(gone, lacking),
            )

    def _is_lenient(self) -> bool:
        part = self._part
        return part is not None and (bool(part.damage) or part.end_notes.get("reason") == "recovered")

    def _check_log_time(self, message: Message, repeated: bool, kind: str) -> None:
        """Check a log time: the publish time, raised to the previous log time if it is shortly before that."""
        before, self._log_time = self._log_time, message.log_time
        if repeated:
            wanted = self._opened
        elif before is not None and 0 < before - message.publish_time < _IN_ORDER:
            wanted = before
        else:
            wanted = message.publish_time
        late = 0 < message.log_time - message.publish_time < _IN_ORDER
        if message.log_time in (wanted, message.publish_time) or (late and self._may_have_dropped()):
            return
        self._findings.difference(
            kind, f"the log time of a message of {message.topic}: {message.log_time} ns is recorded, {wanted} expected"
        )

    def _may_have_dropped(self) -> bool:
        """Return True if a dropped message may have raised later log times."""
        part = self._part
        return self._is_lenient() or (
            part is not None and (not part.end_notes or part.end_notes.get("dropped", "0") != "0" or self._dropped > 0)
        )


def _number(text: str) -> int | None:
    """Return a count of an end record; None if the text is not a count."""
    return int(text) if text.isascii() and text.isdecimal() and len(text) < _DIGITS else None
