# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Verdict on a session: what was compared, what differs, what was not compared."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field


@dataclass(kw_only=True)
class Verdict:
    """How a session came out when it was run again."""

    name: str
    """The session's files."""
    frames: int = 0
    """Frames that were run and compared."""
    compared: Counter[str] = field(default_factory=Counter)
    """Messages that were compared, by kind: cloud, wrench, topology, command ..."""
    differing: Counter[str] = field(default_factory=Counter)
    """Of the frames and messages those that differ, by kind."""
    not_compared: Counter[tuple[str, str]] = field(default_factory=Counter)
    """Messages and values that were not compared, by topic and reason."""
    absent: list[str] = field(default_factory=list)
    """Topics of the node of which the session holds no message, though it holds frames."""
    different: int = 0
    """Frames of which anything differs."""
    first_frame: int | None = None
    """Number of the first of them."""
    first_time: float = 0.0
    """Its simulated time [s]."""
    first_reason: str = ""
    """What differs there."""
    largest_deviation: float = 0.0
    """Of any particle's position in any cloud [m]; infinite where a cloud holds something that is no number."""
    simulated: float = 0.0
    """Simulated time that was run [s]."""
    seconds: float = 0.0
    """Wall time that it took [s]."""
    environment: list[str] = field(default_factory=list)
    """Differences of code and files from the recording's that change bits, or may; a phrase each."""
    other_arithmetic: str = ""
    """By what it was recorded, where that rounds otherwise than this package; empty where it does not."""
    unexplained: str = ""
    """With other arithmetic: the first frame and what differs in it that no rounding explains."""
    missing: list[str] = field(default_factory=list)
    """What the session lacks, a sentence each."""
    damaged: bool = False
    """True if frames are damaged or missing in the middle, so that they could not be compared."""

    @property
    def clouds(self) -> int:
        """Clouds that were compared."""
        return self.compared["cloud"]

    @property
    def same(self) -> bool:
        """True if all that was compared came out the same to the last bit."""
        return self.first_frame is None


@dataclass(frozen=True, slots=True, order=True)
class Place:
    """A frame record's place in the session."""

    ordinal: int
    """Number of frame records before it."""
    frame: int = 0
    time: float = 0.0
    """Simulated time [s]."""


class Findings:
    """Adds what is found, in any order, to a verdict.

    Args:
        verdict: it.
    """

    def __init__(self, verdict: Verdict) -> None:
        self.verdict = verdict
        self.place = Place(0)
        """The frame record that was run last."""
        self._first = Place(-1)
        self._different: set[int] = set()

    def compared(self, kind: str, count: int = 1) -> None:
        """Count messages that were compared."""
        self.verdict.compared[kind] += count

    def not_compared(self, topic: str, reason: str, count: int = 1) -> None:
        """List messages that were not compared."""
        self.verdict.not_compared[topic, reason] += count

    def absent(self, topic: str) -> None:
        """Name a topic of which there must be messages, and is none; once."""
        if topic not in self.verdict.absent:
            self.verdict.absent.append(topic)

    def missing(self, sentence: str) -> None:
        """Say what the session lacks, once."""
        if sentence not in self.verdict.missing:
            self.verdict.missing.append(sentence)

    def difference(
        self, kind: str, reason: str, *, place: Place | None = None, rounding: bool = False, count: int = 1
    ) -> None:
        """Note what differs.

        Args:
            kind: of message; a frame's own record is a frame.
            reason: what differs.
            place: the frame record that it belongs to; the last one by default.
            rounding: whether other arithmetic alone can make it differ.
            count: messages that differ so.
        """
        place = place or self.place
        verdict = self.verdict
        verdict.differing[kind] += count
        if verdict.other_arithmetic and not rounding and not verdict.unexplained:
            verdict.unexplained = f"frame {place.frame}, {reason}"
        self._different.add(place.ordinal)
        verdict.different = len(self._different)
        if verdict.first_frame is None or place < self._first:
            self._first = place
            verdict.first_frame, verdict.first_time, verdict.first_reason = place.frame, place.time, reason
