# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Measured step limits against predicted ones, and sixteen peer cases."""

from __future__ import annotations

import itertools
import math

import attrs
import numpy as np
from support.raw_sheet import RawSheet

from cloth_sim_ros.physics.arithmetic.arrays import largest_distance
from cloth_sim_ros.physics.control.extrapolated import Extrapolated
from cloth_sim_ros.physics.control.leapfrog import Leapfrog
from cloth_sim_ros.physics.integrators.base import UnstableError
from cloth_sim_ros.physics.integrators.implicit import Implicit
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.state.state import State
from validation.report import Table

#: Largest relative excess of a measured limit over its bound; a limit below its bound is a failure.
LARGEST_EXCESS = 0.25
STRETCHES, DAMPINGS = (1.0, 1.2, 1.5, 2.0, 3.0), (0.0, 0.2, 1.0)
#: Steps over which a perturbation must not grow, and the perturbation [m].
_STEPS, _PERTURBATION = 1500, 1e-9
#: Largest stretch of a sheet that counts as intact.
MAX_INTACT_STRETCH = 1.5
#: Time up to which a pointwise error is meaningful on scene A [s]: a perturbation has grown about 200 times by then.
HORIZON = 0.5


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


@attrs.frozen
class PeerCase:
    """Scene A (16 x 16, 2 s) at a factor of the moduli and a fixed step [s]."""

    stiffness: float
    step: float


_PEER_PERIODS = (1 / 60, 1 / 240, 1 / 1000, 1 / 4000)
PEER_CASES = [PeerCase(*both) for both in itertools.product((1.0, 10.0, 100.0, 1000.0), _PEER_PERIODS)]


def run_peer_case(case: PeerCase) -> tuple[str, float, float, str]:
    """Run one case; return the integrator, the largest stretch, the error [m] at `HORIZON`, and any failure.

    The leapfrog takes the step if it is stable, otherwise the implicit method. The error is the largest distance of a
    particle from its reference position. The reference is the extrapolated leapfrog (4 runs) at its stability limit.
    """
    sheet = RawSheet(resolution=16, stiffness=case.stiffness, k_d0=0.05)
    plan, state = sheet.plan(sheet.index[0, [0, -1]]), State(sheet.flat(hung=False))
    is_explicit_stable = case.step <= 0.9 * Leapfrog().step_limit(*plan.spectral_bounds(state.x))
    integrator = Leapfrog(case.step) if is_explicit_stable else Implicit(case.step)
    reference_state, reference = state.copy(), Extrapolated(n_runs=4)
    largest_stretch, error = 1.0, 0.0
    try:
        for frame in range(120):
            integrator.advance(plan, state, frame / 60, 1 / 60)
            stretches = (max_stretch(term.pairs, term.rest_length, state.x) for term in sheet.springs()[:2])
            largest_stretch = max(largest_stretch, *stretches)
            if frame < HORIZON * 60:
                reference.advance(plan, reference_state, frame / 60, 1 / 60)
                error = largest_distance(state.x, reference_state.x)
    except (UnstableError, ValueError) as failure:
        return integrator.name, largest_stretch, error, str(failure)
    reason = "" if largest_stretch <= MAX_INTACT_STRETCH else f"stretched {largest_stretch:.3g} times"
    return integrator.name, largest_stretch, error, reason


def max_stretch(pairs: np.ndarray, rest_length: Array, x: Array) -> float:
    """Return the largest length of springs relative to their rest length; joints (rest length 0) do not count."""
    separations = x[:, pairs[:, 1]] - x[:, pairs[:, 0]]
    length = np.sqrt(np.sum(separations * separations, axis=0))
    return float(np.max(length[rest_length > 0.0] / rest_length[rest_length > 0.0], initial=0.0))
