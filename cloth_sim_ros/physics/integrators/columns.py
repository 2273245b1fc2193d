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
from cloth_sim_ros.physics.kernels.leapfrog import add_weighted, all_finite, largest_distance
from cloth_sim_ros.physics.state import State
from cloth_sim_ros.physics.terms.base import Array
from cloth_sim_ros.physics.terms.grips import Grips, WrenchObserver

#: Step counts of the columns, relative to the first. Wider ones cost more, narrower ones amplify rounding and what
#: high modes do: the sums of |w| of the first 1 to 5 columns are 1, 4.6, 17.7, 32 and 70.
RATIOS = (1.0, 1.25, 1.5, 2.0, 2.5)
#: Particles from which no array is kept that can be made again: of runs the velocities, whose sum is all that is taken,
#: of combinations that are only compared the positions. No bit depends on it.
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
        observer: sees the first ``taken`` columns with the weights of their combination: its integrals are
            extrapolated as the state is.
        taken: number of columns of the combination that will be taken; of a small sheet any can be.
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
        taken: int = 1,
        economy: Economy = THOROUGH,
    ) -> None:
        self._dynamics, self._start, self._t, self._duration = dynamics, start, t, duration
        self._observer = observer
        self._observed = weights(tuple(counts[:taken])) if observer is not None else ()
        self._taken = taken
        self.counts = tuple(counts)
        self.economy = economy
        self.evaluations = 0
        self._large = start.particle_count >= LARGE
        #: Positions and velocities of the runs; of a large sheet's positions alone.
        self._runs: list[tuple[Array, Array | None]] = []
        #: Velocities of the combination that will be taken, summed as the runs are made; for large sheets.
        self._sum: Array | None = None
        self._combined: dict[int, tuple[Array, Array]] = {}

    def serves(self, columns: int) -> bool:
        """Whether T_K, K = columns, can be taken: a large sheet's runs are there for one result."""
        whole = columns == 1 or columns not in self._combined
        return not self._large or (columns == self._taken and whole)

    def combine(self, columns: int) -> tuple[Array, Array]:
        """Return positions and velocities of T_K, K = columns; of a large sheet for the one that `serves`, and at last:
        its runs go with that.
        """
        if columns not in self._combined:
            v = self.velocities(columns)
            if columns == 1:
                x = self._runs[0][0]
            elif self._large:
                x = self._runs[0][0]
                for first in range(0, x.shape[1], _STRETCH):
                    here = slice(first, first + _STRETCH)
                    x[:, here] = self._positions(columns, here)
                self._runs.clear()
            else:
                x = self._positions(columns, slice(None))
            self._combined[columns] = x, v
        return self._combined[columns]

    def velocities(self, columns: int) -> Array:
        """Return the velocities of T_K, K = columns; of a large sheet for the one that `serves`."""
        if columns in self._combined:
            return self._combined[columns][1]
        self._make(columns)
        if not self._large:
            v = self._runs[0][1]
            assert v is not None
            return v if columns == 1 else self._weighted(columns, [v for _, v in self._runs])
        assert self._sum is not None and columns == self._taken, f"T_{columns} where T_{self._taken} was to be taken"
        return self._sum

    def finite(self, columns: int) -> bool:
        """Whether T_K, K = columns, is finite."""
        if not self._large:
            return bool(all_finite(*self.combine(columns)))
        v = self.velocities(columns)
        stretches = range(0, self._start.particle_count, _STRETCH)
        return bool(all_finite(v, v)) and all(
            all_finite(x, x) for x in (self._positions(columns, slice(k, k + _STRETCH)) for k in stretches)
        )

    def difference(self, columns: int) -> float:
        """Return the largest distance of a particle in T_(K+1) from the same in T_K [m], K = columns; the error of
        T_K.
        """
        if not self._large:
            return float(largest_distance(self.combine(columns + 1)[0], self.combine(columns)[0]))
        self._make(columns + 1)
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
        self._make(1)
        plain, _ = self._march(self.counts[1], None, 1.0, Economy(narrow=self.economy.narrow), velocities=False)
        return float(largest_distance(plain, self._runs[0][0]))

    def work_of_grippers(self, columns: int) -> float:
        """Return the work [J] that grippers did over T_K, K = columns: by the same runs once more, observed, whoever
        looks on at these.
        """
        grips = next((term for term in self._dynamics.model.terms if isinstance(term, Grips)), None)
        if grips is None or grips.steady():
            return 0.0
        observer = WrenchObserver(grips)
        for count, weight in zip(self.counts, weights(self.counts[:columns]), strict=False):
            self._march(count, observer, weight, self.economy, velocities=False)
        return observer.work

    def _make(self, columns: int) -> None:
        """Make the runs that are not there yet."""
        while len(self._runs) < columns:
            column = len(self._runs)
            seen = column < len(self._observed)
            observer, weight = (self._observer, self._observed[column]) if seen else (None, 1.0)
            wanted = not self._large or column < self._taken
            x, v = self._march(self.counts[column], observer, weight, self.economy, velocities=wanted)
            if self._large and v is not None:
                self._add_velocities(column, v)
                v = None
            self._runs.append((x, v))

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

    def _add_velocities(self, column: int, v: Array) -> None:
        """Add those of a run to the sum for the combination that will be taken."""
        if self._taken == 1:
            self._sum = v
            return
        if column == 0:
            self._sum = np.zeros_like(v)
        assert self._sum is not None
        _add_weighted(self._sum, weights(self.counts[: self._taken])[column], v)

    def _positions(self, columns: int, here: slice) -> Array:
        """Positions of T_K, K = columns, of some particles, C-contiguous."""
        if columns == 1:
            return np.ascontiguousarray(self._runs[0][0][:, here])
        return self._weighted(columns, [x[:, here] for x, _ in self._runs])

    def _weighted(self, columns: int, arrays: Sequence[Array | None]) -> Array:
        total: Array | None = None
        for weight, array in zip(weights(self.counts[:columns]), arrays, strict=False):
            assert array is not None
            total = np.zeros(array.shape) if total is None else total
            if self._large:
                _add_weighted(total, weight, array)
            else:
                add_weighted(total, weight, array)
        assert total is not None
        return total


def _add_weighted(out: Array, weight: float, array: Array) -> None:
    """out += weight array, without an array of all products."""
    for first in range(0, out.shape[1], _STRETCH):
        here = slice(first, first + _STRETCH)
        out[:, here] += weight * array[:, here]
