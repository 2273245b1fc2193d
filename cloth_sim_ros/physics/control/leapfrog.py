# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Leapfrog with a predicted midpoint velocity."""

from __future__ import annotations

from cloth_sim_ros.physics.control.explicit import ExplicitIntegrator
from cloth_sim_ros.physics.integrators.base import check_settings
from cloth_sim_ros.physics.old_names import with_old_names


@with_old_names(columns="n_runs")
class Leapfrog(ExplicitIntegrator):
    """Leapfrog integrator (position Verlet): drift, kick, drift. Velocity Verlet begins with the kick.

    Velocity-dependent forces use a predicted midpoint velocity, so that the order stays 2.

    Drift: ``x_m = x + h/2 v``. Kick: ``a_k = a(t + h/2, x_m, v + h/4 (a_(k-1) + a_(k-2)))``, ``v' = v + h a_k``. Drift:
    ``x' = x_m + h/2 v'``. Each advance starts with one extra evaluation in place of both previous accelerations, so it
    needs no history of the previous advance.

    Order 2. One force evaluation per step. Time-reversible and symplectic without damping. Stable for
    ``h^2 w^2 / 4 + h c / 2 <= 1`` with angular frequency w and damping rate c (characteristic polynomial). Without
    damping this is ``h w <= 2``.

    Args:
        step: largest fixed step [s]; None takes 0.96 of the stability limit.
        tolerance: of positions [m], see docs/time_stepping.md. A second run with smaller steps estimates the error
            every few frames, and the step follows it.
        work: work limit of a frame, as a multiple of real time by the plan's estimated cost; 0 for no limit.

    Raises:
        ValueError: if one of them is not positive, or both are set.
    """

    name = "leapfrog"
    order = 2
    suits = "loose tolerances, long undamped runs; explicit, damping well below critical"
    n_runs = 1

    def __init__(self, step: float | None = None, *, tolerance: float | None = None, work: float = 0.0) -> None:
        self.step, self.tolerance, self.work = check_settings(step, tolerance, work)
