# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Runs at a tolerance, each frame compared with a reference."""

from __future__ import annotations

import math
from collections import Counter

import attrs

from cloth_sim_ros.physics.accounting.energy_balance import EnergyBalance
from cloth_sim_ros.physics.control.automatic import make_integrator
from support.problems import PERIOD, Problem
from support.reference import Reference


@attrs.frozen
class Outcome:
    """One scene at one tolerance."""

    #: Largest position error at any frame [m].
    error: float
    #: Sum of the estimates [m].
    estimate: float
    evaluations: int
    rejected: int
    flagged: int
    #: Share of the frames in which each binding held.
    binds: Counter[str]
    integrators: Counter[str]
    #: Residual of the energy balance over the energy turned over; NaN if not asked for.
    residual: float


def measure(scene: Problem, known: Reference, integrator: str, tolerance: float, *, energy: bool) -> Outcome:
    """Run a scene at a tolerance and compare every frame with the reference."""
    plan, state = scene.build()
    stepper = make_integrator(integrator, tolerance=tolerance)
    balance = EnergyBalance(plan, state) if energy else None
    book = balance.accumulator if balance is not None else None
    error = estimate = residual = 0.0
    evaluations = rejected = flagged = 0
    binds: Counter[str] = Counter()
    integrators: Counter[str] = Counter()
    for frame in range(scene.frames):
        done = stepper.advance(plan, state, frame * PERIOD, PERIOD, book)
        error = max(error, known.deviation(frame + 1, state.x))
        estimate += done.error or 0.0
        evaluations += done.evaluations
        rejected += done.rejected
        flagged += done.flagged
        binds[done.limited_by] += 1
        integrators[done.integrator] += 1
        if balance is not None:
            residual = max(residual, abs(balance.add_advance((frame + 1) * PERIOD, state)))
    relative = residual / balance.energy_turnover if balance is not None else math.nan
    return Outcome(error, estimate, evaluations, rejected, flagged, binds, integrators, relative)
