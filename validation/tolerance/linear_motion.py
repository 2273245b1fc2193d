# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Exact motion of linear systems by a matrix exponential."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cloth_sim_ros.physics.model.forces.drag import Drag
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.forces.gravity import Gravity
from cloth_sim_ros.physics.model.forces.pair_springs import PairSprings
from cloth_sim_ros.physics.model.forces.wind import Wind
from cloth_sim_ros.physics.model.model import Model


class LinearMotion:
    """Motion of taut springs on a line, or of joints, under gravity, linear drag and wind.

    Args:
        model: springs, gravity, drag and wind only.
        x: initial positions [m], shape (3, n).
        v: initial velocities [m/s], shape (3, n).

    Raises:
        ValueError: for another force.
    """

    def __init__(self, model: Model, x: Array, v: Array) -> None:
        count = model.particle_count
        stiff, damped, force = np.zeros((count, count)), np.zeros((count, count)), np.zeros((count, 3))
        acceleration, drag = np.zeros(3), 0.0
        for term in model.forces:
            if isinstance(term, Gravity | Wind):
                acceleration += term.acceleration
            elif isinstance(term, Drag):
                drag += term.rate
            elif isinstance(term, PairSprings):
                difference = np.zeros((len(term.pairs), count))
                difference[np.arange(len(term.pairs)), term.pairs[:, 0]] = -1.0
                difference[np.arange(len(term.pairs)), term.pairs[:, 1]] = 1.0
                stiff += difference.T @ (term.rigidity[:, None] * difference)
                damped += difference.T @ (term.damping[:, None] * difference)
                separations = difference @ x.T
                # Stretch of a spring on a line: d - l0 d / |d|; of a joint: d.
                length = np.sqrt(np.sum(separations * separations, axis=1))
                stretch = separations * (1.0 - term.rest_length / np.where(length > 0.0, length, 1.0))[:, None]
                force -= difference.T @ (term.rigidity[:, None] * stretch)
            else:
                raise ValueError(f"the exact solution needs a linear model, but it has the force '{term.name}'")
        inverse = model.inverse_masses[:, None]
        self._x, self._free = x, np.flatnonzero(model.inverse_masses > 0.0)
        free, n = self._free, len(self._free)
        # State: deviation from the start, velocity, and 1; one column for each axis, because the axes are independent.
        matrix = np.zeros((2 * n + 3, 2 * n + 3))
        matrix[:n, n : 2 * n] = np.eye(n)
        matrix[n : 2 * n, :n] = -(inverse * stiff)[np.ix_(free, free)]
        matrix[n : 2 * n, n : 2 * n] = -(inverse * damped)[np.ix_(free, free)] - drag * np.eye(n)
        matrix[n : 2 * n, 2 * n :] = (inverse * force)[free] + acceleration
        self._matrix, self._propagators = matrix, dict[float, Array]()
        self._start = np.zeros((2 * n + 3, 3))
        self._start[n : 2 * n], self._start[2 * n :] = v.T[free], np.eye(3)
        self._state = self._start

    def advance(self, duration: float) -> Array:
        """Advance by a duration [s]; return the positions [m], shape (3, n)."""
        self._state = self.propagator(duration) @ self._state
        return self._positions(self._state)

    def positions_after(self, duration: float) -> Array:
        """Return the positions [m], shape (3, n), a duration [s] after the start."""
        return self._positions(self.propagator(duration) @ self._start)

    def _positions(self, state: Array) -> Array:
        positions = self._x.copy()
        positions[:, self._free] += state[: len(self._free)].T
        return positions

    def propagator(self, duration: float) -> Array:
        """Return the matrix that advances a state by a duration [s]."""
        from scipy.linalg import expm

        if duration not in self._propagators:
            self._propagators[duration] = expm(self._matrix * duration)
        return self._propagators[duration]

    def amplification(self, durations: Sequence[float]) -> float:
        """Return the largest amplification of a perturbation at the ends of successive durations [s].

        All particles are perturbed by one size, each in the worst direction.
        """
        n, product, largest = len(self._free), np.eye(2 * len(self._free)), 0.0
        for duration in durations:
            product = self.propagator(duration)[: 2 * n, : 2 * n] @ product
            response = np.abs(product[:n])
            largest = max(largest, *(float(part.sum(axis=1).max()) for part in (response[:, :n], response[:, n:])))
        return largest


def exact_positions(model: Model, x: Array, v: Array, period: float, frames: int) -> list[Array]:
    """Return positions (3, n) [m] at the end of each frame of a linear system."""
    motion = LinearMotion(model, x, v)
    return [motion.advance(period) for _ in range(frames)]
