# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sparse Jacobian of a raw sheet's first-order system, for implicit library solvers."""

from __future__ import annotations

from typing import Any

import numpy as np

from cloth_sim_ros.physics.model.forces.drag import Drag
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.forces.grid_springs import GridSprings
from cloth_sim_ros.physics.model.model import Model


class SparseJacobian:
    """Exact d(dx/dt, dv/dt)/d(x, v) as a sparse matrix, y = (x, v) component-major.

    Raises:
        ValueError: if the model has springs other than those of a raw sheet.
    """

    def __init__(self, model: Model) -> None:
        sheets = [force for force in model.forces if isinstance(force, GridSprings)]
        if len(sheets) != 1:
            raise ValueError("the sparse Jacobian is written for raw sheets only")
        springs = sheets[0].pair_springs
        self._pairs, self._rest_length, self._damping = springs.pairs, springs.rest_length, springs.damping
        self._rigidity = springs.rigidity
        self._inverse_mass = model.inverse_masses
        self._drag = sum(force.rate for force in model.forces if isinstance(force, Drag))
        self._count = model.particle_count

    def __call__(self, t: float, y: Array) -> Any:
        from scipy.sparse import coo_matrix, csc_matrix, diags, identity, vstack
        from scipy.sparse import hstack as beside

        n = self._count
        x, v = y[: 3 * n].reshape(3, n), y[3 * n :].reshape(3, n)
        a, b = self._pairs.T
        s, u = x[:, b] - x[:, a], v[:, b] - v[:, a]
        square = np.sum(s * s, axis=0)
        length = np.sqrt(square)
        su = np.sum(s * u, axis=0)
        # F on b = -g s with g = k (1 - l0/L) + c su / L^2; dg = p . ds + q . du.
        g = self._rigidity * (1.0 - self._rest_length / length) + self._damping * su / square
        p = (self._rigidity * self._rest_length / (length * square) - 2.0 * self._damping * su / square**2) * s
        p += self._damping / square * u
        q = self._damping / square * s
        blocks = []
        for slope, direct in ((p, g), (q, np.zeros_like(g))):
            rows, columns, values = [], [], []
            for i in range(3):
                for j in range(3):
                    entry = s[i] * slope[j] + (direct if i == j else 0.0)
                    for row, column, sign in ((b, b, -1.0), (b, a, 1.0), (a, a, -1.0), (a, b, 1.0)):
                        rows.append(i * n + row)
                        columns.append(j * n + column)
                        values.append(sign * entry * self._inverse_mass[row])
            indices = (np.concatenate(rows), np.concatenate(columns))
            blocks.append(coo_matrix((np.concatenate(values), indices), shape=(3 * n, 3 * n)).tocsc())
        free = np.tile(self._inverse_mass > 0.0, 3).astype(float)
        blocks[1] = blocks[1] - diags(self._drag * free)
        upper = beside([csc_matrix((3 * n, 3 * n)), identity(3 * n)])
        return vstack([upper, beside(blocks)]).tocsc()
