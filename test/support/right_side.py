# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Equations of motion in numpy, by the formulas of docs/springs.md: the independent reference for the engine's errors.

None of the engine's code is used here.
"""

from __future__ import annotations

import numpy as np

from cloth_sim_ros.physics.model.forces.drag import Drag
from cloth_sim_ros.physics.model.forces.force import Array, Force
from cloth_sim_ros.physics.model.forces.gravity import Gravity
from cloth_sim_ros.physics.model.forces.grid_springs import GridSprings
from cloth_sim_ros.physics.model.forces.grips import Grips
from cloth_sim_ros.physics.model.forces.pair_springs import PairSprings
from cloth_sim_ros.physics.model.forces.wind import Wind
from cloth_sim_ros.physics.model.model import Model


class IndependentRightSide:
    """A model as a first-order system y = (x, v), component-major: springs, gravity, drag, wind and grips.

    Raises:
        ValueError: for a force that it does not know, or a gripper that turns.
    """

    def __init__(self, model: Model) -> None:
        from scipy.sparse import csr_array

        self._count, self._inverse = model.particle_count, model.inverse_masses
        self._push, self._rate = np.zeros(3), 0.0
        self._grips: Grips | None = None
        lists = []
        for force in model.forces:
            if isinstance(force, GridSprings | PairSprings):
                lists.append(force.pair_springs if isinstance(force, GridSprings) else force)
            elif not self._uniform(force):
                raise ValueError(f"the reference does not know the force '{force.name}'")
        pairs = np.concatenate([springs.pairs for springs in lists])
        self._rest_length = np.concatenate([springs.rest_length for springs in lists])
        self._stiffness = np.concatenate([springs.stiffness for springs in lists])
        self._damping = np.concatenate([springs.damping for springs in lists])
        if not (self._rest_length > 0.0).all():
            raise ValueError("the reference knows no joints")
        # Row by row what goes from particles to springs' differences, and back.
        ends, signs = pairs.ravel(), np.tile([-1.0, 1.0], len(pairs))
        starts = np.arange(0, len(ends) + 1, 2)
        self._difference = csr_array((signs, ends, starts), shape=(len(pairs), self._count))
        self._gather = csr_array(self._difference.T)
        self._free = (self._inverse > 0.0).astype(np.float64)

    def _uniform(self, force: Force) -> bool:
        """Take a force that is none of springs; False for one that is not known."""
        if isinstance(force, Gravity | Wind):
            self._push = self._push + force.acceleration
        elif isinstance(force, Drag):
            self._rate += force.rate
        elif isinstance(force, Grips):
            if force.paths[:, 17:26].any():
                raise ValueError("the reference knows no grippers that turn")
            self._grips = force
        else:
            return False
        return True

    def __call__(self, t: float, y: Array) -> Array:
        n = self._count
        # Particles by rows, as the products with sparse matrices take them.
        x, v = (np.ascontiguousarray(half.reshape(3, n).T) for half in (y[: 3 * n], y[3 * n :]))
        s, u = self._difference @ x, self._difference @ v
        length = np.sqrt(np.einsum("ij,ij->i", s, s))
        along = s / length[:, None]
        tension = self._stiffness * (length / self._rest_length - 1.0) + self._damping * np.einsum("ij,ij->i", u, along)
        a = self._gather @ (-tension[:, None] * along)
        if self._grips is not None:
            self._hold(self._grips, t, x, v, a)
        a *= self._inverse[:, None]
        a += self._free[:, None] * (self._push - self._rate * v)
        return np.concatenate([y[3 * n :], a.T.ravel()])

    def _hold(self, grips: Grips, t: float, x: Array, v: Array, f: Array) -> None:
        for gripper, path in enumerate(grips.paths):
            s, coefficients = t - path[0], path[1:13].reshape(4, 3)
            position = coefficients.T @ (1.0, s, s * s, s * s * s)
            velocity = coefficients.T @ (0.0, 1.0, 2.0 * s, 3.0 * s * s)
            grip_slice = slice(grips.starts[gripper], grips.starts[gripper + 1])
            particles = grips.particles[grip_slice]
            offsets = x[particles] - position - _turned(grips.offsets[grip_slice], path[13:17])
            force = grips.stiffness[grip_slice, None] * offsets + grips.damping[grip_slice, None] * (
                v[particles] - velocity
            )
            np.add.at(f, particles, -force)


def _turned(points: Array, orientation: Array) -> Array:
    """Points (m, 3) turned by a unit quaternion x, y, z, w."""
    axis, w = orientation[:3], orientation[3]
    cross_product = np.cross(axis, points)
    turned: Array = points + 2.0 * (w * cross_product + np.cross(axis, cross_product))
    return turned
