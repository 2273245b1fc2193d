# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bounds of the stiffness and damping of listed springs, from the tables and in the order of the fused loop.

Blocks of particles follow each other as in `mesh_sweep`: a block's numbers are complete when its own springs are done,
and no spring reaches further ahead than `lag` blocks. So the numbers that are being summed fit a second cache, however
many particles there are.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.kernels.mesh_emit import LANES, QUAD
from cloth_sim_ros.physics.kernels.mesh_sweep import BLOCK, Batches, Floats, Particles

_WIDTH = 16
"""Numbers of a particle while it is summed: three of its position, one to spare, six of stiffness, six of damping."""
_STIFF, _DAMPED = 4, 10
_PARTS = 6
#: |1 - l0 / L| at a tenth of the rest length, as in `pairs`.
_MOST_ACROSS = 9.0
#: Particles whose blocks, a hundred bytes each, fit into a second cache.
_STRETCH = 8192


class MeshBounds:
    """The blocks of a loop's springs, equal to the sum of `PairSprings.add_stiffness` and `add_damping` to rounding.

    Args:
        names: names of the terms whose springs these are.
        particles: the loop's particles, of which the order is taken.
        rank: place of each particle in that order, shape (n,).
        lag: blocks that springs reach ahead.
        batches: the springs, without joints.

    Not safe for two threads at once: the object owns its sums.
    """

    def __init__(
        self,
        names: frozenset[str],
        particles: Particles,
        rank: NDArray[np.int64],
        lag: int,
        *batches: Batches | None,
    ) -> None:
        self.names = names
        #: Place of each particle in `order`, shape (n,).
        self.rank = rank
        #: Particles in the order in which they are taken, shape (n,).
        self.order = particles.order
        #: Number of particles to ask for at once.
        self.stretch = min(_STRETCH, len(particles.order))
        self._lag, self._batches = lag, batches
        # A power of two, so that a place in it is a matter of a few bits.
        blocks = 1 << lag.bit_length()
        self._ring = np.zeros((blocks * BLOCK, _WIDTH))

    def add_bounds(self, x: Floats, stiff: Floats, damped: Floats, first: int = 0) -> None:
        """stiff += blocks of the stiffness [N/m], damped += blocks of the damping [N s/m], each (6, m): xx, yy, zz, xy,
        xz, yz, at positions x [m] (3, n), of m particles from ``order[first]`` on. Ask for one stretch after the other,
        from the first to the last.
        """
        _add_bounds(first, x, self.order, self._lag, LANES, *self._batches, self._ring, stiff, damped)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _take(ring, block, x, order):  # type: ignore[no-untyped-def]
    """Begin the sums of a block."""
    mask = len(ring) - 1
    for i in range(block * BLOCK, min(block * BLOCK + BLOCK, len(order))):
        sums = ring[i & mask]
        sums[:] = 0.0
        for c in range(3):
            sums[c] = x[c, order[i]]


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _add_springs(ring, block, batches, slots, lanes):  # type: ignore[no-untyped-def]
    """Add the springs that a block owns: twice k dd' + |tension / L| (I - dd') and twice k_d dd' at either end."""
    mask = len(ring) - 1
    ends, table = batches.ends, batches.table
    for batch in range(batches.starts[block], batches.starts[block + 1]):
        for lane in range(lanes):
            a = ring[(ends[2 * batch * lanes + lane] // QUAD) & mask]
            b = ring[(ends[(2 * batch + 1) * lanes + lane] // QUAD) & mask]
            at = slots * batch * lanes + lane
            pull = 2.0 * table[at]
            k = 2.0 * table[at + lanes]
            c = 2.0 * table[at + 2 * lanes] if slots == 3 else 0.0
            sx = b[0] - a[0]
            sy = b[1] - a[1]
            sz = b[2] - a[2]
            square = sx * sx + sy * sy + sz * sz
            if square == 0.0:
                across, along = _MOST_ACROSS * k, 0.0
                c_across, c_along = c, 0.0
            else:
                across = min(abs(k - pull / np.sqrt(square)), _MOST_ACROSS * k)
                along = (k - across) / square
                c_across, c_along = 0.0, c / square
            xx = sx * sx
            yy = sy * sy
            zz = sz * sz
            xy = sx * sy
            xz = sx * sz
            yz = sy * sz
            _add(a, _STIFF, across, along, xx, yy, zz, xy, xz, yz)
            _add(b, _STIFF, across, along, xx, yy, zz, xy, xz, yz)
            if slots == 3:
                _add(a, _DAMPED, c_across, c_along, xx, yy, zz, xy, xz, yz)
                _add(b, _DAMPED, c_across, c_along, xx, yy, zz, xy, xz, yz)


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _add(sums, place, across, along, xx, yy, zz, xy, xz, yz):  # type: ignore[no-untyped-def]
    """Add across I + along (six products)."""
    sums[place] += across + along * xx
    sums[place + 1] += across + along * yy
    sums[place + 2] += across + along * zz
    sums[place + 3] += along * xy
    sums[place + 4] += along * xz
    sums[place + 5] += along * yz


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_bounds(first, x, order, lag, lanes, undamped, damped, ring, stiff, damping):  # type: ignore[no-untyped-def]
    """Sweep over the blocks of a stretch; `undamped`, `damped`: springs by `mesh_sweep.Batches`, None without any."""
    mask, count = len(ring) - 1, stiff.shape[1]
    blocks = -(-len(order) // BLOCK)
    begin = first // BLOCK
    if begin == 0:
        for block in range(min(lag, blocks)):
            _take(ring, block, x, order)
    for block in range(begin, begin + -(-count // BLOCK)):
        if block + lag < blocks:
            _take(ring, block + lag, x, order)
        if undamped is not None:
            _add_springs(ring, block, undamped, 2, lanes)
        if damped is not None:
            _add_springs(ring, block, damped, 3, lanes)
        for i in range(block * BLOCK, min(block * BLOCK + BLOCK, first + count)):
            sums = ring[i & mask]
            for part in range(_PARTS):
                stiff[part, i - first] += sums[_STIFF + part]
                damping[part, i - first] += sums[_DAMPED + part]
