# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Settings of explicit integrators, and the text on their steps for diagnostics."""

from __future__ import annotations

from functools import lru_cache
from typing import Protocol


class ExplicitSettings(Protocol):
    """Protocol of the settings of an explicit integrator: tolerance, fixed step, number of runs, work limit."""

    name: str
    tolerance: float | None
    step: float | None
    n_runs: int
    #: Work limit of a frame, as a multiple of real time by the plan's estimated cost; 0 for no limit.
    work: float


# Most frames have the steps of the previous one.
@lru_cache(maxsize=64)
def describe(
    name: str,
    tolerance: float | None,
    fixed_step: float | None,
    n_runs: int,
    step: float,
    ratio: int,
    *,
    has_fewest_steps: bool,
    equal_step: float,
    is_refined: bool,
    single_precision: bool,
    n_pieces: int,
) -> tuple[str, str]:
    """Return the limiting factor of the step, and a text on order and step of an advance and their cause.

    Args:
        name: of the integrator.
        tolerance: of positions [m]; None for none.
        fixed_step: fixed step [s]; None for none.
        n_runs: number of combined runs.
        step: smallest step [s].
        ratio: multirate ratio.
        has_fewest_steps: true if stability needs no more steps than any frame has.
        equal_step: the fixed step, shortened so that an advance has equal steps [s]; 0 for none.
        is_refined: true if the steps are shorter than stability requires.
        single_precision: true if a run used single precision.
        n_pieces: number of pieces of a divided frame; 1 if it is whole.
    """
    limit = "frame" if has_fewest_steps else "stability"
    if fixed_step is not None and step > 0.99 * equal_step:
        limit = "step"
    elif tolerance is not None and is_refined:
        limit = "accuracy"
    order = f"order {n_runs + 1}" + (f" by {n_runs} runs" if n_runs > 1 else "")
    pieces = f" in the finest of {n_pieces} pieces" if n_pieces > 1 else ""
    ending = pieces + (f"; bending every {ratio} steps" if ratio > 1 else "")
    ending += "; in single precision" if single_precision else ""
    return limit, f"{name}: {order}, {_step_text(tolerance, fixed_step, limit, step, is_refined)}{ending}"


def _step_text(tolerance: float | None, fixed_step: float | None, limit: str, step: float, is_refined: bool) -> str:
    """Return a text on the step [s] and its cause: fixed, tolerance, stability or frame."""
    text = f"{step:.3g} s"
    if limit == "step":
        return f"fixed step of {text}"
    if tolerance is None:
        origin = "set by stability" if fixed_step is None else f"of {fixed_step:.3g} s"
        if is_refined:
            return f"step {origin} made {text}: springs pushed to a point made energy"
        if fixed_step is not None:
            return f"step {origin} made {text}: the motion stiffened"
        return f"step {text} {origin}, no tolerance"
    if is_refined:
        return f"step {text} set by the tolerance {tolerance:g} m"
    step_clause = "fewest steps of a frame" if limit == "frame" else f"step {text} set by stability"
    return f"{step_clause}; it holds the tolerance {tolerance:g} m"


def describe_miss(work: float, *, is_exhausted: bool) -> str:
    """Return a text on why an advance missed its tolerance, with its work limit or 0 for none."""
    if not is_exhausted:
        return "the tolerance is finer than rounding of the coordinates allows"
    if work:
        return f"the tolerance was missed within the frame's work limit of {work:g}"
    return "finer steps did not reduce the error"
