# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Tolerance governor.

It relaxes the tolerance while frames overrun and accuracy limits the step, at most tenfold and to at most 1 cm. Only
here does a measured time influence the computation. Therefore each change is an event and is recorded.
"""

from __future__ import annotations

import statistics

from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.integrators.base import Advance
from cloth_sim_ros.physics.integrators.limit import steps_for
from cloth_sim_ros.ros.reporting.log import ThrottledLog
from cloth_sim_ros.scene import relaxation
from cloth_sim_ros.simulation.events import Relax
from cloth_sim_ros.simulation.simulation import Frame, Simulation

#: Smallest length of a window: time [s], and frames.
WINDOW, MIN_FRAMES = 0.5, 5
#: Bounds of the load, the median frame time over the period. Above the first the machine is too slow. Below the second
#: it has reserves, enough for half the tolerance (1.4 times the steps at order 2).
HIGH_LOAD, LOW_LOAD = 0.9, 0.5
#: Factor of one relaxation, and of one tightening.
RELAXATION_STEP = 2.0
#: Number of windows at low load before the tolerance is tightened, and its bound; doubled after a premature tightening.
MIN_PATIENCE, MAX_PATIENCE = 4, 64
#: Ratio to the number of steps for stability above which accuracy limits the step.
_MIN_STEP_RATIO = 1.1


class ToleranceGovernor:
    """Governor that relaxes the tolerance while frames overrun and accuracy limits the step, and restores it later.

    Args:
        simulation: the cloth; the governor is active if its parameter `overload` is `relax`.
        log: receives every change.
        live: true if frames are due by wall time; with /clock there is no deadline.
    """

    def __init__(self, simulation: Simulation, log: ThrottledLog, *, live: bool = True) -> None:
        self._simulation, self._log, self.live = simulation, log, live
        self._frame_times: list[float] = []
        self._elapsed = 0.0
        self._low_load_windows = 0
        self._patience = MIN_PATIENCE
        self._has_tightened = False
        self._requested_factor: float | None = None
        self._reason = ""

    @property
    def _is_active(self) -> bool:
        return self.live and self._simulation.scene.overload == "relax"

    def events(self) -> list[Relax]:
        """Return the event that changes the tolerance from the next frame on, once if a change is due; else []."""
        factor = relaxation.factor_of(self._simulation.state)
        if not self._is_active and factor != 1.0:
            self._begin_window()
            self._reason = ""
            return [Relax(1.0)]
        requested, self._requested_factor = self._requested_factor, None
        return [] if requested is None or requested == factor else [Relax(requested)]

    def add(self, frame: Frame, seconds: float) -> None:
        """Add a frame's wall time [s]; at the end of a window of at least 0.5 s, decide on a change of tolerance."""
        if not self._is_active or not frame.moved or frame.advance is None:
            return
        period = self._simulation.scene.period
        self._frame_times.append(seconds)
        self._elapsed += max(seconds, period)
        if len(self._frame_times) < MIN_FRAMES or self._elapsed < WINDOW:
            return
        load = statistics.median(self._frame_times) / period
        self._begin_window()
        self._evaluate(load, frame.advance)

    def describe(self) -> dict[str, str]:
        """Return diagnostics entries: the tolerance that was set, the one in force [m], and the reason."""
        scene = self._simulation.scene
        has_tolerance = bool(scene.tolerance) and not scene.step
        factor = relaxation.factor_of(self._simulation.state)
        in_force = relaxation.relaxed_tolerance(scene.tolerance, factor)
        reason = self._reason or ("as it was set" if factor == 1.0 else "relaxed: the machine was too slow")
        return {
            "tolerance_m": f"{scene.tolerance:g}" if has_tolerance else "none",
            "tolerance_effective_m": f"{in_force:g}" if has_tolerance else "none",
            "tolerance_reason": reason if has_tolerance else "a fixed step holds none" if scene.step else "none is set",
        }

    def _begin_window(self) -> None:
        self._frame_times, self._elapsed = [], 0.0

    def _evaluate(self, load: float, advance: Advance) -> None:
        factor = relaxation.factor_of(self._simulation.state)
        load_text = f"frames take {100.0 * load:.0f} % of their period"
        if load > HIGH_LOAD:
            self._relax(factor, load_text, advance)
            return
        self._reason = ""
        self._low_load_windows = self._low_load_windows + 1 if load < LOW_LOAD else 0
        if self._low_load_windows >= self._patience and factor > 1.0:
            self._change(max(1.0, factor / RELAXATION_STEP), load_text)
            self._has_tightened = True

    def _relax(self, factor: float, load_text: str, advance: Advance) -> None:
        self._low_load_windows = 0
        scene = self._simulation.scene
        if not scene.tolerance or scene.step:
            return
        new_factor = min(RELAXATION_STEP * factor, relaxation.MAX_FACTOR)
        if relaxation.relaxed_tolerance(scene.tolerance, new_factor) == relaxation.relaxed_tolerance(
            scene.tolerance, factor
        ):
            self._report(f"{load_text}, and the tolerance is at its limit: frames come late")
        elif not is_accuracy_limited(advance, scene.period):
            self._report(
                f"{load_text}, but stability limits the step: a larger tolerance would not help, frames come late"
            )
        else:
            if self._has_tightened:
                self._patience = min(2 * self._patience, MAX_PATIENCE)
            self._change(new_factor, load_text)

    def _change(self, factor: float, load_text: str) -> None:
        self._low_load_windows, self._has_tightened = 0, False
        self._requested_factor = factor
        scene = self._simulation.scene
        if factor == 1.0:
            self._log.info("relief", f"the tolerance is {scene.tolerance:g} m again, as it was set: {load_text}")
            return
        in_force = relaxation.relaxed_tolerance(scene.tolerance, factor)
        self._reason = f"relaxed from {scene.tolerance:g} m: {load_text}"
        self._log.warn("relief", f"the tolerance is {in_force:g} m instead of {scene.tolerance:g} m: {load_text}")

    def _report(self, reason: str) -> None:
        if reason.split(",", 1)[1:] != self._reason.split(",", 1)[1:]:
            self._log.warn("relief", reason)
        self._reason = reason


def is_accuracy_limited(advance: Advance, duration: float) -> bool:
    """Return true if accuracy rather than stability set the step: a frame took more steps than stability needs.

    Args:
        advance: the steps of the frame.
        duration: simulated time of the frame [s].
    """
    longest = min(CONSTANTS.stability_safety * advance.limit, duration)
    return advance.steps > _MIN_STEP_RATIO * max(2, steps_for(duration, longest))
