# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What an integrator is."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import NamedTuple

from cloth_sim_ros.physics.book import Book
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.state import State


class UnstableError(RuntimeError):
    """The motion became non-finite, or no step was small enough for it."""

    #: Force evaluations that were spent on finding out, where they are told.
    evaluations = 0


class MissedError(UnstableError):
    """The tolerance can't be held, and a result that misses it is not wanted."""


#: What may bind a step: `accuracy` (the tolerance), `stability` (the step limit), `frame` (a frame is one step
#: already), `step` (the user's fixed step), `work` (the cap of a frame's work), `rest` (the sheet sleeps: there is
#: none).
BINDING = ("accuracy", "stability", "frame", "step", "work", "rest")
#: Most work of a frame, where nothing else is asked for: in real time by the plan's estimated cost.
WORK_LIMIT = 10.0
#: What positions are held within, where nothing else is asked for [m]: see `tolerance` of the scene.
TOLERANCE = 1e-3


class Advance(NamedTuple):
    """What an integrator did over one stretch of time."""

    #: Steps of the runs that make up the result.
    steps: int
    #: Force evaluations, those of rejected steps included.
    evaluations: int
    #: Smallest step taken [s].
    step: float
    #: Largest step that is stable by the bounds at the start [s]; infinite for a method that is stable at any step.
    limit: float
    #: Attempts thrown away: the motion stiffened while they ran, or their error was too large.
    rejected: int = 0
    #: Name of the integrator that ran.
    integrator: str = ""
    #: What bound the step, one of `BINDING`.
    binds: str = ""
    #: Estimated largest particle position error [m] made over the stretch; None where no tolerance is set.
    error: float | None = None
    #: Times that the smallest step was accepted although its error was above the tolerance's share.
    flagged: int = 0
    #: The choice in words.
    reason: str = ""


class Integrator(ABC):
    """Advances a state over a stretch of time, in as many steps as it needs, ending exactly on its end."""

    name: str
    #: Order of the error in the step, damping and nonlinearity included.
    order: int
    #: What it is for, in a line: damping and stiffness.
    suits: str = ""

    @abstractmethod
    def step_limit(self, omega2: float, damping_rate: float) -> float:
        """Return the largest stable step [s] for a squared frequency [1/s^2] and a damping rate c/m [1/s]."""

    @abstractmethod
    def advance(self, plan: Plan, state: State, t: float, duration: float, book: Book | None = None) -> Advance:
        """Advance ``state`` from time t [s] by duration [s].

        Its arrays of positions and velocities are replaced, not written into: who holds them holds the state before.
        What a controller remembers from one call to the next lies in ``state.memory``.

        Raises:
            UnstableError: if the motion does not stay finite.
        """


def check_step(step: float | None) -> float | None:
    """Return a fixed step as it is, None for none.

    Raises:
        ValueError: if it is not finite and above 0.
    """
    if step is not None and not (math.isfinite(step) and step > 0.0):
        raise ValueError(f"step is {step} s; it must be finite and above 0")
    return step


def check_work(work: float) -> float:
    """Return a work limit as it is.

    Raises:
        ValueError: if it is not finite and at least 0.
    """
    if not (math.isfinite(work) and work >= 0.0):
        raise ValueError(f"work limit is {work}; it must be finite and at least 0, which is none")
    return work


def check_tolerance(tolerance: float | None) -> float | None:
    """Return a tolerance as it is, None for none.

    Raises:
        ValueError: if it is not finite and above 0.
    """
    if tolerance is not None and not (math.isfinite(tolerance) and tolerance > 0.0):
        raise ValueError(f"tolerance is {tolerance} m; it must be finite and above 0")
    return tolerance


class StepLimitError(UnstableError, ValueError):
    """A fixed step is above the stability limit: at the start, or because the motion stiffened."""


class NoRoomError(UnstableError, ValueError):
    """The cloth is within an obstacle, or passes through itself or one: at the start, or as it was squeezed by what
    moves.
    """


def refuse_boundless(omega2: float, damping: float) -> None:
    """Refuse a motion that no step follows.

    Args:
        omega2: bound of the squared frequency [1/s^2].
        damping: bound of the damping rate [1/s].

    Raises:
        UnstableError: if a bound, or the square of the second, is beyond all numbers.
    """
    if not omega2 + damping * damping < math.inf:
        raise UnstableError(
            f"no step is short enough: the highest frequency is bounded by {math.sqrt(omega2):.3g} 1/s, the damping "
            f"rate by {damping:.3g} 1/s; take less stiffness, damping or drag, or larger masses"
        )


def refuse_unstable(step: float, limit: float, name: str) -> None:
    """Refuse a fixed step above the limit.

    Raises:
        StepLimitError: naming step, limit and remedy.
    """
    if step > limit:
        raise StepLimitError(
            f"step {step} s is above the stability limit {limit:.6g} s of '{name}'; "
            "take a smaller step, or 0 to let it choose"
        )
