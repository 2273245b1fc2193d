# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Equilibrium of a plan's forces and a constant load by Newton's method."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros import Plan
from cloth_sim_ros.physics.model.forces.force import Array

_MAX_ITERATIONS = 500


def find_equilibrium(
    plan: Plan, start: Array, free: NDArray[np.bool_], *, accuracy: float, load: Array | float = 0.0
) -> Array:
    """Return positions (n, 3) [m] at which no free coordinate has a force above `accuracy` [N].

    The Hessian is shifted until a step lowers the energy.

    Args:
        plan: forces.
        start: positions [m], (n, 3).
        free: coordinates that may move, (n, 3).
        accuracy: largest remaining force on a coordinate [N].
        load: constant force on each particle [N], (n, 3).

    Raises:
        RuntimeError: if no equilibrium is found.
    """
    from scipy.sparse import csc_array
    from scipy.sparse.linalg import splu

    x, weight, mask = np.ascontiguousarray(start.T), plan.model.mass, free.T
    still, loads = np.zeros_like(x), np.broadcast_to(load, start.shape).T

    def energy() -> float:
        return plan.energies(0.0, x, None)[1] - float(np.sum(loads * x))

    def force() -> Array:
        out = loads.copy()
        plan.add_force(0.0, x, still, out)
        return out[mask]

    def hessian() -> Array:
        products = np.zeros((np.count_nonzero(mask), *x.shape))
        for product, coordinate in zip(products, np.argwhere(mask), strict=True):
            direction = np.zeros_like(x)
            direction[tuple(coordinate)] = 1.0
            plan.add_jacobian_product(0.0, x, still, direction, still, product)
        return -products[:, mask]

    shift, min_energy, f = 0.0, energy(), force()
    for _ in range(_MAX_ITERATIONS):
        if np.abs(f).max() < accuracy:
            return x.T.copy()
        step = splu(csc_array(hessian() + shift * np.eye(len(f)))).solve(f)
        x[mask] += step
        new_energy, new_force = energy(), force()
        is_lower = (
            new_energy <= min_energy + 1e-13 * abs(min_energy) or np.abs(new_force).max() < 1e-3 * np.abs(f).max()
        )
        if is_lower and step @ f > 0.0:
            shift, min_energy, f = (0.1 * shift if shift > 1e-6 * weight else 0.0), new_energy, new_force
        else:
            x[mask] -= step
            shift = max(10.0 * shift, 1e-3 * weight)
    raise RuntimeError(f"no equilibrium: a force of {np.abs(f).max():.2e} N remains")
