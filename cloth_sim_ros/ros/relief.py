# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What gives way where the machine is too slow: the tolerance, within bounds, where it is what makes frames dear.

Here alone a measured time decides over what is computed, and so the decision is an event, recorded as any other.
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

#: A judgement is over at least so much time [s], and so many frames.
WINDOW, FEWEST = 0.5, 5
#: Share of the period that the middle one of a window's frames takes: above the first the machine is too slow, below
#: the second there is room, also for what half the tolerance costs (1.4 times the steps at order 2).
BUSY, ROOMY = 0.9, 0.5
#: Factor of one relaxation, and of tightening.
STEP = 2.0
#: Windows with room before the tolerance is tightened. Twice as many whenever that turned out to be too early.
PATIENCE, MOST_PATIENCE = 4, 64
#: With so many times the steps that stability asks for it is the tolerance that they are taken for.
_MORE = 1.1


class Relief:
    """Follows the time that frames take, and relaxes the tolerance or tightens it again.

    Args:
        simulation: the cloth; its scene's `overload` says whether anything is to be done.
        log: told of every change.
        live: whether frames are due by wall time; where they follow /clock there is no real time to be held.
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
        """Return what the next frame begins with."""
        factor = relaxation.factor_of(self._simulation.state)
        if not self._active and factor != 1.0:
            self._begin_window()
            self._why = ""
            return [Relax(1.0)]
        wanted, self._wanted = self._wanted, None
        return [] if wanted is None or wanted == factor else [Relax(wanted)]

    def add(self, frame: Frame, seconds: float) -> None:
        """Take note of a frame that took some wall time [s]."""
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
        """Return the tolerance that was set, that in force, and why, for diagnostics."""
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
        took = f"frames take {100.0 * load:.0f} % of their time"
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
            self._say(f"{took}, and the tolerance is relaxed as far as may be: frames come late")
        elif not accuracy_binds(advance, scene.period):
            self._say(f"{took}, but stability sets the steps: a larger tolerance would buy nothing, frames come late")
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
    """Whether a frame of some length [s] took more steps than stability, or one step a frame, asks for."""
    longest = min(CONSTANTS.safety * advance.limit, duration)
    return advance.steps > _MORE * steps_for(duration, longest)
