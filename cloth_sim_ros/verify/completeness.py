# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Completeness of a session: sequence numbers, log times, the end record's counts.

The recorder numbers the messages of each topic from 0, including those that it dropped because of a slow disk. Clouds,
wrenches and transforms may be dropped; the end record of each file counts them.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from cloth_sim_ros.session.part import RECOVERED, Message, SessionPart
from cloth_sim_ros.session.plurals import pluralize
from cloth_sim_ros.verify.verdict import Findings, FramePosition

#: Maximum step back of a log time that the recorder corrects [ns].
_MAX_REORDERING = 1_000_000_000
_SEQUENCE_MASK = 0xFFFFFFFF
#: Limit of the digits of a count.
_MAX_COUNT_DIGITS = 20


@dataclass(slots=True)
class _TopicState:
    """Messages and gaps of one topic so far."""

    kind: str
    droppable: bool
    count: int = 0
    last: Message | None = None
    unnumbered: bool = False
    """True if all of several sequence numbers so far are 0."""
    n_missing: int = 0
    """Number of frames without their message since the last message."""
    missing_from: FramePosition | None = None
    """Position of the first of them."""


class CompletenessCheck:
    """Search for missing messages of a session: by sequence numbers, log times and end records.

    Args:
        findings: collects missing messages and differences.
    """

    def __init__(self, findings: Findings) -> None:
        self._findings = findings
        self._topics: dict[str, _TopicState] = {}
        self._part: SessionPart | None = None
        self._open_time = 0
        self._log_time: int | None = None
        self._counts = Counter[bool]()
        self._dropped = 0
        self._may_be_incomplete = False
        """True if a file is damaged, or lacks an end record with the count of dropped messages."""
        self._gaps: list[tuple[FramePosition, str, int]] = []
        """Missing messages of droppable topics: position of the first frame, topic, count."""

    def begin(self, part: SessionPart, open_time: int) -> None:
        """Begin a file, opened at a log time `open_time` [ns]: its messages are counted from 0."""
        self._part, self._open_time = part, open_time
        self._counts = Counter()
        if part.index:
            self._log_time = open_time

    def declare(self, topic: str, kind: str, *, droppable: bool) -> None:
        """Declare a topic of the node: the kind of its messages, and True if they may be dropped."""
        self._topics.setdefault(topic, _TopicState(kind, droppable))

    def is_seen(self, topic: str) -> bool:
        """Return True if a message of the topic was read."""
        return topic in self._topics and self._topics[topic].count > 0

    def last_message(self, topic: str) -> Message | None:
        """Return the last message of a topic; None before the first."""
        return self._topics[topic].last if topic in self._topics else None

    def is_repeated(self, message: Message) -> bool:
        """Return True if a message repeats the last one of its topic, as at the beginning of a split file."""
        last = self.last_message(message.topic)
        if last is None or last.data != message.data:
            return False
        return last.publish_time == message.publish_time and last.sequence == message.sequence

    def add(self, message: Message, *, is_from_node: bool, is_opening: bool = False) -> None:
        """Count the next message, check its sequence number and its log time, and report differences.

        Args:
            message: the message.
            is_from_node: True for a message of the node, or one that it receives and records.
            is_opening: True if it may repeat the last message of a latched topic at the beginning of a file.
        """
        self._counts[is_from_node] += 1
        topic = self._topics.setdefault(message.topic, _TopicState("other message", droppable=False))
        if is_from_node:
            is_reopening = is_opening and self._part is not None and self._part.index > 0
            is_repeated = is_reopening and self.is_repeated(message)
            self._check_log_time(message, is_repeated or (is_reopening and topic.last is None), topic.kind)
            if not is_repeated:
                self._check_sequence(message, topic)
        topic.count += 1
        topic.last = message

    def add_missing(self, topic: str) -> None:
        """Count one message that the last frame lacks on a declared topic."""
        entry = self._topics[topic]
        entry.n_missing += 1
        if entry.missing_from is None:
            entry.missing_from = self._findings.position

    def finish(self, *, whole: bool) -> None:
        """End a file: report a missing or recovered end record and, if read `whole`, another count of messages."""
        part = self._part
        assert part is not None
        notes = part.end_notes
        self._dropped += _parse_count(notes.get("dropped", "")) or 0
        self._may_be_incomplete |= bool(part.damage) or not notes or notes.get("reason") == RECOVERED
        announced = _parse_count(notes.get("messages", ""))
        if not notes and part.at_end:
            self._findings.add_deficit(f"{part.path.name}: its end record, which tells how many messages it held")
        elif notes and announced is None:
            self._findings.add_deficit(f"{part.path.name}: the number of its messages in the end record")
        if notes.get("reason") == RECOVERED and not notes.get("missing"):
            self._findings.add_deficit(f"{part.path.name}: recovered, nothing was lost")
        if not whole or part.damage or announced is None or not part.at_end:
            return
        n_messages = self._counts[True]
        if announced not in (n_messages, n_messages + self._counts[False]):
            counts = f"it counts {pluralize(announced, 'message')}, {n_messages} are there"
            self._findings.add_difference("message count", f"the end record of {part.path.name}: {counts}")

    def end(self) -> None:
        """End the session; report missing messages that exceed the dropped ones."""
        for name, topic in self._topics.items():
            if topic.unnumbered:
                self._findings.count_not_compared(name, "without sequence numbers, so that missing ones do not show")
            if topic.n_missing and topic.count:
                self._close_gap(name, topic, None)
        n_missing = sum(count for _, _, count in self._gaps)
        if n_missing <= self._dropped:
            return
        position, name, _ = min(self._gaps)
        if self._may_be_incomplete:
            self._findings.add_deficit(f"{pluralize(n_missing, 'message')} of {self._gap_topics()}, dropped or lost")
        else:
            kind, count = self._topics[name].kind, n_missing - self._dropped
            gaps = f"{pluralize(n_missing, 'message')} of {self._gap_topics()} that are missing"
            reason = f"{gaps}, where the end record tells of {self._dropped} dropped"
            self._findings.add_difference(kind, reason, position=position, count=count)

    def is_absent(self, topic: str) -> bool:
        """Return True if a declared topic has no message in the session, although frames demand some."""
        entry = self._topics[topic]
        return not entry.count and entry.n_missing > 0

    def forgive_last_frame(self, position: FramePosition) -> list[str]:
        """Forgive the messages that the frame of an aborted recording lacks; return their topics."""
        topics = []
        for name, topic in self._topics.items():
            if topic.n_missing == 1 and topic.missing_from == position:
                topic.n_missing, topic.missing_from = 0, None
                topics.append(name)
        return topics

    def _gap_topics(self) -> str:
        return ", ".join(sorted({name for _, name, _ in self._gaps}))

    def _check_sequence(self, message: Message, topic: _TopicState) -> None:
        if topic.last is None:
            # A later file may be verified alone.
            is_first_part = self._part is not None and not self._part.index
            self._close_gap(message.topic, topic, message.sequence if is_first_part else None)
            return
        previous, sequence = topic.last.sequence, message.sequence
        if sequence == previous == 0 and (topic.unnumbered or topic.count == 1):
            topic.unnumbered = True
            self._close_gap(message.topic, topic, None)
            return
        increment = (sequence - previous) & _SEQUENCE_MASK
        if not 0 < increment < _SEQUENCE_MASK >> 1:
            problem = "twice" if not increment else f"behind number {previous}"
            self._findings.add_difference(topic.kind, f"number {sequence} of {message.topic} is there {problem}")
            return
        if topic.unnumbered:
            topic.unnumbered = False
            self._findings.add_difference(topic.kind, f"number 0 of {message.topic} is there twice")
        self._close_gap(message.topic, topic, increment - 1)

    def _close_gap(self, name: str, topic: _TopicState, gap: int | None) -> None:
        """Report messages missing on a topic, unless they may be dropped ones; `gap`: their number, if known."""
        n_missing, position = topic.n_missing, topic.missing_from or self._findings.position
        topic.n_missing, topic.missing_from = 0, None
        gap_size = n_missing if gap is None else gap
        if not gap_size and not n_missing:
            return
        if topic.droppable and gap_size == n_missing:
            self._gaps.append((position, name, gap_size))
            return
        count = max(gap_size, n_missing)
        messages = f"{pluralize(count, 'message')} of {name}"
        if self._is_damaged():
            self._findings.add_deficit(messages)
        else:
            reason = f"{messages} that {'is' if count == 1 else 'are'} missing"
            self._findings.add_difference(topic.kind, reason, position=position, count=count)

    def _is_damaged(self) -> bool:
        part = self._part
        return part is not None and (bool(part.damage) or part.end_notes.get("reason") == RECOVERED)

    def _check_log_time(self, message: Message, is_repeated: bool, kind: str) -> None:
        """Report a log time that is neither the publish time nor, if that is slightly earlier, the previous one."""
        previous, self._log_time = self._log_time, message.log_time
        if is_repeated:
            expected = self._open_time
        elif previous is not None and 0 < previous - message.publish_time < _MAX_REORDERING:
            expected = previous
        else:
            expected = message.publish_time
        is_late = 0 < message.log_time - message.publish_time < _MAX_REORDERING
        if message.log_time in (expected, message.publish_time) or (is_late and self._may_have_dropped()):
            return
        times = f"{message.log_time} ns is recorded, {expected} expected"
        self._findings.add_difference(kind, f"the log time of a message of {message.topic}: {times}")

    def _may_have_dropped(self) -> bool:
        """Return True if a dropped message may have raised later log times."""
        part = self._part
        if part is None or self._is_damaged():
            return self._is_damaged()
        return not part.end_notes or part.end_notes.get("dropped", "0") != "0" or self._dropped > 0


def _parse_count(text: str) -> int | None:
    """Return the count that a text of an end record holds; None if it is no count."""
    return int(text) if text.isascii() and text.isdecimal() and len(text) < _MAX_COUNT_DIGITS else None
