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

from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.session.frame_record import FrameRecord
from cloth_sim_ros.simulation.simulation import Frame, Simulation
from cloth_sim_ros.verify.certificate import (
    DEFAULT_TOLERANCE,
    MAX_AMPLIFICATION,
    MAX_UNCERTAINTY_FRACTION,
    AccuracyWindow,
    Certificate,
    FrameAccuracy,
    Sample,
    UnsolvedSample,
)
from cloth_sim_ros.verify.independent_integrator import frame_by_dop853
from cloth_sim_ros.verify.reference_integrator import max_distance
from cloth_sim_ros.verify.reference_motion import Equations, FrameCapture, SimulatedFrame, starting_state
from cloth_sim_ros.verify.reference_solution import (
    ReferenceResult,
    ReferenceSolution,
    later_amplification,
    reference_positions,
)
from cloth_sim_ros.verify.run import Verdict, verify

#: Length of a window [s].
WINDOW = 1.0
#: Relative rounding of a recorded float32 position.
_FLOAT32 = 2.0**-24


def certify(
    paths: Sequence[Path],
    *,
    on_frame: Callable[[], object] = lambda: None,
    particles: BinaryIO | None = None,
    every_sample: bool = False,
) -> tuple[Verdict, Certificate]:
    """Run a session again, measure its error against a reference; return (verdict, certificate). Raises SessionError.

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
    certifier = _Certifier(on_frame, particles, every_sample)
    verdict = verify(paths, observer=certifier)
    certifier.end()
    certificate = certifier.certificate
    certificate.name, certificate.seconds = verdict.name, certifier.seconds
    verdict.seconds -= certifier.seconds
    return verdict, certificate


class _Certifier:
    """Observer of a re-run that measures the true error of each frame and each window for a certificate."""

    def __init__(self, on_frame: Callable[[], object], particles: BinaryIO | None, every_sample: bool) -> None:
        self.certificate, self.seconds = Certificate(name=""), 0.0
        self._on_frame, self._particles, self._every_sample = on_frame, particles, every_sample
        self._capture, self._equations = FrameCapture(), Equations()
        self._frame: SimulatedFrame | None = None
        self._is_reproduced = False
        self._recorded: NDArray[np.floating] | None = None
        self._is_altered = False
        self._last_index = -1
        self._window: AccuracyWindow | None = None
        self._window_reference: ReferenceSolution | None = None
        #: Frames of the current window.
        self._frames: list[SimulatedFrame] = []
        self._session_reference: ReferenceSolution | None = None
        self._session_start = 0.0
        self._amplification = 0.0
        #: Distance of the last frame's recorded positions from those of the re-run; its value at the start of the
        #: window [m].
        self._deviation = self._start_deviation = 0.0

    def on_frame(
        self, simulation: Simulation, scene_before: Scene, before: State, frame: Frame, record: FrameRecord
    ) -> None:
        """Store a frame of the re-run, to be assessed by `on_frame_end`."""
        self._frame = self._capture.capture(simulation, scene_before, before, frame)
        self._is_reproduced = record.digest == simulation.state.digest()
        self._recorded, self._is_altered = None, False

    def on_cloud(self, recorded: NDArray[np.floating], is_same: bool) -> None:
        """Store the frame's recorded positions (n, 3) [m]; `is_same`: they equal those of the re-run."""
        self._recorded = recorded
        self._is_altered = not is_same and self._is_reproduced

    def on_frame_end(self) -> None:
        """Assess the frame that `on_frame` stored, if any, against the reference, after all its messages."""
        frame, self._frame = self._frame, None
        self.certificate.altered += self._is_altered
        if frame is not None:
            start_time = time.perf_counter()
            self._assess(frame)
            self.seconds += time.perf_counter() - start_time
            self._deviation = 0.0 if self._is_reproduced else _max_error(self._recorded_positions(), frame.after.x)
            self._on_frame()
        self._is_altered = False

    def end(self) -> None:
        """Assess the last window, at the end of the session."""
        start_time = time.perf_counter()
        self._end_window()
        self.seconds += time.perf_counter() - start_time

    def _end_window(self) -> None:
        """End a window; measure the amplification of later perturbations if earlier ones don't explain its error.

        The error bound includes the later ones.
        """
        window, self._window = self._window, None
        if window is not None and window.verdict == "not kept" and not window.violating_frames:
            window.later_amplification = later_amplification(self._equations, self._frames)

    def _assess(self, frame: SimulatedFrame) -> None:
        start = starting_state(frame)
        if frame.reset or frame.before.frame != self._last_index:
            self._end_window()
            self._session_reference, self._session_start = ReferenceSolution(start, seed=frame.index), frame.t
        self._last_index = frame.index
        # A frame reproduced to the last bit began with the recorded state.
        deviation = 0.0 if frame.reset or self._is_reproduced else self._deviation
        if self._window is None:
            self._window = AccuracyWindow(index=len(self.certificate.windows), start=frame.t)
            self.certificate.windows.append(self._window)
            self._window_reference = ReferenceSolution(start, seed=frame.index)
            self._amplification, self._frames = 0.0, []
            self._start_deviation = deviation
        window = self._window
        self._frames.append(frame)
        assert self._window_reference is not None
        exact = self._is_reproduced and not self._is_altered
        # The recorded positions: those of the re-run if the states are equal, otherwise those in the file.
        recorded = frame.after.x if exact else self._recorded_positions()
        frame_reference = reference_positions(self._equations, frame, start)
        reference = self._window_reference.advance(self._equations, frame)
        self._amplification = max(self._amplification, reference.amplification)
        session_reference = self._advance_session(frame)
        floor = reference.rounding_floor + (0.0 if exact else self._rounding() * float(np.abs(reference.x).max()))
        error_of_frame = _max_error(recorded, frame_reference)
        accuracy = FrameAccuracy(
            frame=frame.index,
            time=frame.t + frame.duration,
            window=window.index,
            tolerance=frame.tolerance,
            flagged=frame.flagged,
            exact=exact,
            error_of_frame=error_of_frame,
            error_bound_of_frame=self._frame_error_bound(frame, start, error_of_frame),
            error=_max_error(recorded, reference.x),
            amplification=self._amplification,
            # If the re-run deviates from the recording, this deviation adds to the uncertainty.
            uncertainty=reference.uncertainty + self._start_deviation * max(1.0, self._amplification) + deviation,
            floor=floor,
            session_error=math.nan if session_reference is None else _max_error(recorded, session_reference.x),
            session_amplification=math.nan if session_reference is None else session_reference.amplification,
            session_uncertainty=math.nan if session_reference is None else session_reference.uncertainty,
        )
        self.certificate.frames.append(accuracy)
        window.add(accuracy)
        self._write(recorded, reference.x)
        if self._every_sample or (window.frames == 1 + window.index % 7 and is_sampled(window.index)):
            self._sample(frame, start, frame_reference, accuracy)
        if frame.t + 1.5 * frame.duration > window.start + WINDOW:
            self._end_window()

    def _recorded_positions(self) -> Array | None:
        """Return the last frame's recorded positions, shape (3, n) [m]; None without a cloud."""
        return None if self._recorded is None else self._recorded.T.astype(np.float64)

    def _rounding(self) -> float:
        """Return the unit roundoff of the last frame's recorded positions, of single or double precision."""
        return 2.0**-53 if self._recorded is not None and self._recorded.dtype.itemsize == 8 else _FLOAT32

    def _advance_session(self, frame: SimulatedFrame) -> ReferenceResult | None:
        """Advance the reference solution that began with the session; return None from the horizon on."""
        if self._session_reference is None:
            return None
        reference, certificate = self._session_reference.advance(self._equations, frame), self.certificate
        time = frame.t - self._session_start
        max_uncertainty = MAX_UNCERTAINTY_FRACTION * (frame.tolerance or DEFAULT_TOLERANCE)
        if reference.amplification <= MAX_AMPLIFICATION and reference.uncertainty <= max_uncertainty:
            certificate.longest = max(certificate.longest, time + frame.duration)
            return reference
        self._session_reference = None
        certificate.horizon = time if certificate.horizon is None else min(certificate.horizon, time)
        return None

    def _frame_error_bound(self, frame: SimulatedFrame, start: State, error: float) -> float:
        """Return the error bound of a single frame [m]; nan without a tolerance."""
        if frame.tolerance is None:
            return math.nan
        if not error > frame.tolerance:
            return frame.tolerance
        reference = ReferenceSolution(start, seed=frame.index).advance(self._equations, frame)
        return frame.tolerance * max(1.0, reference.amplification)

    def _sample(self, frame: SimulatedFrame, start: State, reference: Array, accuracy: FrameAccuracy) -> None:
        try:
            independent = frame_by_dop853(self._equations, frame, start)
        except ArithmeticError as error:
            self.certificate.unsolved_samples.append(UnsolvedSample(frame=frame.index, reason=str(error)))
            return
        errors = {
            "stated": max_distance(frame.after.x, reference),
            "independent": max_distance(frame.after.x, independent),
            "difference": max_distance(reference, independent),
        }
        self.certificate.samples.append(Sample(frame=frame.index, **errors, tolerance=accuracy.tolerance))

    def _write(self, recorded: Array | None, reference: Array) -> None:
        if self._particles is not None:
            errors = np.full(reference.shape[1], np.nan)
            if recorded is not None:
                errors = np.sqrt(np.square(recorded - reference).sum(0))
            self._particles.write(errors.astype("<f4").tobytes())


def _max_error(recorded: Array | None, reference: Array) -> float:
    if recorded is None or recorded.shape != reference.shape:
        return math.nan
    return max_distance(recorded, reference)


def is_sampled(window: int) -> bool:
    """Return True if the independent integrator checks a window (index): the first eight, then ever fewer."""
    return window % max(1, 1 << max(0, window.bit_length() - 3)) == 0
