# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Measured step limits against predicted ones, and sixteen peer cases."""

from __future__ import annotations

import itertools
import math

import numpy as np
from support.raw_sheet import RawSheet

from cloth_sim_ros import Leapfrog, Plan, State
from cloth_sim_ros.physics.model.forces.force import Array
from validation.report import Table

#: Largest relative excess of a measured limit over its bound; a limit below its bound is a failure.
LARGEST_EXCESS = 0.25
STRETCHES, DAMPINGS = (1.0, 1.2, 1.5, 2.0, 3.0), (0.0, 0.2, 1.0)
#: Steps over which a perturbation must not grow, and the perturbation [m].
_STEPS, _PERTURBATION = 1500, 1e-9


def limits() -> tuple[Table, list[str]]:
    """Return measured limits of fixed steps at stretched states, and those that violate their bounds."""
    columns = ["stretch", "k_d0", "bound s", "found s", "found / bound"]
    table = Table("Step limit of the leapfrog about stretched states", columns)
    failures = []
    for stretch, k_d0 in itertools.product(STRETCHES, DAMPINGS):
        plan, x = stretched_sheet(stretch, k_d0)
        bound = Leapfrog().step_limit(*plan.spectral_bounds(x))
        measured = measure_step_limit(plan, x, bound)
        table.rows.append([stretch, k_d0, bound, measured, measured / bound])
        if not 0.998 <= measured / bound <= 1.0 + LARGEST_EXCESS:
            failures.append(f"limit at stretch {stretch}, k_d0 {k_d0}: found {measured:.3g} s, bound {bound:.3g} s")
    return table, failures


def stretched_sheet(stretch: float, k_d0: float, resolution: int = 12) -> tuple[Plan, Array]:
    """Return the plan and positions (3, n) [m] of a sheet with pinned border and every spring stretched."""
    sheet = RawSheet(resolution=resolution, k_d0=k_d0, relative_rest_length=1.0 / stretch, gravity=(0.0, 0.0, 0.0))
    index = sheet.index
    border = np.unique(np.concatenate([index[0], index[-1], index[:, 0], index[:, -1]]))
    return sheet.plan(border), State(sheet.flat(hung=False)).x


def measure_step_limit(plan: Plan, x: Array, bound: float) -> float:
    """Find the largest step [s] at which a perturbation does not grow, by bisection."""
    low, high = 0.5 * bound, 2.0 * bound
    perturbation = _PERTURBATION * np.random.default_rng(1).normal(size=x.shape) * (plan.model.inverse_masses > 0.0)
    while high / low > 1.002:
        step = math.sqrt(low * high)
        final_positions = []
        for start in (x, x + perturbation):
            (run,), _ = plan.runs(0.0, _STEPS * step, (start, np.zeros_like(x)), [_STEPS])
            final_positions.append(run.x)
        deviation = float(np.abs(final_positions[1] - final_positions[0]).max())
        if math.isfinite(deviation) and deviation < 100.0 * _PERTURBATION:
            low = step
        else:
            high = step
    return low


def max_stretch(pairs: np.ndarray, rest_length: Array, x: Array) -> float:
    """Return the largest length of springs relative to their rest length; joints (rest length 0) do not count."""
    separations = x[:, pairs[:, 1]] - x[:, pairs[:, 0]]
    length = np.sqrt(np.sum(separations * separations, axis=0))
    return float(np.max(length[rest_length > 0.0] / rest_length[rest_length > 0.0], initial=0.0))
