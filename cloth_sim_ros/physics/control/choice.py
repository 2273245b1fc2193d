# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What an explicit advance is asked for, what it chooses, and both in the words that diagnostics show."""

from __future__ import annotations

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


@attrs.frozen
class Choice:
    """Runs and refinement of an attempt, and whether another run judges it."""

    columns: int
    refine: float
    judge: bool


def binds(options: Options, choice: Choice, steps: int, step: float) -> str:
    """Return what bound a first run of so many steps of that length [s], one of `base.BINDING`."""
    if options.step is not None and step > 0.99 * options.step:
        return "step"
    if options.tolerance is not None and choice.refine > 1.0:
        return "accuracy"
    return "frame" if steps == 1 else "stability"


def reason(options: Options, choice: Choice, steps: int, step: float) -> str:
    """Return the choice in words."""
    order = f"order {choice.columns + 1}" + (f" by {choice.columns} runs" if choice.columns > 1 else "")
    begin, h = f"{options.name}: {order}", f"{step:.3g} s"
    if options.step is not None and binds(options, choice, steps, step) == "step":
        return f"{begin}, fixed step of {h}"
    if options.tolerance is None:
        why = "set by stability" if options.step is None else f"of {options.step:.3g} s"
        if choice.refine > 1.0:
            return f"{begin}, step {why} made {h}: springs pushed to a point made energy"
        if options.step is not None:
            return f"{begin}, step {why} made {h}: the motion stiffened"
        return f"{begin}, step {h} {why}, no tolerance"
    held = f"tolerance {options.tolerance:g} m"
    if choice.refine > 1.0:
        return f"{begin}, step {h} set by the {held}"
    bound = "one step a frame" if steps == 1 else f"step {h} set by stability"
    return f"{begin}, {bound}; it holds the {held}"
