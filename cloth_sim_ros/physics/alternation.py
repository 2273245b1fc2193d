# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Whether weak springs may be evaluated at every second step only: the stability of that on an endless sheet.

Impulses at every second step push fast waves in time with their own swing: a wave that turns by about a quarter in a
step grows, unless damping takes more of it (the resonance of multiple-time-step methods; Schlick, Molecular Modeling
and Simulation, 2nd ed., ch. 14). On a flat, evenly stretched, endless sheet every wave (q_r, q_c) keeps to itself, so
the matrix of two steps is of size 8 within the sheet's plane and 4 across, and its spectral radius is exact, whatever
the families have or lack in common.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from cloth_sim_ros.physics.kernels.grid_rows import FAMILIES
from cloth_sim_ros.physics.kernels.grid_springs import GridFamily
from cloth_sim_ros.physics.terms.base import Array

#: Waves along each axis that are looked at.
_WAVES = 10
#: Even stretches at which the sheet has to be stable; what is stiffer than the second of these is not alternated.
_STRETCHES = (1.0, 1.1)
#: Squared frequency, relative to that of the unstretched sheet, up to which this says something: the second stretch's.
STIFFER = 1.08
#: Shares of the step limit that are tried.
_SHARES = (0.96, 0.94, 0.92, 0.9)
#: Growth in two steps that is rounding of the eigenvalues.
_ROUNDING = 1e-7


@lru_cache(maxsize=64)
def stable_share(families: tuple[GridFamily, ...], mass: float) -> float:
    """Return the share of the leapfrog's step limit up to which weak families may be taken at every second step; 0
    where that does not pay, or nothing is known of it.

    Args:
        families: the sheet's springs.
        mass: of a particle within it [kg].
    """
    names = {family.name for family in families}
    weak = any(family.weak for family in families)
    if not weak or not {"right", "down"} <= names or any(family.parity is not None for family in families):
        return 0.0
    # Within the plane first: there waves are faster.
    lattices = [_lattice(families, mass, stretch, axes) for axes in (slice(2), slice(2, 3)) for stretch in _STRETCHES]
    plane, across = lattices[: len(_STRETCHES)], lattices[len(_STRETCHES) :]
    limits = [_limit(lattice) for lattice in plane]
    for share in _SHARES:
        steps = [share * limit for limit in limits]
        if all(
            _radius(*of, h) <= 1.0 + _ROUNDING for part in (plane, across) for of, h in zip(part, steps, strict=True)
        ):
            return share
    return 0.0


def _lattice(families: tuple[GridFamily, ...], mass: float, stretch: float, axes: slice) -> tuple[Array, Array]:
    """Stiffness [1/s^2] and damping [1/s] of each wave along some axes, of the strong families and of the weak ones;
    each of shape (2, waves, axes, axes).
    """
    half = (np.arange(_WAVES) + 0.5) * np.pi / _WAVES
    down, right = (part.ravel() for part in np.meshgrid(np.concatenate([half, -half]), half, indexing="ij"))
    lengths = {family.name: family.rest_length for family in families}
    size = len(range(3)[axes])
    stiffness, damping = np.zeros((2, 2, len(down), size, size))
    for family in families:
        ends = FAMILIES[family.name]
        rows, columns = ends.second[0] - ends.first[0], ends.second[1] - ends.first[1]
        way = stretch * np.array([columns * lengths["right"], rows * lengths["down"], 0.0])
        length = float(np.linalg.norm(way))
        along = np.outer(way[axes], way[axes]) / length**2
        # F = k_s (1/l0 - 1/l) across, k_s / l0 along (S1 of the model).
        across = family.stiffness * (1.0 / family.rest_length - 1.0 / length)
        block = family.stiffness / family.rest_length * along + across * (np.eye(size) - along)
        wave = (4.0 * np.sin(0.5 * (down * rows + right * columns)) ** 2 / mass)[:, None, None]
        stiffness[int(family.weak)] += wave * block
        damping[int(family.weak)] += wave * family.damping * along
    return stiffness, damping


def _limit(lattice: tuple[Array, Array]) -> float:
    """Largest stable step [s] of plain leapfrog steps: h^2 K/4 + h D/2 has no eigenvalue above 1."""
    stiffness, damping = (part.sum(axis=0) for part in lattice)
    rate, omega2 = np.linalg.eigvalsh(damping).max(), np.linalg.eigvalsh(stiffness).max()
    h = 2.0 / np.sqrt(omega2)
    # From above, on a convex function of h, by a bound of its slope.
    for _ in range(8):
        value = np.linalg.eigvalsh(0.25 * h * h * stiffness + 0.5 * h * damping).max()
        h -= max(value - 1.0, 0.0) / (0.5 * h * omega2 + 0.5 * rate)
    return float(h)


def _radius(stiffness: Array, damping: Array, h: float) -> float:
    """Spectral radius of a step with the weak families twice as strong, followed by one without them."""
    (strong, weak), (fast, slow) = stiffness, damping
    steps = _step(strong, fast, h) @ _step(strong + 2.0 * weak, fast + 2.0 * slow, h)
    return float(np.abs(np.linalg.eigvals(steps)).max())


def _step(stiffness: Array, damping: Array, h: float) -> Array:
    """The leapfrog step as a matrix on x, v and the accelerations of the last two steps, for each wave."""
    zero, one = np.zeros_like(stiffness), np.broadcast_to(np.eye(stiffness.shape[-1]), stiffness.shape)
    quarter = -0.25 * h * damping
    a = np.concatenate([-stiffness, -0.5 * h * stiffness - damping, quarter, quarter], axis=2)
    v = np.concatenate([zero, one, zero, zero], axis=2) + h * a
    x = np.concatenate([one, 0.5 * h * one, zero, zero], axis=2) + 0.5 * h * v
    return np.concatenate([x, v, a, np.concatenate([zero, zero, one, zero], axis=2)], axis=1)
