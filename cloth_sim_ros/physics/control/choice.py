# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Settings and step choice of an explicit advance, and their text for diagnostics."""

from __future__ import annotations

from functools import lru_cache
from typing import Protocol

import attrs


class Options(Protocol):
    """Settings of an explicit integrator."""

    name: str
    tolerance: float | None
    step: float | None
    columns: int
    #: Work limit of a frame, as a multiple of real time by the plan's estimated cost; 0 for no limit.
    work: float

    def step_limit(self, omega2: float, damping_rate: float) -> float:
        """Return the largest stable step [s] for a squared frequency [1/s^2] and a damping rate [1/s]."""


# Without slots: then attrs sets a frozen class's members in half the time.
@attrs.frozen(slots=False)
class Choice:
    """Number of runs and refinement of an attempt; True if a further run estimates its error."""

    columns: int
    refine: float
    judge: bool

    def likely(self, tolerance: float | None, *, missed: bool) -> int:
        """Return the expected number of runs.

        Args:
            tolerance: of positions [m]; None for none.
            missed: True if a previous error was too large and a thread is idle.
        """
        if tolerance is None or not self.judge:
            return self.columns
        # Two runs and the estimating run rarely suffice then: a third is combined, or more runs find the next choice.
        return self.columns + (2 if missed and self.columns == 2 else 1)


def binds(options: Options, choice: Choice, steps: int, step: float) -> str:
    """Return the limiting factor of a first run, one of `base.LIMITING_FACTORS`.

    Args:
        options: settings of the integrator.
        choice: of the attempt.
        steps: number of steps of its first run.
        step: their length [s].
    """
    if options.step is not None and step > 0.99 * options.step:
        return "step"
    if options.tolerance is not None and choice.refine > 1.0:
        return "accuracy"
    return "frame" if steps == 1 else "stability"


def reason(options: Options, choice: Choice, steps: int, step: float) -> str:
    """Return the choice in words, see `limiting_factor`."""
    bound = binds(options, choice, steps, step)
    refined = choice.refine > 1.0
    return _words(options.name, options.tolerance, options.step, bound, choice.columns, refined, steps == 1, step)


def asides(every: int, narrow: bool) -> str:
    """Return multirate ratio and precision in words; empty for a ratio of 1 in double precision."""
    words = f"; bending every {every} steps" if every > 1 else ""
    return f"{words}; in single precision" if narrow else words


# Most frames have the choice of the previous one.
@lru_cache(maxsize=64)
def _words(
    name: str,
    tolerance: float | None,
    fixed: float | None,
    bound: str,
    columns: int,
    refined: bool,
    one: bool,
    step: float,
) -> str:
    order = f"order {columns + 1}" + (f" by {columns} runs" if columns > 1 else "")
    begin, h = f"{name}: {order}", f"{step:.3g} s"
    if bound == "step":
        return f"{begin}, fixed step of {h}"
    if tolerance is None:
        why = "set by stability" if fixed is None else f"of {fixed:.3g} s"
        if refined:
            return f"{begin}, step {why} made {h}: springs pushed to a point made energy"
        if fixed is not None:
            return f"{begin}, step {why} made {h}: the motion stiffened"
        return f"{begin}, step {h} {why}, no tolerance"
    held = f"tolerance {tolerance:g} m"
    if refined:
        return f"{begin}, step {h} set by the {held}"
    length = "one step a frame" if one else f"step {h} set by stability"
    return f"{begin}, {length}; it holds the {held}"
