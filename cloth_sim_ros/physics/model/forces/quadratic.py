# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Quadratic hinges: bending energy that is quadratic in positions, of a sheet that is flat at rest."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cloth_sim_ros.engine.binding import checked_floats, checked_indices
from cloth_sim_ros.physics.model.forces.force import EngineForce
from cloth_sim_ros.physics.model.parts import ElementList, Part


class QuadraticHinges(EngineForce):
    """Bending hinges with the energy k |L|²/2, quadratic in positions: L = Σ w_i x_i is 0 when flat.

    Rigid triangles folded by θ have |L| = 2 sin(θ/2), so the energy is k (1 - cos θ). It is convex in positions: a flat
    sheet is its only rest. The force is -k w_i (L + τ dL/dt). Its elastic part has no resultant and no torque. The
    damping has no resultant, but it also brakes the rigid rotation of a bent sheet.

    Args:
        hinges: particles (edge0, edge1, wing0, wing1) as in `surface`, shape (m, 4).
        weights: weights w_i [1/m] of the particles, whose sum is zero, shape (m, 4).
        stiffness: k [N m], shape (m,) or one number, at least 0.
        damping_time: τ [s], at least 0.
        name: the force's name in a model.

    Raises:
        ValueError: for a shape that does not fit, a particle that a hinge names twice, weights that do not sum to zero,
            or an entry that is negative or not finite.
    """

    def __init__(
        self,
        hinges: ArrayLike,
        weights: ArrayLike,
        stiffness: ArrayLike,
        damping_time: float = 0.0,
        *,
        name: str = "quadratic",
    ) -> None:
        self.name = name
        self.hinges: NDArray[np.int64] = checked_indices(f"hinges of '{name}'", hinges, 4, np.iinfo(np.int64).max)
        count = len(self.hinges)
        ordered = np.sort(self.hinges, axis=1)
        wrong = np.flatnonzero((ordered[:, :-1] == ordered[:, 1:]).any(axis=1))
        if wrong.size:
            raise ValueError(
                f"hinge {wrong[0]} of '{name}' is {self.hinges[wrong[0]].tolist()}; it needs four different particles"
            )
        self.weights = checked_floats(f"weights of '{name}'", weights, (count, 4), one_for_all=False)
        first, second, third, fourth = self.weights.T
        wrong = np.flatnonzero(
            np.abs(first + second + third + fourth) > 1e-9 * np.abs(self.weights).max(axis=1, initial=0.0)
        )
        if wrong.size:
            raise ValueError(f"weights of hinge {wrong[0]} of '{name}' are {self.weights[wrong[0]].tolist()}; sum: 0")
        self.stiffness = checked_floats(f"stiffness of '{name}'", stiffness, (count,), lower=0.0)
        if not (math.isfinite(damping_time) and damping_time >= 0.0):
            raise ValueError(f"damping_time of '{name}' is {damping_time} s; it must be finite and at least 0")
        self.damping_time = float(damping_time)
        self.damped = damping_time > 0.0

    def parts(self, particle_count: int) -> Sequence[Part]:
        hinges = checked_indices(f"hinges of '{self.name}'", self.hinges, 4, particle_count)
        if not len(hinges):
            return ()
        coefficients = np.concatenate([self.weights[:, 1:], self.stiffness[:, None]], axis=1)
        elements = ElementList(
            kind="quadratic",
            particles=hinges,
            coefficients=coefficients,
            shared_coefficients=np.array([self.damping_time]),
        )
        return (elements,)
