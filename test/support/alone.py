# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Plans of single forces, with results as return values instead of added to arrays."""

from types import MappingProxyType

import numpy as np

from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.plan.plan import compile

#: Memory of a state without anchors, jaws and reduced thickness.
NO_MEMORY = MappingProxyType({})


def alone(*forces, count=None, masses=None):
    """Return the plan of a model of these forces and free particles, of 1 kg each by default."""
    return compile(Model(np.ones(count) if masses is None else masses, forces))


def force(plan, x, v=None, t=0.0, memory=NO_MEMORY):
    """Return forces [N], shape (3, n); at rest by default."""
    f = np.zeros_like(x)
    plan.add_force(t, x, np.zeros_like(x) if v is None else v, f, memory)
    return f


def blocks(plan, x):
    """Bounds of stiffness and of damping, (6, n) each."""
    stiff, damped = np.zeros((6, x.shape[1])), np.zeros((6, x.shape[1]))
    plan.add_bounds(x, stiff, damped, memory=NO_MEMORY)
    return stiff, damped


def product(plan, x, v, dx, dv, t=0.0, memory=NO_MEMORY):
    """Derivative of the force along (dx, dv), shape (3, n)."""
    out = np.zeros_like(x)
    plan.add_jacobian_product(t, x, v, dx, dv, out, memory=memory)
    return out


def matrix(plan, x, v, part, t=0.0, memory=NO_MEMORY):
    """Minus the derivative of the force by positions, `part` "x", or velocities, "v": (3n, 3n), component-major."""
    columns, zero = [], np.zeros_like(x)
    for index in np.ndindex(x.shape):
        push = np.zeros_like(x)
        push[index] = 1.0
        columns.append(-product(plan, x, v, *((push, zero) if part == "x" else (zero, push)), t, memory).ravel())
    return np.array(columns).T


def full(block):
    """The matrix (3n, 3n), component-major, of a bound's blocks (6, n)."""
    count = block.shape[1]
    whole = np.zeros((3, count, 3, count))
    for (i, j), row in zip([(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)], block, strict=True):
        whole[i, range(count), j, range(count)] = whole[j, range(count), i, range(count)] = row
    return whole.reshape(3 * count, 3 * count)


def of_blocks(plan, x):
    """Return the largest eigenvalues of `blocks` over masses: squared frequency and damping rate."""
    return [
        float((np.linalg.eigvalsh(bound[[[0, 3, 4], [3, 1, 5], [4, 5, 2]]].T)[:, -1] * plan.model.inverse_masses).max())
        for bound in blocks(plan, x)
    ]


def gradient(energy, x, step=1e-5):
    """Central differences of an energy, shape (3, n)."""
    slopes = np.zeros_like(x)
    for index in np.ndindex(x.shape):
        up, down = x.copy(), x.copy()
        up[index] += step
        down[index] -= step
        slopes[index] = (energy(up) - energy(down)) / (2.0 * step)
    return slopes
