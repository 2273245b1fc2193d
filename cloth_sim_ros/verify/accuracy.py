# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Certificate of a session's accuracy, from its re-run and a reference solution."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.session.frame_record import FrameRecord
from cloth_sim_ros.simulation.simulation import Frame, Simulation
from cloth_sim_ros.verify.certificate import (
    MOST_GROWTH,
    MOST_OWN,
    WITHOUT_TOLERANCE,
    Certificate,
    FrameAccuracy,
    Sample,
    Window,
)
from cloth_sim_ros.verify.fine import distance
from cloth_sim_ros.verify.independent import frame_by_dop853
from cloth_sim_ros.verify.motion import Equations, FrameWatch, RunFrame, starting_state
from cloth_sim_ros.verify.run import Verdict, verify
from cloth_sim_ros.verify.truth import Told, Truth, frame_truth, later_growth

#: Length of a window [s].
WINDOW = 1.0
#: Relative rounding of a recorded float32 position.
_FLOAT32 = 2.0**-24


def certify(
    paths: Sequence[Path],
    *,
    judged: Callable[[], object] = lambda: None,
    particles: BinaryIO | None = None,
    every_sample: bool = False,
) -> tuple[Verdict, Certificate]:
    """Run a session again and measure its accuracy.

    Args:
        paths: the files of one session, in order.
        on_frame: called after each frame.
        particles: output of each particle's error [m], float32, frame after frame, as in `Certificate.frames`; nan if
            unknown.
        every_sample: True to run the independent integrator on every frame instead of a thinning sample of windows.

    Returns:
        Verdict of the re-run, and the certificate.

    Raises:
        SessionError: if a file cannot be read, or its scene and state make no simulation.
    """
    watch = _Accuracy(judged, particles, every_sample)
    verdict = verify(paths, watch=watch)
    watch.end()
    certificate = watch.certificate
    certificate.name, certificate.seconds = verdict.name, watch.seconds
    verdict.seconds -= watch.seconds
    return verdict, certificate


class _Accuracy:
    """Measures the frames of a re-run; a `RunObserver`."""

    def __init__(self, judged: Callable[[], object], particles: BinaryIO | None, every_sample: bool) -> None:
        self.certificate, self.seconds = Certificate(name=""), 0.0
        self._judged, self._particles, self._every_sample = judged, particles, every_sample
        self._watch, self._equations = FrameWatch(), Equations()
        self._frame: RunFrame | None = None
        self._again = False
        self._recorded: NDArray[np.floating] | None = None
        self._altered = False
        self._last = -1
        self._window: Window | None = None
        self._of_window: Truth | None = None
        #: Frames of the current window.
        self._frames: list[RunFrame] = []
        self._of_session: Truth | None = None
        self._session_start = 0.0
        self._growth = 0.0
        #: Distance of the last frame's recorded positions from those of the re-run; its value at the start of the
        #: window [m].
        self._off = self._off_at_start = 0.0

    def frame(self, simulation: Simulation, was: Scene, before: State, frame: Frame, record: FrameRecord) -> None:
        """Store a frame of the re-run."""
        self._frame = self._watch.after(simulation, was, before, frame)
        self._again = record.digest == simulation.state.digest()
        self._recorded, self._altered = None, False

    def cloud(self, recorded: NDArray[np.floating], same: bool) -> None:
        """Store the frame's recorded positions (n, 3) [m]; `is_same`: they equal those of the re-run."""
        self._recorded = recorded
        self._altered = not same and self._again

    def close(self) -> None:
        """Assess the frame, after all its messages."""
        frame, self._frame = self._frame, None
        self.certificate.altered += self._altered
        if frame is not None:
            begun = time.perf_counter()
            self._judge(frame)
            self.seconds += time.perf_counter() - begun
            self._off = 0.0 if self._again else _away(self._in_file(), frame.after.x)
            self._judged()
        self._altered = False

    def end(self) -> None:
        """Assess the last window."""
        begun = time.perf_counter()
        self._end_window()
        self.seconds += time.perf_counter() - begun

    def _end_window(self) -> None:
        """Measure the amplification of later perturbations if those at its beginning do not explain the window's error.

        The error bound includes the later ones.
        """
        window, self._window = self._window, None
        if window is not None and window.verdict == "not kept" and not window.standing_out:
            window.later = later_growth(self._equations, self._frames)

    def _judge(self, frame: RunFrame) -> None:
        start = starting_state(frame)
        if frame.reset or frame.before.frame != self._last:
            self._end_window()
            self._begin_session(frame, start)
        self._last = frame.index
        # A frame reproduced to the last bit began with the recorded state.
        off = 0.0 if frame.reset or self._again else self._off
        if self._window is None:
            self._window = Window(number=len(self.certificate.windows), start=frame.t)
            self.certificate.windows.append(self._window)
            self._of_window, self._growth, self._frames = Truth(start, seed=frame.index), 0.0, []
            self._off_at_start = off
        window = self._window
        self._frames.append(frame)
        assert self._of_window is not None
        exact = self._again and not self._altered
        # The recorded positions: those of the re-run if the states are equal, otherwise those in the file.
        recorded = frame.after.x if exact else self._in_file()
        true = frame_truth(self._equations, frame, start)
        told = self._of_window.frame(self._equations, frame)
        self._growth = max(self._growth, told.growth)
        session = self._go_on(frame)
        floor = told.floor + (0.0 if exact else self._rounding() * float(np.abs(told.x).max()))
        error_of_frame = _away(recorded, true)
        found = FrameAccuracy(
            frame=frame.index,
            time=frame.t + frame.duration,
            window=window.number,
            tolerance=frame.tolerance,
            flagged=frame.flagged,
            exact=exact,
            error_of_frame=error_of_frame,
            promise_of_frame=self._promise_of(frame, start, error_of_frame),
            error=_away(recorded, told.x),
            growth=self._growth,
            # If the re-run deviates from the recording, this deviation adds to the uncertainty.
            own=told.own + self._off_at_start * max(1.0, self._growth) + off,
            floor=floor,
            session_error=math.nan if session is None else _away(recorded, session.x),
            session_growth=math.nan if session is None else session.growth,
            session_own=math.nan if session is None else session.own,
        )
        self.certificate.frames.append(found)
        window.add(found)
        self._write(recorded, told.x)
        if self._every_sample or (window.frames == 1 + window.number % 7 and _is_sampled(window.number)):
            self._sample(frame, start, true, found)
        if frame.t + 1.5 * frame.duration > window.start + WINDOW:
            self._end_window()

    def _in_file(self) -> Array | None:
        """Return the recorded positions, shape (3, n) [m]; None without a cloud."""
        return None if self._recorded is None else self._recorded.T.astype(np.float64)

    def _rounding(self) -> float:
        """Return the relative rounding of the recorded positions."""
        return 2.0**-53 if self._recorded is not None and self._recorded.dtype.itemsize == 8 else _FLOAT32

    def _begin_session(self, frame: RunFrame, start: State) -> None:
        self._of_session, self._session_start = Truth(start, seed=frame.index), frame.t

    def _go_on(self, frame: RunFrame) -> Told | None:
        """Advance the reference from the session's beginning; None beyond the horizon."""
        if self._of_session is None:
            return None
        told, certificate = self._of_session.frame(self._equations, frame), self.certificate
        time = frame.t - self._session_start
        if told.growth <= MOST_GROWTH and told.own <= MOST_OWN * (frame.tolerance or WITHOUT_TOLERANCE):
            certificate.longest = max(certificate.longest, time + frame.duration)
            return told
        self._of_session = None
        certificate.horizon = time if certificate.horizon is None else min(certificate.horizon, time)
        return None

    def _promise_of(self, frame: RunFrame, start: State, error: float) -> float:
        """Return the error bound of a single frame [m]; nan without a tolerance."""
        if frame.tolerance is None:
            return math.nan
        if not error > frame.tolerance:
            return frame.tolerance
        return frame.tolerance * max(1.0, Truth(start, seed=frame.index).frame(self._equations, frame).growth)

    def _sample(self, frame: RunFrame, start: State, true: Array, found: FrameAccuracy) -> None:
        other = frame_by_dop853(self._equations, frame, start)
        self.certificate.samples.append(
            Sample(
                frame=frame.index,
                stated=distance(frame.after.x, true),
                independent=distance(frame.after.x, other),
                difference=distance(true, other),
                tolerance=found.tolerance,
            )
        )

    def _write(self, recorded: Array | None, true: Array) -> None:
        if self._particles is not None:
            away = np.full(true.shape[1], np.nan) if recorded is None else np.sqrt(np.square(recorded - true).sum(0))
            self._particles.write(away.astype("<f4").tobytes())


def _away(recorded: Array | None, true: Array) -> float:
    if recorded is None or recorded.shape != true.shape:
        return math.nan
    return distance(recorded, true)


def _is_sampled(window: int) -> bool:
    """Return True for the first eight windows, then every second, fourth, ...: the cost grows logarithmically."""
    return window % max(1, 1 << max(0, window.bit_length() - 3)) == 0
