# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What an explicit advance is asked for, what it chooses, and both in the words that diagnostics show."""

from __future__ import annotations

from functools import lru_cache
from typing import Protocol

import attrs


class Options(Protocol):
    """What the loop needs to know of its integrator."""

    name: str
    tolerance: float | None
    step: float | None
    columns: int
    #: Most work of a frame, in real time by the plan's estimated cost; 0 for no limit.
    work: float

    def step_limit(self, omega2: float, damping_rate: float) -> float:
        """Largest stable step [s]."""


# Without slots: then attrs sets a frozen class's members in half the time.
@attrs.frozen(slots=False)
class Choice:
    """Runs and refinement of an attempt, and whether another run judges it."""

    columns: int
    refine: float
    judge: bool

    def likely(self, tolerance: float | None, *, missed: bool) -> int:
        """Return how many runs are likely to be asked for; `missed`: an error was too large, and time is to spare."""
        if tolerance is None or not self.judge:
            return self.columns
        # Two runs and their judge seldom do then: either a third is combined, or more of them tell what would do.
        return self.columns + (2 if missed and self.columns == 2 else 1)


def binds(options: Options, choice: Choice, steps: int, step: float) -> str:
    """Return what bound a first run of so many steps of that length [s], one of `base.BINDING`."""
    if options.step is not None and step > 0.99 * options.step:
        return "step"
    if options.tolerance is not None and choice.refine > 1.0:
        return "accuracy"
    return "frame" if steps == 1 else "stability"


def reason(options: Options, choice: Choice, steps: int, step: float) -> str:
    """Return the choice in words."""
    bound = binds(options, choice, steps, step)
    refined = choice.refine > 1.0
    return _words(options.name, options.tolerance, options.step, bound, choice.columns, refined, steps == 1, step)


def asides(every: int, narrow: bool) -> str:
    """Return in words what else was chosen: how often hinges were asked for, and the precision."""
    words = f"; bending every {every} steps" if every > 1 else ""
    return f"{words}; in single precision" if narrow else words


# Most frames are stepped as the one before.
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
