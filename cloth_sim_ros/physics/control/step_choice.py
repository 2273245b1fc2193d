# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Settings and step choice of an explicit advance, and their text for diagnostics."""

from __future__ import annotations

from functools import lru_cache
from typing import Protocol

import attrs


class ExplicitSettings(Protocol):
    """Settings of an explicit integrator."""

    name: str
    tolerance: float | None
    step: float | None
    n_runs: int
    #: Work limit of a frame, as a multiple of real time by the plan's estimated cost; 0 for no limit.
    work: float

    def step_limit(self, omega2: float, damping_rate: float) -> float:
        """Return the largest stable step [s] for a squared frequency [1/s^2] and a damping rate [1/s]."""


# Without slots: then attrs sets a frozen class's members in half the time.
@attrs.frozen(slots=False)
class StepChoice:
    """Number of runs and refinement of an attempt; True if a further run estimates its error."""

    n_runs: int
    refinement: float
    estimates_error: bool

    def expected_runs(self, tolerance: float | None, *, error_was_too_large: bool) -> int:
        """Return the expected number of runs.

        Args:
            tolerance: of positions [m]; None for none.
            error_was_too_large: True if a previous error was too large and a thread is idle.
        """
        if tolerance is None or not self.estimates_error:
            return self.n_runs
        # Two runs and the estimating run rarely suffice then: a third is combined, or more runs find the next choice.
        return self.n_runs + (2 if error_was_too_large and self.n_runs == 2 else 1)

    def limiting_factor(self, options: ExplicitSettings, steps: int, step: float) -> str:
        """Return the limiting factor of a first run, one of `base.LIMITING_FACTORS`.

        Args:
            options: settings of the integrator.
            steps: number of steps of the run.
            step: their length [s].
        """
        if options.step is not None and step > 0.99 * options.step:
            return "step"
        if options.tolerance is not None and self.refinement > 1.0:
            return "accuracy"
        return "frame" if steps == 1 else "stability"

    def describe(self, options: ExplicitSettings, steps: int, step: float) -> str:
        """Return the choice in words, see `limiting_factor`."""
        limit, is_refined = self.limiting_factor(options, steps, step), self.refinement > 1.0
        settings = options.name, options.tolerance, options.step
        return _describe(*settings, limit, self.n_runs, is_refined, steps == 1, step)


def describe_details(ratio: int, single_precision: bool) -> str:
    """Return multirate ratio and precision in words; empty for a ratio of 1 in double precision."""
    text = f"; bending every {ratio} steps" if ratio > 1 else ""
    return f"{text}; in single precision" if single_precision else text


# Most frames have the choice of the previous one.
@lru_cache(maxsize=64)
def _describe(
    name: str,
    tolerance: float | None,
    fixed_step: float | None,
    limit: str,
    n_runs: int,
    is_refined: bool,
    is_single_step: bool,
    step: float,
) -> str:
    order = f"order {n_runs + 1}" + (f" by {n_runs} runs" if n_runs > 1 else "")
    prefix, step_text = f"{name}: {order}", f"{step:.3g} s"
    if limit == "step":
        return f"{prefix}, fixed step of {step_text}"
    if tolerance is None:
        origin = "set by stability" if fixed_step is None else f"of {fixed_step:.3g} s"
        if is_refined:
            return f"{prefix}, step {origin} made {step_text}: springs pushed to a point made energy"
        if fixed_step is not None:
            return f"{prefix}, step {origin} made {step_text}: the motion stiffened"
        return f"{prefix}, step {step_text} {origin}, no tolerance"
    tolerance_text = f"tolerance {tolerance:g} m"
    if is_refined:
        return f"{prefix}, step {step_text} set by the {tolerance_text}"
    step_clause = "one step a frame" if is_single_step else f"step {step_text} set by stability"
    return f"{prefix}, {step_clause}; it holds the {tolerance_text}"
