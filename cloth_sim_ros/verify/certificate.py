# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a certificate says: numbers for each frame and each window of a second, and what follows from them."""

from __future__ import annotations

from typing import Literal

import attrs

#: Growth of a kick from which positions mean nothing any more.
MOST_GROWTH = 1e3
#: Part of a tolerance within which the certificate's own error must lie for it to mean something.
MOST_OWN = 0.1
#: What counts as the tolerance there where none is set [m].
WITHOUT_TOLERANCE = 1e-4

Verdict = Literal["kept", "flagged", "not kept", "undecided", "no promise"]


@attrs.frozen(kw_only=True)
class FrameAccuracy:
    """How accurate one frame is. Errors are the largest of any particle's position [m]; nan where none can be told."""

    frame: int
    time: float
    """Simulated time at its end [s]."""
    window: int
    """The window that it belongs to."""
    tolerance: float | None
    """Tolerance in force [m]; None where none is set."""
    flagged: bool
    """Whether the simulation said that its error may be above its share."""
    exact: bool
    """Whether what was recorded came out again to the last bit; otherwise the recorded float32 positions are judged."""
    error_of_frame: float
    """From the simulation's own state at the frame's beginning."""
    promise_of_frame: float
    """What that may be: the tolerance times the growth of a kick within the frame, which is looked at where the error
    is above the tolerance [m]; nan where there is no tolerance.
    """
    error: float
    """From the simulation's own state at the window's beginning: what the promise is about."""
    growth: float
    """How often a kick of position or velocity has grown since the window's beginning, the most so far."""
    own: float
    """How far the certificate itself may be off there [m]."""
    floor: float
    """What rounding alone does there, that of recorded positions included [m]."""
    session_error: float
    """Since the session's beginning, or its last reset; nan beyond the horizon."""
    session_growth: float
    session_own: float

    @property
    def promise(self) -> float:
        """What the error may be so far [m]; nan where there is no tolerance."""
        return float("nan") if self.tolerance is None else self.tolerance * max(1.0, self.growth)

    @property
    def stands_out(self) -> bool:
        """Whether the frame alone is further off than a window that begins with it may be, and was not flagged."""
        return not self.flagged and self.error_of_frame > self.promise_of_frame + self.own + self.floor


@attrs.define(kw_only=True)
class Window:
    """A second of simulated time, from the simulation's own state at its beginning; shorter at an end or a reset."""

    number: int
    start: float
    """[s]"""
    end: float = 0.0
    frames: int = 0
    flagged: int = 0
    """Frames that are."""
    tolerance: float | None = None
    """The least in force within it [m]; None where a frame had none."""
    error: float = 0.0
    """The largest of its frames [m]."""
    worst: int = 0
    """Number of the frame that has it."""
    growth: float = 0.0
    """Of kicks at its beginning."""
    later: float = 0.0
    """Of kicks made later in it, which is looked at where those at its beginning do not explain its error."""
    own: float = 0.0
    floor: float = 0.0
    judged: bool = True
    """Whether every frame could be judged."""
    standing_out: int = 0
    """Frames that alone are further off than the promise lets them, unflagged."""

    def add(self, frame: FrameAccuracy) -> None:
        """Take in the next frame."""
        first = not self.frames
        self.end, self.frames = frame.time, self.frames + 1
        self.flagged += frame.flagged
        both = None not in (frame.tolerance, self.tolerance)
        if first:
            self.tolerance = frame.tolerance
        else:
            self.tolerance = min(frame.tolerance, self.tolerance) if both else None  # type: ignore[type-var]
        self.judged = self.judged and frame.error == frame.error
        self.standing_out += frame.stands_out
        if frame.error > self.error or first:
            self.error, self.worst = frame.error, frame.frame
        self.growth = max(self.growth, frame.growth)
        self.own, self.floor = max(self.own, frame.own), max(self.floor, frame.floor)

    @property
    def promise(self) -> float:
        """What the error may be [m]; nan where there is no tolerance."""
        return float("nan") if self.tolerance is None else self.tolerance * max(1.0, self.growth, self.later)

    @property
    def verdict(self) -> Verdict:
        """Whether the promise was kept. Rounding's floor is added to it: below that no error can be."""
        if self.tolerance is None:
            return "no promise"
        if self.standing_out:
            return "not kept"
        allowed = self.promise + self.floor
        if self.judged and self.error <= allowed:
            return "kept" if self.own <= MOST_OWN * allowed else "undecided"
        if self.flagged:
            return "flagged"
        return "not kept" if self.judged and self.error > allowed + self.own else "undecided"


@attrs.frozen(kw_only=True)
class Sample:
    """A frame that an integrator which is not ours ran too, from the same state."""

    frame: int
    stated: float
    """The frame's error by this certificate, from the simulation's own state at its beginning [m]."""
    independent: float
    """The same by the other integrator [m]."""
    difference: float
    """Largest distance of a particle of the one from the same of the other [m]."""
    tolerance: float | None

    @property
    def agrees(self) -> bool:
        """Whether the two differ by at most a fifth of the error, or a tenth of the tolerance."""
        allowed = max(0.2 * self.independent, MOST_OWN * (self.tolerance or WITHOUT_TOLERANCE))
        return self.difference <= allowed


@attrs.define(kw_only=True)
class Certificate:
    """How accurate a session is."""

    name: str
    windows: list[Window] = attrs.field(factory=list)
    frames: list[FrameAccuracy] = attrs.field(factory=list)
    samples: list[Sample] = attrs.field(factory=list)
    horizon: float | None = None
    """Time since the beginning, or a reset, up to which positions mean something [s]; None where the session ends
    before.
    """
    longest: float = 0.0
    """The longest such time that was looked at [s]."""
    altered: int = 0
    """Frames whose recorded positions are not those that their record leads to."""
    seconds: float = 0.0
    """Wall time that it took [s]."""

    def having(self, *verdicts: Verdict) -> list[Window]:
        """Windows of some verdicts."""
        return [window for window in self.windows if window.verdict in verdicts]

    @property
    def kept(self) -> bool:
        """Whether every unflagged window that has a promise is shown to keep it, and the other integrator agrees."""
        return not self.having("not kept", "undecided") and all(sample.agrees for sample in self.samples)
