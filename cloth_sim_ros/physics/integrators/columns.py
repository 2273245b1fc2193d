# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Extrapolation: one stretch of time run with several step counts, and the combinations that cancel their leading
errors.

The predicted midpoint velocity makes the leapfrog's error a series in h^2, h^3, h^4, ... (without damping in h^2,
h^4, ...; docs/time_stepping.md). K columns with step counts n_1 < ... < n_K are combined with the weights w that solve
``sum w = 1, sum w n^-p = 0`` for p = 2, ..., K: the combination T_K has order K + 1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from cloth_sim_ros.physics.dynamics import THOROUGH, Dynamics, Economy
from cloth_sim_ros.physics.integrators.base import Observer
from cloth_sim_ros.physics.integrators.march import leapfrog
from cloth_sim_ros.physics.kernels.leapfrog import largest_distance
from cloth_sim_ros.physics.state import State
from cloth_sim_ros.physics.terms.base import Array

#: Step counts of the columns, relative to the first. Wider ones cost more, narrower ones amplify rounding and what
#: high modes do: the sums of |w| of the first 1 to 5 columns are 1, 4.6, 17.7, 32 and 70.
RATIOS = (1.0, 1.25, 1.5, 2.0, 2.5)
#: Particles from which no array is kept that can be made again: of runs that only judge others the velocities, of
#: combinations that are only compared the positions. No bit depends on it.
LARGE = 50_000
#: Particles of a large sheet whose combinations are compared at once.
_STRETCH = 4096


@lru_cache(maxsize=256)
def step_counts(first: int, columns: int) -> tuple[int, ...]:
    """Return the columns' step counts for a first column of so many steps; each is larger than the one before."""
    counts = [first]
    for ratio in RATIOS[1:columns]:
        counts.append(max(counts[-1] + 1, math.ceil(first * ratio - 1e-9)))
    return tuple(counts)


@lru_cache(maxsize=1024)
def weights(counts: tuple[int, ...]) -> tuple[float, ...]:
    """Return the weights of T_K for K columns of these step counts."""
    # Scaled by the first count: the powers stay near 1.
    inverse = counts[0] / np.array(counts, dtype=float)
    powers = np.array([0, *range(2, len(counts) + 1)])
    right = np.zeros(len(counts))
    right[0] = 1.0
    return tuple(float(w) for w in np.linalg.solve(inverse[None, :] ** powers[:, None], right))


class Columns:
    """The runs of one stretch of time, made one by one as they are asked for.

    Args:
        dynamics: equations of motion.
        start: state at the start; it is not changed.
        t: time at the start [s].
        duration: length of the stretch [s].
        counts: step counts of the columns that may be asked for.
        observer: sees the first ``observed`` columns with the weights of their combination: its integrals are
            extrapolated as the state is.
        observed: number of columns of the combination that will be taken.
        economy: what the first run saves on; all others save on nothing but precision.
    """

    def __init__(
        self,
        dynamics: Dynamics,
        start: State,
        t: float,
        duration: float,
        counts: Sequence[int],
        *,
        observer: Observer | None = None,
        observed: int = 0,
        economy: Economy = THOROUGH,
    ) -> None:
        self._dynamics, self._start, self._t, self._duration = dynamics, start, t, duration
        self._observer = observer
        self._observed = weights(tuple(counts[:observed])) if observer is not None else ()
        self.counts = tuple(counts)
        self.economy = economy
        self.evaluations = 0
        self._large = start.particle_count >= LARGE
        self._runs: list[tuple[Array, Array | None]] = []
        self._combined: dict[int, tuple[Array, Array]] = {}

    def combine(self, columns: int) -> tuple[Array, Array]:
        """Return positions and velocities of T_K, K = columns."""
        if columns not in self._combined:
            self._make(columns)
            if columns == 1:
                self._combined[1] = self._runs[0][0], self._velocities(0)
                return self._combined[1]
            x = self._positions(columns, slice(None))
            v = np.zeros_like(x)
            for column, weight in enumerate(weights(self.counts[:columns])):
                _add_weighted(v, weight, self._velocities(column))
            self._combined[columns] = x, v
        return self._combined[columns]

    def difference(self, columns: int) -> float:
        """Return the largest distance of a particle in T_(K+1) from the same in T_K [m], K = columns; the error of
        T_K.
        """
        if not self._large:
            return float(largest_distance(self.combine(columns + 1)[0], self.combine(columns)[0]))
        self._make(columns + 1, judging=True)
        largest = 0.0
        for first in range(0, self._start.particle_count, _STRETCH):
            here = slice(first, first + _STRETCH)
            distance = largest_distance(self._positions(columns + 1, here), self._positions(columns, here))
            largest = max(largest, float(distance))
        return largest

    def check(self) -> float:
        """Return the largest distance [m] of a particle in the first run, which saves on something, from the same in a
        run by the steps of the second that saves on nothing but precision: the first one's error.
        """
        plain, _ = self._march(self.counts[1], None, 1.0, Economy(narrow=self.economy.narrow), velocities=False)
        return float(largest_distance(plain, self.combine(1)[0]))

    def _make(self, columns: int, *, judging: bool = False) -> None:
        """Make the runs that are not there yet; of the last one positions alone where it only judges a large sheet."""
        while len(self._runs) < columns:
            column = len(self._runs)
            velocities = not (judging and self._large and column + 1 == columns)
            seen = column < len(self._observed)
            observer, weight = (self._observer, self._observed[column]) if seen else (None, 1.0)
            self._runs.append(self._march(self.counts[column], observer, weight, self.economy, velocities=velocities))

    def _march(
        self, steps: int, observer: Observer | None, weight: float, economy: Economy, *, velocities: bool = True
    ) -> tuple[Array, Array | None]:
        start = (self._start.x, self._start.v)
        x, v = np.empty_like(start[0]), np.empty_like(start[1]) if velocities else None
        step = self._duration / steps
        self.evaluations += leapfrog(
            *(self._dynamics, self._t, x, v, step, steps, observer, weight), economy=economy, start=start
        )
        return x, v

    def _velocities(self, column: int) -> Array:
        if self._runs[column][1] is None:
            # It judged, and is part of the result after all.
            self._runs[column] = self._march(self.counts[column], None, 1.0, self.economy)
        v = self._runs[column][1]
        assert v is not None
        return v

    def _positions(self, columns: int, here: slice) -> Array:
        """Positions of T_K, K = columns, of some particles, C-contiguous."""
        first = np.ascontiguousarray(self._runs[0][0][:, here])
        if columns == 1:
            return first
        x = np.zeros_like(first)
        for weight, (a, _) in zip(weights(self.counts[:columns]), self._runs, strict=False):
            _add_weighted(x, weight, a[:, here])
        return x


def _add_weighted(out: Array, weight: float, array: Array) -> None:
    """out += weight array, without an array of all products."""
    for first in range(0, out.shape[1], _STRETCH):
        here = slice(first, first + _STRETCH)
        out[:, here] += weight * array[:, here]
