# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Verdict on a re-run session: counts of compared and differing messages."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field


@dataclass(kw_only=True)
class Verdict:
    """Result of a re-run: counts of compared and differing messages, and the first difference."""

    name: str
    """Names of the session's files."""
    frames: int = 0
    """Number of frames that were run and compared."""
    compared: Counter[str] = field(default_factory=Counter)
    """Number of compared messages by kind: cloud, wrench, topology, command ..."""
    differing: Counter[str] = field(default_factory=Counter)
    """Number of differing frames and messages by kind."""
    not_compared: Counter[tuple[str, str]] = field(default_factory=Counter)
    """Number of messages and entries that were not compared, by topic and reason."""
    absent: list[str] = field(default_factory=list)
    """Topics of the node without a message in the session, although it has frames."""
    different: int = 0
    """Number of frames with a difference."""
    first_frame: int | None = None
    """Index of the first frame with a difference."""
    first_time: float = 0.0
    """Simulated time of that frame [s]."""
    first_reason: str = ""
    """The difference in that frame."""
    largest_deviation: float = 0.0
    """Maximum deviation of a particle's position in any cloud [m]; infinite if a cloud holds a non-finite number."""
    simulated: float = 0.0
    """Simulated time of the re-run [s]."""
    seconds: float = 0.0
    """Wall time of the re-run [s]."""
    environment: list[str] = field(default_factory=list)
    """Differences of code and files from the recording that may change bits; a phrase each."""
    other_arithmetic: str = ""
    """Version of the recorder if its arithmetic differs from this package's; otherwise empty."""
    unexplained: str = ""
    """With other arithmetic: the first frame with a difference that rounding does not explain, and the difference."""
    missing: list[str] = field(default_factory=list)
    """Deficits of the session, a sentence each."""
    damaged: bool = False
    """True if frames in the middle are damaged or missing and could not be compared."""

    @property
    def clouds(self) -> int:
        """Number of clouds that were compared."""
        return self.compared["cloud"]

    @property
    def same(self) -> bool:
        """True if everything compared is equal to the last bit."""
        return self.first_frame is None


@dataclass(frozen=True, slots=True, order=True)
class FramePosition:
    """Position of a frame record in the session: its ordinal, frame index and time."""

    ordinal: int
    """Number of preceding frame records."""
    frame: int = 0
    time: float = 0.0
    """Simulated time [s]."""


class Findings:
    """Collector of the results of several checks, in any order; its methods change `verdict`.

    Args:
        verdict: the verdict.
    """

    def __init__(self, verdict: Verdict) -> None:
        self.verdict = verdict
        self.position = FramePosition(0)
        """Position of the last frame record."""
        self._first_position = FramePosition(-1)
        self._different: set[int] = set()

    def count_compared(self, kind: str, count: int = 1) -> None:
        """Count compared messages of a kind."""
        self.verdict.compared[kind] += count

    def count_not_compared(self, topic: str, reason: str, count: int = 1) -> None:
        """Count messages of a topic that were not compared, by reason."""
        self.verdict.not_compared[topic, reason] += count

    def add_absent(self, topic: str) -> None:
        """Add a topic that lacks its messages, once."""
        if topic not in self.verdict.absent:
            self.verdict.absent.append(topic)

    def add_deficit(self, sentence: str) -> None:
        """Add a deficit of the session, a sentence, once."""
        if sentence not in self.verdict.missing:
            self.verdict.missing.append(sentence)

    def add_difference(
        self, kind: str, reason: str, *, position: FramePosition | None = None, rounding: bool = False, count: int = 1
    ) -> None:
        """Count `count` differing messages of a kind; the first difference in the session's order is described.

        Args:
            kind: kind of message; a frame record is of kind "frame".
            reason: the difference.
            position: frame record of the message; the last one by default.
            rounding: True if other arithmetic can cause the difference.
            count: number of differing messages.
        """
        position = position or self.position
        verdict = self.verdict
        verdict.differing[kind] += count
        if verdict.other_arithmetic and not rounding and not verdict.unexplained:
            verdict.unexplained = f"frame {position.frame}, {reason}"
        self._different.add(position.ordinal)
        verdict.different = len(self._different)
        if verdict.first_frame is None or position < self._first_position:
            self._first_position = position
            verdict.first_frame, verdict.first_time, verdict.first_reason = position.frame, position.time, reason
