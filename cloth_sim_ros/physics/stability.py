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

from typing import TYPE_CHECKING, Any

import numba
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.kernels.pairs import add_pair_bounds
from cloth_sim_ros.physics.model import Model
from cloth_sim_ros.physics.terms.base import Array, Term
from cloth_sim_ros.physics.terms.pair_springs import PairSprings

if TYPE_CHECKING:
    from cloth_sim_ros.physics.dynamics import FusedForces


class Bounds:
    """Bounds of one model's frequencies and damping rates; all its pair springs are taken in one pass.

    Args:
        model: masses, anchors and terms.
        fused: what takes over some of its terms, if anything does.
    """

    def __init__(self, model: Model, fused: FusedForces | None = None) -> None:
        self._model, self._fused = model, fused
        # The order in which it goes through the particles, and each one's place in it, where these are its own.
        self._order, self._rank = getattr(fused, "order", None), getattr(fused, "rank", None)
        terms = [term for term in model.terms if fused is None or term.name not in fused.names]
        springs = [part for term in terms for part in _pair_springs(term)]
        self._others = [term for term in terms if not _pair_springs(term)]
        self._pairs: tuple[NDArray[Any], ...] | None = None
        if springs:
            ends = np.concatenate([term.pairs for term in springs])
            # By the lower particle: whoever follows finds its numbers in the cache.
            order = np.argsort(ends.min(axis=1), kind="stable")
            lists = (np.concatenate([getattr(term, what) for term in springs]) for what in _SPRING)
            self._pairs = (ends[order], *(numbers[order] for numbers in lists))
            self._entries = np.empty(12 * model.particle_count)
        self._kept: tuple[Array, Array] | None = None
        #: What the fused rates leave to be added: terms that hold single particles; rates that all particles have.
        self._holding: list[Term] | None = None
        self._common = (0.0, 0.0)
        if hasattr(fused, "rates") and not springs:
            self._find_holding()

    def _find_holding(self) -> None:
        """Whether all terms beside the springs only add multiples of the identity, and which may change."""
        given = [(term, term.multiples()) for term in self._others]
        holding = []
        for term, found in given:
            if found is None:
                return
            particles, *both = found
            if particles is None:
                more = [float(np.max(number * self._model.inverse_masses)) for number in both]
                self._common = self._common[0] + more[0], self._common[1] + more[1]
            elif type(term).multiples is not Term.multiples:
                holding.append(term)
        self._holding = holding

    def rates(self, x: Array) -> tuple[float, float]:
        """Return bounds of the squared highest angular frequency [1/s^2] and of the highest damping rate [1/s] at x."""
        if self._holding is None:
            return self._by_blocks(x)
        omega2, damping = self._fused.rates(x)  # type: ignore[union-attr]
        for term in self._holding:
            particles = term.multiples()[0]  # type: ignore[index]
            if particles.size:  # type: ignore[union-attr]
                return self._of_held(x, omega2, damping)
        return omega2 + self._common[0], damping + self._common[1]

    def _of_held(self, x: Array, omega2: float, damping: float) -> tuple[float, float]:
        """The same where some particles are held, from the rates of the springs, by the blocks of these particles."""
        held: list[Any] = [term.multiples() for term in self._holding or ()]
        every: NDArray[np.int64] = np.concatenate([found[0] for found in held])
        # Several grippers may hold one particle.
        particles, places = np.unique(every, return_inverse=True)
        blocks = self._fused.blocks(x, particles)  # type: ignore[union-attr]
        inverse, rates = self._model.inverse_masses[particles], np.empty(particles.size)
        both = []
        for number, before in enumerate((omega2, damping)):
            added = np.zeros(particles.size)
            np.add.at(added, places, np.concatenate([found[1 + number] for found in held]))
            blocks[number, :3] += added
            # Not max(): that loses a NaN.
            both.append(float(np.maximum(before, _largest(blocks[number], inverse, rates))) + self._common[number])
        return both[0], both[1]

    def _by_blocks(self, x: Array) -> tuple[float, float]:
        """The same for any model."""
        count = self._model.particle_count
        stretch = getattr(self._fused, "stretch", count)
        multiples = [found for found in (term.multiples() for term in self._others) if found is not None]
        whole = self._pairs is not None or len(multiples) < len(self._others)
        if self._fused is None or whole or (stretch >= count and self._order is None):
            return self._of_all(x)
        # Stretch by stretch: the blocks of all would take more room than the state.
        omega2, damping = 0.0, 0.0
        blocks = np.empty((2, 6, stretch))
        rates = np.empty(stretch)
        for first in range(0, count, stretch):
            here = slice(first, min(first + stretch, count))
            stiff, damped = blocks if here.stop - first == stretch else np.empty((2, 6, here.stop - first))
            stiff.fill(0.0)
            damped.fill(0.0)
            self._fused.add_bounds(x, stiff, damped, first)  # type: ignore[call-arg]
            for particles, k, c in multiples:
                self._add_multiples(stiff, particles, k, here)
                self._add_multiples(damped, particles, c, here)
            inverse = self._model.inverse_masses[self._particles(here)]
            # Not max(): that loses a NaN.
            omega2 = float(np.maximum(omega2, _largest(stiff, inverse, rates)))
            damping = float(np.maximum(damping, _largest(damped, inverse, rates)))
        return omega2, damping

    def _of_all(self, x: Array) -> tuple[float, float]:
        count = self._model.particle_count
        if self._kept is None:
            self._kept = np.empty((2, 6, count)), np.empty(count)
        (stiff, damped), rates = self._kept
        stiff.fill(0.0)
        damped.fill(0.0)
        if self._fused is not None:
            self._fused.add_bounds(x, stiff, damped)
        if self._pairs is not None:
            add_pair_bounds(*self._pairs, x, self._entries, stiff, damped)
        for term in self._others:
            term.add_stiffness(x, stiff)
            term.add_damping(x, damped)
        inverse = self._model.inverse_masses
        return _largest(stiff, inverse, rates), _largest(damped, inverse, rates)

    def _particles(self, here: slice) -> slice | NDArray[np.int64]:
        """The particles of a stretch."""
        return here if self._order is None else self._order[here]

    def _add_multiples(self, blocks: Array, particles: NDArray[np.int64] | None, k: Array | float, here: slice) -> None:
        """Add k I to the blocks of a stretch of particles."""
        if particles is None:
            blocks[:3] += k if isinstance(k, float) else k[self._particles(here)]
        elif particles.size:
            places = particles if self._rank is None else self._rank[particles]
            near = (places >= here.start) & (places < here.stop)
            for part in blocks[:3]:
                # Several grippers may hold one particle: plain indexing would not add up.
                np.add.at(part, places[near] - here.start, np.broadcast_to(k, particles.shape)[near])


def _largest(blocks: Array, inverse_masses: Array, rates: Array) -> float:
    rates = rates[: len(inverse_masses)]
    block_rates(blocks.reshape(-1), inverse_masses, rates)
    return float(rates.max())


_SPRING = ("rest_length", "stiffness", "damping")


def _pair_springs(term: Term) -> list[PairSprings]:
    """The pair springs that a term consists of; none for one of another kind."""
    if isinstance(term, PairSprings) and all(
        getattr(type(term), what) is getattr(PairSprings, what) for what in ("add_stiffness", "add_damping")
    ):
        return [term]
    parts = getattr(term, "parts", None)
    return list(parts) if parts is not None else []


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def block_rates(blocks, inverse_masses, rates):  # type: ignore[no-untyped-def]
    """Set rates (n,) to eig(B_i) / m_i, the largest eigenvalue; blocks flat: n of xx, then of yy, zz, xy, xz, yz.

    A symmetric 3x3 matrix with mean eigenvalue m and B - m I = p C, C of Frobenius norm sqrt(6), has the largest
    eigenvalue m + 2 p cos(acos(h) / 3), h = det(C) / 2 (Smith, Comm. ACM 4(4), 1961). With t = sqrt((1 + h) / 2) that
    cosine is cos(2 acos(t) / 3), smooth in t: a polynomial of degree 13, never below it, at most 1e-12 above.
    A double root comes out to the square root of rounding. No branch and no function call, so that the loop is
    vectorised; a NaN stays one.
    """
    n = len(rates)
    for i in range(n):
        a = blocks[i]
        b = blocks[n + i]
        c = blocks[2 * n + i]
        d = blocks[3 * n + i]
        e = blocks[4 * n + i]
        f = blocks[5 * n + i]
        mean = (a + b + c) / 3.0
        a -= mean
        b -= mean
        c -= mean
        p = np.sqrt((a * a + b * b + c * c + 2.0 * (d * d + e * e + f * f)) / 6.0)
        # p = 0 for a multiple of the identity.
        scale = 1.0 / (p + 1e-15 * mean + 1e-300)
        a *= scale
        b *= scale
        c *= scale
        d *= scale
        e *= scale
        f *= scale
        half = 0.5 * (a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e))
        t = np.sqrt(0.5 + 0.5 * min(1.0, max(-1.0, half)))
        twice = 9.1371974490662e-05 * t - 0.00074459295848305
        twice = (twice * t + 0.0028628194514527) * t - 0.0070378744145726
        twice = (twice * t + 0.012798556604318) * t - 0.01914712152288
        twice = (twice * t + 0.025832998977777) * t - 0.033906752945952
        twice = (twice * t + 0.045694566199183) * t - 0.065838662822131
        twice = (twice * t + 0.10691636217626) * t - 0.22222220890035
        twice = (twice * t + 1.1547005381807) * t + 1.000000000001
        rate = mean + p * twice
        rates[i] = rate * inverse_masses[i]
