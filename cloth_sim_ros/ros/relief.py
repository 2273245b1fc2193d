# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Tolerance governor.

It relaxes the tolerance while frames overrun and accuracy limits the step, at most tenfold and to at most 1 cm. Only
here does a measured time influence the computation. Therefore each change is an event and is recorded.
"""

from __future__ import annotations

import statistics

from cloth_sim_ros.physics.constants import CONSTANTS
from cloth_sim_ros.physics.integrators.base import Advance
from cloth_sim_ros.physics.integrators.fixed import steps_for
from cloth_sim_ros.ros.log import ThrottledLog
from cloth_sim_ros.scene import relaxation
from cloth_sim_ros.simulation.events import Relax
from cloth_sim_ros.simulation.simulation import Frame, Simulation

#: Smallest length of a window: time [s], and frames.
WINDOW, FEWEST = 0.5, 5
#: Bounds of the load, the median frame time over the period. Above the first the machine is too slow. Below the second
#: it has reserves, enough for half the tolerance (1.4 times the steps at order 2).
BUSY, ROOMY = 0.9, 0.5
#: Factor of one relaxation, and of one tightening.
STEP = 2.0
#: Number of windows at low load before the tolerance is tightened, and its bound; doubled after a premature tightening.
PATIENCE, MOST_PATIENCE = 4, 64
#: Ratio to the number of steps for stability above which accuracy limits the step.
_MORE = 1.1


class Relief:
    """Measures frame times, and relaxes or tightens the tolerance.

    Args:
        simulation: the cloth; the governor is active if its parameter `overload` is `relax`.
        log: receives every change.
        live: true if frames are due by wall time; with /clock there is no deadline.
    """

    def __init__(self, simulation: Simulation, log: ThrottledLog, *, live: bool = True) -> None:
        self._simulation = simulation
        self._log = log
        self.live = live
        self._taken: list[float] = []
        self._elapsed = 0.0
        self._roomy = 0
        self._patience = PATIENCE
        self._tightened = False
        self._wanted: float | None = None
        self._why = ""

    @property
    def _active(self) -> bool:
        return self.live and self._simulation.scene.overload == "relax"

    def events(self) -> list[Relax]:
        """Return the events at the start of the next frame."""
        factor = relaxation.factor_of(self._simulation.state)
        if not self._active and factor != 1.0:
            self._begin_window()
            self._why = ""
            return [Relax(1.0)]
        wanted, self._wanted = self._wanted, None
        return [] if wanted is None or wanted == factor else [Relax(wanted)]

    def add(self, frame: Frame, seconds: float) -> None:
        """Add a frame with its wall time [s]."""
        if not self._active or not frame.moved or frame.advance is None:
            return
        period = self._simulation.scene.period
        self._taken.append(seconds)
        self._elapsed += max(seconds, period)
        if len(self._taken) < FEWEST or self._elapsed < WINDOW:
            return
        load = statistics.median(self._taken) / period
        self._begin_window()
        self._judge(load, frame.advance)

    def describe(self) -> dict[str, str]:
        """Return the set tolerance, the one in force, and the reason, for diagnostics."""
        scene = self._simulation.scene
        held = bool(scene.tolerance) and not scene.step
        factor = relaxation.factor_of(self._simulation.state)
        in_force = relaxation.relaxed(scene.tolerance, factor)
        why = self._why or ("as it was set" if factor == 1.0 else "relaxed: the machine was too slow")
        return {
            "tolerance_m": f"{scene.tolerance:g}" if held else "none",
            "tolerance_in_force_m": f"{in_force:g}" if held else "none",
            "tolerance_why": why if held else "a fixed step holds none" if scene.step else "none is set",
        }

    def _begin_window(self) -> None:
        self._taken, self._elapsed = [], 0.0

    def _judge(self, load: float, advance: Advance) -> None:
        factor = relaxation.factor_of(self._simulation.state)
        took = f"frames take {100.0 * load:.0f} % of their period"
        if load > BUSY:
            self._relieve(factor, took, advance)
            return
        self._why = ""
        self._roomy = self._roomy + 1 if load < ROOMY else 0
        if self._roomy >= self._patience and factor > 1.0:
            self._change(max(1.0, factor / STEP), took)
            self._tightened = True

    def _relieve(self, factor: float, took: str, advance: Advance) -> None:
        self._roomy = 0
        scene = self._simulation.scene
        if not scene.tolerance or scene.step:
            return
        more = min(STEP * factor, relaxation.MOST_FACTOR)
        if relaxation.relaxed(scene.tolerance, more) == relaxation.relaxed(scene.tolerance, factor):
            self._say(f"{took}, and the tolerance is at its limit: frames come late")
        elif not accuracy_binds(advance, scene.period):
            self._say(f"{took}, but stability limits the step: a larger tolerance would not help, frames come late")
        else:
            if self._tightened:
                self._patience = min(2 * self._patience, MOST_PATIENCE)
            self._change(more, took)

    def _change(self, factor: float, took: str) -> None:
        self._roomy, self._tightened = 0, False
        self._wanted = factor
        scene = self._simulation.scene
        if factor == 1.0:
            self._log.info("relief", f"the tolerance is {scene.tolerance:g} m again, as it was set: {took}")
            return
        in_force = relaxation.relaxed(scene.tolerance, factor)
        self._why = f"relaxed from {scene.tolerance:g} m: {took}"
        self._log.warn("relief", f"the tolerance is {in_force:g} m instead of {scene.tolerance:g} m: {took}")

    def _say(self, reason: str) -> None:
        if reason.split(",", 1)[1:] != self._why.split(",", 1)[1:]:
            self._log.warn("relief", reason)
        self._why = reason


def accuracy_binds(advance: Advance, duration: float) -> bool:
    """Return true if a frame took more steps than stability, or one step a frame, requires.

    Args:
        advance: the steps of the frame.
        duration: simulated time of the frame [s].
    """
    longest = min(CONSTANTS.safety * advance.limit, duration)
    return advance.steps > _MORE * steps_for(duration, longest)
