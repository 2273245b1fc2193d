# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Leapfrog with a midpoint velocity."""

from __future__ import annotations

from cloth_sim_ros.physics.integrators.extrapolated import Extrapolated


class Leapfrog(Extrapolated):
    """Drift, kick, drift; velocity-dependent forces are evaluated at a midpoint velocity, so that the order stays 2.

    The midpoint velocity is predicted with the accelerations of the two steps before (`march.leapfrog`); each advance
    starts that with one extra evaluation, so that no history crosses its boundary.

    Order 2. One force evaluation a step. Time-reversible and symplectic without damping. An oscillator of angular
    frequency w and damping rate c is stable for h^2 w^2 / 4 + h c / 2 <= 1 (characteristic polynomial; without damping
    h w <= 2).

    Args:
        step: fixed largest step [s]; None takes 0.96 of the stability limit.
        tolerance: target of the largest particle position error at frames [m]: the step follows the error, which a
            second run with smaller steps judges every few frames.

    Raises:
        ValueError: if one of them is not positive, or both are set.
    """

    name = "leapfrog"
    suits = "loose tolerances, long undamped runs; explicit, damping well below critical"

    def __init__(self, step: float | None = None, *, tolerance: float | None = None) -> None:
        super().__init__(tolerance=tolerance, step=step, columns=1)
