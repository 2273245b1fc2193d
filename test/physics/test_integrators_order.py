# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Order of each integrator, measured on a soft, smooth, damped, nonlinear sheet."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from support.raw_sheet import RawSheet
from support.reference import RightSide

from cloth_sim_ros.physics.control.extrapolated import Extrapolated
from cloth_sim_ros.physics.control.leapfrog import Leapfrog
from cloth_sim_ros.physics.integrators.base import Integrator
from cloth_sim_ros.physics.integrators.symplectic_euler import SymplecticEuler
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.state.state import State

DURATION = 0.04


def soft_sheet() -> tuple[Plan, State]:
    """Return a sheet of 6 x 6, stretched by 15 % and sheared: direction and length of every spring change."""
    sheet = RawSheet(resolution=6, stiffness=0.1, k_d0=0.3, drag=1.0)
    positions = 1.15 * sheet.flat(hung=True)
    velocities = np.zeros_like(positions)
    velocities[:, 1] = np.sin(2.0 * positions[:, 2])
    velocities[:, 0] = 0.5 * positions[:, 2] ** 2
    velocities[sheet.index[0]] = 0.0
    return sheet.plan(sheet.index[0]), State(positions, velocities)


@pytest.fixture(scope="module")
def exact() -> np.ndarray:
    plan, state = soft_sheet()
    right = RightSide(plan)
    end = solve_ivp(right, (0.0, DURATION), right.start(state), method="DOP853", rtol=3e-14, atol=1e-15)
    return right.positions(end.y[:, -1])


def measured_order(make: Callable[[float], Integrator], counts: list[int], exact: np.ndarray) -> float:
    errors = []
    for count in counts:
        plan, state = soft_sheet()
        make(DURATION / count).advance(plan, state, 0.0, DURATION)
        errors.append(float(np.abs(state.x - exact).max()))
    assert min(errors) > 1e-12, f"rounding would be fitted: {errors}"
    return float(-np.polyfit(np.log(counts), np.log(errors), 1)[0])


@pytest.mark.parametrize(
    ("make", "counts", "order", "margin"),
    [
        (lambda h: SymplecticEuler(h), [40, 80, 160], 1, 0.1),
        (lambda h: Leapfrog(h), [20, 40, 80], 2, 0.1),
        (lambda h: Extrapolated(step=h, n_runs=1), [20, 40, 80], 2, 0.1),
        (lambda h: Extrapolated(step=h, n_runs=2), [20, 40, 80], 3, 0.1),
        (lambda h: Extrapolated(step=h, n_runs=3), [20, 40, 80], 4, 0.1),
        (lambda h: Extrapolated(step=h, n_runs=4), [32, 48, 64], 5, 0.5),
    ],
    ids=["symplectic_euler", "leapfrog", "columns_1", "columns_2", "columns_3", "columns_4"],
)
def test_measured_order_equals_claimed_order(
    make: Callable[[float], Integrator], counts: list[int], order: int, margin: float, exact: np.ndarray
) -> None:
    assert make(DURATION / counts[0]).order == order
    assert measured_order(make, counts, exact) == pytest.approx(order, abs=margin)
