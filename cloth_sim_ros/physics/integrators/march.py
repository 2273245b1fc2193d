# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The leapfrog loop: so many equal steps of one model, by its fused plan where it has one."""

from __future__ import annotations

import numpy as np

from cloth_sim_ros.physics.dynamics import THOROUGH, Dynamics, Economy
from cloth_sim_ros.physics.integrators.base import Observer
from cloth_sim_ros.physics.kernels.leapfrog import drift_and_predict, kick_and_drift
from cloth_sim_ros.physics.terms.base import Array


def leapfrog(
    dynamics: Dynamics,
    t: float,
    x: Array,
    v: Array | None,
    step: float,
    steps: int,
    observer: Observer | None = None,
    weight: float = 1.0,
    *,
    economy: Economy = THOROUGH,
    start: tuple[Array, Array] | None = None,
) -> int:
    """Advance x, v (3, n) by leapfrog with a predicted midpoint velocity; return the force evaluations.

    With h the step: ``x_m = x + h/2 v``, ``a_k = a(t + h/2, x_m, v + h/4 (a_(k-1) + a_(k-2)))``, ``v' = v + h a_k``,
    ``x' = x_m + h/2 v'``. The midpoint velocity is predicted with the accelerations of the two steps before; both are
    taken from one extra evaluation at the start.

    Args:
        dynamics: equations of motion.
        t: time at the start [s].
        x: positions [m]; set to those at the end.
        v: velocities [m/s]; likewise. None where those at the end are not asked for.
        step: length of one step [s].
        steps: number of steps.
        observer: called at each midpoint.
        weight: factor on the observer's weights.
        economy: what the fused plan saves on, where there is one.
        start: positions and velocities to start from, which stay as they are; those in x and v where left out.
    """
    if dynamics.plan is not None:
        dynamics.plan.leapfrog(t, x, v, step, steps, observer, weight, economy=economy, start=start)
    else:
        leapfrog_by_terms(dynamics, t, x, v, step, steps, observer, weight, start=start)
    return steps + 1


def leapfrog_by_terms(
    dynamics: Dynamics,
    t: float,
    x: Array,
    v: Array | None,
    step: float,
    steps: int,
    observer: Observer | None,
    weight: float,
    *,
    start: tuple[Array, Array] | None = None,
) -> None:
    """As `leapfrog`, evaluating the terms one by one."""
    if start is not None:
        x[:] = start[0]
        v = start[1].copy() if v is None else v
        v[:] = start[1]
    assert v is not None, "steps begin with velocities"
    a, before, predicted = (np.empty_like(x) for _ in range(3))
    dynamics.acceleration(t, x, v, a)
    before[:] = a
    for k in range(steps):
        middle = t + (k + 0.5) * step
        drift_and_predict(x, v, a, before, 0.5 * step, predicted)
        a, before = before, a
        dynamics.acceleration(middle, x, predicted, a)
        if observer is not None:
            # The velocity that the forces saw: an impulse observed is then the impulse that was given.
            observer.observe(middle, x, predicted, weight * step)
        kick_and_drift(x, v, a, 0.5 * step)


def leapfrog_limit(omega2: float, damping_rate: float) -> float:
    """Return the largest stable step [s]: the positive root of ``h^2 w^2 / 4 + h c / 2 = 1``.

    On x'' = -w^2 x - c x' a root of the characteristic polynomial reaches the unit circle at -1 alone, there.

    Args:
        omega2: squared highest angular frequency [1/s^2].
        damping_rate: highest damping rate c / m [1/s].
    """
    if omega2 == 0.0 and damping_rate == 0.0:
        return float("inf")
    # Written without cancellation.
    half = 0.5 * damping_rate
    return 2.0 / (half + float(np.sqrt(half * half + omega2)))
