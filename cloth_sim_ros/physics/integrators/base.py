# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Interface of integrators, result of an advance, and errors of integration."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import NamedTuple

from cloth_sim_ros.physics.accounting.work_accumulator import WorkAccumulator
from cloth_sim_ros.physics.old_names import with_old_names
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.state.state import State


class UnstableError(RuntimeError):
    """Error: the motion became non-finite, or no step was small enough for it."""

    #: Force evaluations of the failed attempt, if known.
    evaluations = 0


class ToleranceMissedError(UnstableError):
    """Error: the tolerance can't be held, and the caller rejects a result that misses it."""


#: Factors that may limit the step: `accuracy` (the tolerance), `stability` (the step limit), `frame` (one step covers
#: the frame), `step` (the user's fixed step), `work` (the work limit of a frame), `rest` (the sheet sleeps: no step).
LIMITING_FACTORS = ("accuracy", "stability", "frame", "step", "work", "rest")
#: Default tolerance of positions [m]; see the scene's `tolerance`.
TOLERANCE = 1e-3


@with_old_names(binds="limited_by")
class Advance(NamedTuple):
    """Report of one advance: steps, force evaluations, error estimate and limiting factor."""

    #: Total steps of the runs that make up the result.
    steps: int
    #: Force evaluations, those of rejected steps included.
    evaluations: int
    #: Smallest step taken [s].
    step: float
    #: Largest step that is stable by the bounds at the start [s]; infinite for a method that is stable at any step.
    limit: float
    #: Rejected attempts: the motion stiffened during the attempt, or the error was too large.
    rejected: int = 0
    #: Name of the integrator that ran.
    integrator: str = ""
    #: Factor that limited the step, one of `LIMITING_FACTORS`.
    limited_by: str = ""
    #: Estimated largest position error of a particle over the advance [m]; None without a tolerance.
    error: float | None = None
    #: Above 0 if the frame is flagged: its error exceeds its budget, or steps of it have no accurate solution.
    flagged: int = 0
    #: The choice of integrator and step, in words.
    reason: str = ""


class Integrator(ABC):
    """Base class of integration methods: advances a state by a duration, in as many steps as necessary.

    The last step ends exactly at the end of the duration.
    """

    name: str
    #: Order of the error in the step, damping and nonlinearity included.
    order: int
    #: Intended use in one line: damping and stiffness.
    suits: str = ""

    @abstractmethod
    def step_limit(self, omega2: float, damping_rate: float) -> float:
        """Return the largest stable step [s] for a squared frequency [1/s^2] and a damping rate c/m [1/s]."""

    @abstractmethod
    def advance(
        self, plan: Plan, state: State, t: float, duration: float, accumulator: WorkAccumulator | None = None
    ) -> Advance:
        """Advance ``state``, in place, from time t [s] by duration [s]; return a report.

        The arrays of positions and velocities are replaced, not overwritten, so references to the old ones stay valid.
        Controllers keep their state between calls in ``state.memory``.

        Args:
            plan: equations of motion.
            state: advanced in place.
            t: time at the start [s].
            duration: time to advance [s].
            accumulator: accumulates work and wrenches of the motion; None for none.

        Raises:
            UnstableError: if the motion does not stay finite.
        """


def check_settings(
    step: float | None, tolerance: float | None = None, work: float = 0.0
) -> tuple[float | None, float | None, float]:
    """Return fixed step [s], tolerance [m] and work limit (multiple of real time) unchanged, or raise ValueError.

    Raises:
        ValueError: if one is out of range, or step and tolerance are both set.
    """
    if tolerance is not None and step is not None:
        raise ValueError(
            f"step {step} s and tolerance {tolerance} m are both set: a fixed step holds no tolerance; set one"
        )
    if step is not None and not (math.isfinite(step) and step > 0.0):
        raise ValueError(f"step is {step} s; it must be finite and above 0")
    if tolerance is not None and not (math.isfinite(tolerance) and tolerance > 0.0):
        raise ValueError(f"tolerance is {tolerance} m; it must be finite and above 0")
    if not (math.isfinite(work) and work >= 0.0):
        raise ValueError(f"work limit is {work}; it must be finite and at least 0 (0: no limit)")
    return step, tolerance, work


class StepLimitError(UnstableError, ValueError):
    """Error: a fixed step is above the stability limit, at the start, or because the motion stiffened."""


class NoRoomError(UnstableError, ValueError):
    """Error: the cloth intersects itself or an obstacle, at the start or because moving bodies squeezed it."""


def refuse_unbounded(omega2: float, damping: float) -> None:
    """Raise UnstableError if the spectral bounds are so large that no step is stable.

    Args:
        omega2: bound of the squared frequency [1/s^2].
        damping: bound of the damping rate [1/s].

    Raises:
        UnstableError: if a bound, or the square of the damping rate, is not finite.
    """
    if not omega2 + damping * damping < math.inf:
        raise UnstableError(
            f"no step is short enough: the highest frequency is bounded by {math.sqrt(omega2):.3g} 1/s, the damping "
            f"rate by {damping:.3g} 1/s; reduce stiffness, damping or drag, or increase masses"
        )


def refuse_step(step: float, limit: float, name: str) -> None:
    """Raise StepLimitError if a fixed step [s] is above the stability limit [s].

    Raises:
        StepLimitError: naming step, limit and remedy.
    """
    if step > limit:
        raise StepLimitError(
            f"step {step} s is above the stability limit {limit:.6g} s of '{name}'; "
            "set a smaller step, or 0 for automatic steps"
        )
