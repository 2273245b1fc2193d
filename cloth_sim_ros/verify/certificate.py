# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Certificate of a session's accuracy: errors and bounds of frames and windows."""

from __future__ import annotations

from typing import Literal

import attrs

from cloth_sim_ros.physics.old_names import with_old_names

#: Amplification above which positions are unpredictable.
MAX_AMPLIFICATION = 1e3
#: Maximum uncertainty of the certificate, as a fraction of the tolerance.
MAX_UNCERTAINTY_FRACTION = 0.1
#: Substitute for the tolerance if none is set [m].
DEFAULT_TOLERANCE = 1e-4

WindowVerdict = Literal["kept", "flagged", "not kept", "undecided", "no promise"]


@with_old_names(
    growth="amplification",
    own="uncertainty",
    promise_of_frame="error_bound_of_frame",
    session_growth="session_amplification",
    session_own="session_uncertainty",
)
@attrs.frozen(kw_only=True)
class FrameAccuracy:
    """Accuracy of one frame. Errors are maxima over the particles' positions [m]; nan if unknown."""

    frame: int
    time: float
    """Simulated time at the end of the frame [s]."""
    window: int
    """Index of its window."""
    tolerance: float | None
    """Effective tolerance [m]; None if none is set."""
    flagged: bool
    """True if the simulation flagged the frame: its error may exceed its share of the tolerance."""
    exact: bool
    """True if the re-run reproduced the recording to the last bit; otherwise the recorded positions are assessed."""
    error_of_frame: float
    """Error from the simulation's state at the frame's beginning [m]."""
    error_bound_of_frame: float
    """Bound of `error_of_frame`: the tolerance times the amplification within the frame [m]; nan without a tolerance.

    The amplification is measured only if the error exceeds the tolerance; otherwise it counts as 1.
    """
    error: float
    """Error from the simulation's state at the window's beginning; the error bound applies to it [m]."""
    amplification: float
    """Largest factor by which a small perturbation of position or velocity grew since the window's beginning."""
    uncertainty: float
    """Uncertainty of the certificate [m]."""
    floor: float
    """Effect of rounding, including that of recorded positions [m]."""
    session_error: float
    """Error since the session's beginning or its last reset [m]; nan beyond the horizon."""
    session_amplification: float
    session_uncertainty: float

    @property
    def error_bound(self) -> float:
        """Error bound from the window's beginning to this frame [m]; nan without a tolerance."""
        return float("nan") if self.tolerance is None else self.tolerance * max(1.0, self.amplification)

    @property
    def violates_bound(self) -> bool:
        """True if the error of the frame alone exceeds its bound and the frame is not flagged."""
        return not self.flagged and self.error_of_frame > self.error_bound_of_frame + self.uncertainty + self.floor


@with_old_names(
    growth="amplification",
    judged="error_known",
    later="later_amplification",
    number="index",
    own="uncertainty",
    standing_out="violating_frames",
)
@attrs.define(kw_only=True)
class AccuracyWindow:
    """Measured accuracy of a second of simulated time, or less before an end or a reset."""

    index: int
    start: float
    """Simulated time at its beginning [s]."""
    end: float = 0.0
    frames: int = 0
    flagged: int = 0
    """Number of flagged frames."""
    tolerance: float | None = None
    """Minimum of its frames [m]; None if a frame has none."""
    error: float = 0.0
    """Maximum error of its frames [m]."""
    worst: int = 0
    """Index of the frame with the maximum error."""
    amplification: float = 0.0
    """Amplification of perturbations at its beginning."""
    later_amplification: float = 0.0
    """Amplification of later perturbations; measured if those at its beginning do not explain its error."""
    uncertainty: float = 0.0
    floor: float = 0.0
    error_known: bool = True
    """True if the error of every frame is known."""
    violating_frames: int = 0
    """Number of unflagged frames whose error alone exceeds its bound."""

    def add(self, frame: FrameAccuracy) -> None:
        """Include the next frame in the counts and maxima of the window."""
        is_first = not self.frames
        self.end, self.frames = frame.time, self.frames + 1
        self.flagged += frame.flagged
        has_tolerances = None not in (frame.tolerance, self.tolerance)
        if is_first:
            self.tolerance = frame.tolerance
        else:
            self.tolerance = min(frame.tolerance, self.tolerance) if has_tolerances else None  # type: ignore[type-var]
        self.error_known = self.error_known and frame.error == frame.error
        self.violating_frames += frame.violates_bound
        if frame.error > self.error or is_first:
            self.error, self.worst = frame.error, frame.frame
        self.amplification = max(self.amplification, frame.amplification)
        self.uncertainty, self.floor = max(self.uncertainty, frame.uncertainty), max(self.floor, frame.floor)

    @property
    def error_bound(self) -> float:
        """Error bound of the window, tolerance times max(1, amplification) [m]; nan without a tolerance."""
        if self.tolerance is None:
            return float("nan")
        return self.tolerance * max(1.0, self.amplification, self.later_amplification)

    @property
    def verdict(self) -> WindowVerdict:
        """Verdict of the window: kept, not kept, undecided, flagged, or without a bound ("no promise")."""
        if self.tolerance is None:
            return "no promise"
        if self.violating_frames:
            return "not kept"
        allowed = self.error_bound + self.floor
        if self.error_known and self.error <= allowed:
            return "kept" if self.uncertainty <= MAX_UNCERTAINTY_FRACTION * allowed else "undecided"
        if self.flagged:
            return "flagged"
        return "not kept" if self.error_known and self.error > allowed + self.uncertainty else "undecided"


@attrs.frozen(kw_only=True)
class Sample:
    """Errors of one frame by the certificate and by an independent integrator, from the same state [m]."""

    frame: int
    stated: float
    """Error of the frame by this certificate, from the simulation's state at its beginning [m]."""
    independent: float
    """Error of the frame by the independent integrator [m]."""
    difference: float
    """Maximum distance of a particle between the two solutions [m]."""
    tolerance: float | None

    @property
    def agrees(self) -> bool:
        """True if reference and independent integrator differ by at most 20 % of the error or 10 % of the tolerance."""
        allowed = max(0.2 * self.independent, MAX_UNCERTAINTY_FRACTION * (self.tolerance or DEFAULT_TOLERANCE))
        return self.difference <= allowed


@attrs.frozen(kw_only=True)
class UnsolvedSample:
    """Frame that the independent integrator could not solve."""

    frame: int
    reason: str


@attrs.define(kw_only=True)
class Certificate:
    """True error of a recorded session, by frame and by window."""

    name: str
    windows: list[AccuracyWindow] = attrs.field(factory=list)
    frames: list[FrameAccuracy] = attrs.field(factory=list)
    samples: list[Sample] = attrs.field(factory=list)
    unsolved_samples: list[UnsolvedSample] = attrs.field(factory=list)
    """Frames that the independent integrator could not solve: they are undecided."""
    horizon: float | None = None
    """Time since the beginning or a reset up to which positions are predictable [s]; None if the session is shorter."""
    longest: float = 0.0
    """Longest such time that was measured [s]."""
    altered: int = 0
    """Number of frames whose recorded positions do not follow from their record."""
    seconds: float = 0.0
    """Wall time of the measurement [s]."""

    def windows_with(self, *verdicts: WindowVerdict) -> list[AccuracyWindow]:
        """Return the windows with one of the given verdicts."""
        return [window for window in self.windows if window.verdict in verdicts]

    @property
    def is_satisfied(self) -> bool:
        """True if every unflagged window with an error bound satisfies it, and the independent integrator agrees."""
        is_confirmed = not self.unsolved_samples and all(sample.agrees for sample in self.samples)
        return is_confirmed and not self.windows_with("not kept", "undecided")
