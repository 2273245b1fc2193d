# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bounds of the highest frequency and damping rate of a model, from particle blocks.

For a spring u'Ku = k (d . (u_b - u_a))^2 <= 2 k ((d . u_a)^2 + (d . u_b)^2), so the sum over particles of u_i' B_i u_i
with
B_i = sum of 2 k dd' bounds u'Ku, and the largest eigenvalue of M^-1 K is at most the largest of eig(B_i) / m_i. On a
flat regular grid the bound is
a few per cent above the true value, because the shortest wave moves neighbours in opposite directions.
"""

from __future__ import annotations

import numba
import numpy as np

from cloth_sim_ros.physics.kernels.pairs import add_pair_bounds
from cloth_sim_ros.physics.model import Model
from cloth_sim_ros.physics.terms.base import Array, Term
from cloth_sim_ros.physics.terms.pair_springs import PairSprings


class Bounds:
    """Bounds of one model's frequencies and damping rates; all its pair springs are taken in one pass.

    Args:
        model: masses, anchors and terms.
    """

    def __init__(self, model: Model) -> None:
        self._model = model
        springs = [part for term in model.terms for part in _pair_springs(term)]
        self._others = [term for term in model.terms if not _pair_springs(term)]
        none = np.empty(0)
        self._pairs = np.concatenate([np.empty((0, 2), dtype=np.int64), *(term.pairs for term in springs)])
        self._rest = np.concatenate([none, *(term.rest_length for term in springs)])
        self._stiffness = np.concatenate([none, *(term.stiffness for term in springs)])
        self._damping = np.concatenate([none, *(term.damping for term in springs)])
        self._stiff = np.empty((6, model.particle_count))
        self._damped = np.empty((6, model.particle_count))

    def rates(self, x: Array) -> tuple[float, float]:
        """Return bounds of the squared highest angular frequency [1/s^2] and of the highest damping rate [1/s] at x."""
        stiff, damped = self._stiff, self._damped
        stiff.fill(0.0)
        damped.fill(0.0)
        add_pair_bounds(self._pairs, self._rest, self._stiffness, self._damping, x, stiff, damped)
        for term in self._others:
            term.add_stiffness(x, stiff)
            term.add_damping(x, damped)
        inverse = self._model.inverse_masses
        return float(largest_rate(stiff, inverse)), float(largest_rate(damped, inverse))


def _pair_springs(term: Term) -> list[PairSprings]:
    """The pair springs that a term consists of; none for one of another kind."""
    if type(term) is PairSprings:
        return [term]
    parts = getattr(term, "parts", None)
    return list(parts) if parts is not None else []


@numba.njit(cache=True, nogil=True)
def largest_rate(blocks, inverse_masses):  # type: ignore[no-untyped-def]
    """Return the largest eig(B_i) / m_i over particles; blocks (6, n): xx, yy, zz, xy, xz, yz.

    The eigenvalues of a symmetric 3x3 matrix in closed form (Smith, Comm. ACM 4(4), 1961).
    """
    largest = 0.0
    for i in range(blocks.shape[1]):
        w = inverse_masses[i]
        a = blocks[0, i]
        b = blocks[1, i]
        c = blocks[2, i]
        # The trace bounds the largest eigenvalue: most particles need no more than that.
        if (a + b + c) * w <= largest:
            continue
        off = blocks[3, i] ** 2 + blocks[4, i] ** 2 + blocks[5, i] ** 2
        mean = (a + b + c) / 3.0
        spread = (a - mean) ** 2 + (b - mean) ** 2 + (c - mean) ** 2 + 2.0 * off
        top = mean
        if spread > 0.0:
            p = np.sqrt(spread / 6.0)
            a1 = (a - mean) / p
            b1 = (b - mean) / p
            c1 = (c - mean) / p
            d1 = blocks[3, i] / p
            e1 = blocks[4, i] / p
            f1 = blocks[5, i] / p
            half = 0.5 * (a1 * (b1 * c1 - f1 * f1) - d1 * (d1 * c1 - f1 * e1) + e1 * (d1 * f1 - b1 * e1))
            half = min(1.0, max(-1.0, half))
            top = mean + 2.0 * p * np.cos(np.arccos(half) / 3.0)
        rate = top * w
        if not rate <= largest:  # catches a NaN too
            largest = rate
    return largest
